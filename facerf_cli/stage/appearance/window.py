"""A square window of the chart's plane that skin is painted in: the chart itself, or the wider canvas."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.regions import CHART_MM, inside_mm
from facerf_cli.face.topology import LANDMARK_UV
from facerf_cli.raster.texture import texel_centres_uv

CHART_SPAN, CANVAS_SPAN = (0.0, 1.0), (-0.5, 1.5)  # of u and of v
LANDMARK_MM = (LANDMARK_UV - [0.5, 0]) * CHART_MM  # [68, 2]
_PAIRED = ("eyes", "brows", "nostrils")  # regions that are measured on the picture's left alone


@dataclass(frozen=True)
class Window:
    """`side` x `side` texels over (u, v) in `span`, rows down.

    Places on it are also given in millimetres on the mean face unrolled: x from the midline to the picture's
    right, y down from the chart's upper edge.
    """

    side: int
    span: tuple[float, float] = CHART_SPAN

    @property
    def texel_mm(self) -> tuple[float, float]:
        """Width and height of a texel."""
        texel = CHART_MM * (self.span[1] - self.span[0]) / self.side
        return float(texel[0]), float(texel[1])

    def to_texels(self, mm: Tensor) -> Tensor:
        """Places [..., 2] in texels, whose centres are at whole numbers."""
        origin = torch.tensor([(self.span[0] - 0.5) * CHART_MM[0], self.span[0] * CHART_MM[1]])
        return (mm - origin.float()) / torch.tensor(self.texel_mm) - 0.5


@lru_cache(maxsize=8)
def places_mm(window: Window) -> tuple[Tensor, Tensor]:
    """x and y [T, T] of every texel's centre."""
    low, high = window.span
    u, v = (low + (high - low) * texel_centres_uv(window.side)).unbind(-1)
    return (u - 0.5) * float(CHART_MM[0]), v * float(CHART_MM[1])


@lru_cache(maxsize=64)
def inside(window: Window, region: str) -> Tensor:
    """Millimetres [1, 1, T, T] from the region's outline, positive inside; symmetric.

    Beyond the chart it is continued from the chart's edge.
    """
    side = max(8, min(256, int(window.side / (window.span[1] - window.span[0]))))
    distance = inside_mm(region, texel_centres_uv(side, torch.float64).numpy())
    mirrored = distance[:, ::-1]
    both = np.maximum(distance, mirrored) if region in _PAIRED else (distance + mirrored) / 2
    x, y = places_mm(window)
    at = torch.stack([x / float(CHART_MM[0]) + 0.5, y / float(CHART_MM[1])], -1)
    field = torch.from_numpy(both).float()[None, None]
    return F.grid_sample(field, 2 * at[None] - 1, padding_mode="border", align_corners=False)


@lru_cache(maxsize=64)
def mask(window: Window, region: str, edge_mm: float, grow_mm: float = 0.0) -> Tensor:
    """1 inside the region grown by `grow_mm`, 0 outside [1, 1, T, T]; its edge is no sharper than a texel."""
    ramp = (inside(window, region) + grow_mm) / max(edge_mm, max(window.texel_mm)) + 0.5
    return smooth(ramp)


def smooth(ramp: Tensor) -> Tensor:
    """0 below 0, 1 above 1, smoothly in between."""
    ramp = ramp.clamp(0, 1)
    return ramp * ramp * (3 - 2 * ramp)


@lru_cache(maxsize=64)
def blob(window: Window, at: int | tuple[float, float], radius_mm: float, tall: float = 1.0) -> Tensor:
    """A bump [1, 1, T, T] of height 1 about a landmark or (u, v); `tall`: its height over its width."""
    u, v = LANDMARK_UV[at] if isinstance(at, int) else at
    x, y = places_mm(window)
    dx, dy = x - float((u - 0.5) * CHART_MM[0]), y - float(v * CHART_MM[1])
    return torch.exp(-((dx / radius_mm) ** 2) - (dy / (radius_mm * tall)) ** 2)[None, None]


@lru_cache(maxsize=64)
def blobs(window: Window, u: float, v: float, radius_mm: float, tall: float = 1.0) -> Tensor:
    """A bump on either side, at u and 1 - u."""
    return blob(window, (u, v), radius_mm, tall) + blob(window, (1 - u, v), radius_mm, tall)
