"""Named regions of the canonical chart, as soft masks in UV.

Outlines are smooth arcs through landmarks of `LANDMARK_UV`; a mask falls from 1 to 0 across its outline over
a width in millimetres on the mean face. `eyes` (between the lids), `brows`, `lips` (the mouth slit among
them), `nostrils`, `neck` (below the jaw line) and `skin` sum to one everywhere; `mouth` (the slit) and `face`
(inside jaw and forehead, for compositing) overlap them.
"""

from functools import cache

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from facerf_cli.face.topology import BOTTOM_M, HALF_ANGLE_DEG, LANDMARK_UV, TOP_M

REGIONS = ("skin", "eyes", "brows", "lips", "mouth", "nostrils", "neck", "face")
_PARTS = ("eyes", "brows", "lips", "nostrils", "neck")  # what skin leaves out
_PAIRED = ("eyes", "brows", "nostrils")  # outlined on the picture's left, then mirrored
_EDGE_MM = {"eyes": 1.0, "brows": 3.0, "lips": 1.6, "mouth": 1.0, "nostrils": 2.5, "neck": 5.0, "face": 16.0}

CHART_MM = np.array([np.radians(2 * HALF_ANGLE_DEG) * 115, (TOP_M - BOTTOM_M) * 1000])  # where r = 115 mm
_BROW_ABOVE_MM, _BROW_BELOW_MM = (0.5, 1.5, 2.0, 2.0, 0.5), (1.0, 2.5, 4.0, 5.5, 5.0)  # of landmarks 17 to 21
_NOSTRIL_CENTRE_UV, _NOSTRIL_HALF_MM, _NOSTRIL_TILT_DEG = (0.4650, 0.5720), (4.2, 2.0), 14.0
_FOREHEAD_UV = [(0.955, 0.17), (0.86, 0.075), (0.68, 0.045), (0.5, 0.04)]  # and mirrored


@cache
def region_mask(name: str, side: int) -> Tensor:
    """The mask [T, T] in 0..1 of the region `name`, rows from the forehead down; symmetric in u."""
    if name == "skin":
        return (1 - torch.stack([region_mask(part, side) for part in _PARTS]).sum(0)).clamp(0, 1)
    centre = (np.arange(side) + 0.5) / side
    uv = np.stack(np.meshgrid(centre, centre), -1)
    distance_mm = inside_mm(name, uv)
    edge_mm = max(_EDGE_MM[name], CHART_MM.max() / side)  # never sharper than a texel
    ramp = np.clip(distance_mm / edge_mm + 0.5, 0, 1)
    mask = ramp * ramp * (3 - 2 * ramp)
    mirrored = mask[:, ::-1]
    mask = np.maximum(mask, mirrored) if name in _PAIRED else (mask + mirrored) / 2
    return torch.from_numpy(mask).float()


def inside_mm(name: str, uv: np.ndarray) -> np.ndarray:
    """Distance [...] on the unrolled chart from (u, v) [..., 2] to the region's outline, positive inside.

    Of paired regions only the one on the picture's left (u < 0.5) is measured.
    """
    return _inside_outline(uv * CHART_MM, _outline_mm(name))


def _outline_mm(name: str) -> np.ndarray:
    """Closed outline [N, 2] on the unrolled chart, in millimetres."""
    landmarks = LANDMARK_UV * CHART_MM
    if name == "eyes":
        arcs = [landmarks[[36, 37, 38, 39]], landmarks[[39, 40, 41, 36]]]
    elif name == "brows":
        above = landmarks[17:22] - np.stack([np.zeros(5), _BROW_ABOVE_MM], -1)
        below = landmarks[17:22] + np.stack([np.zeros(5), _BROW_BELOW_MM], -1)
        arcs = [above, below[::-1]]
    elif name == "lips":
        arcs = [landmarks[48:55], landmarks[[*range(54, 60), 48]]]
    elif name == "mouth":
        arcs = [landmarks[60:65], landmarks[[64, 65, 66, 67, 60]]]
    elif name == "nostrils":
        turn, tilt = np.linspace(0, 2 * np.pi, 40), np.radians(_NOSTRIL_TILT_DEG)
        along, across = _NOSTRIL_HALF_MM[0] * np.cos(turn), _NOSTRIL_HALF_MM[1] * np.sin(turn)
        ellipse = [along * np.cos(tilt) + across * np.sin(tilt), across * np.cos(tilt) - along * np.sin(tilt)]
        arcs = [np.stack(ellipse, -1) + np.array(_NOSTRIL_CENTRE_UV) * CHART_MM]
    elif name == "neck":
        corners = np.array([(2, LANDMARK_UV[16, 1]), (2, 2), (-1, 2), (-1, LANDMARK_UV[0, 1])]) * CHART_MM
        return np.concatenate([_smooth(landmarks[:17]), corners])
    elif name == "face":
        forehead = [*_FOREHEAD_UV, *((1 - u, v) for u, v in _FOREHEAD_UV[-2::-1])]
        arcs = [landmarks[:17], np.array([LANDMARK_UV[16], *forehead, LANDMARK_UV[0]]) * CHART_MM]
    else:
        raise ValueError(f"no region is called {name!r}; there are {', '.join(REGIONS)}")
    return np.concatenate([_smooth(arc) for arc in arcs])


def _smooth(points: np.ndarray, steps: int = 6) -> np.ndarray:
    """A cubic spline [N, 2] through `points`, by chord length."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
    knots = np.arange(len(points))
    at = np.interp(np.linspace(0, knots[-1], knots[-1] * steps + 1), knots, length)
    return CubicSpline(length, points)(at)


def _inside_outline(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Distance [...] of `points` [..., 2] to the closed `outline` [N, 2], positive inside (even-odd rule)."""
    distance = np.full(points.shape[:-1], np.inf)
    inside = np.zeros(points.shape[:-1], bool)
    for start, end in zip(outline, np.roll(outline, -1, 0), strict=True):
        along, offset = end - start, points - start
        fraction = np.clip(offset @ along / max(along @ along, 1e-12), 0, 1)
        distance = np.minimum(distance, np.linalg.norm(offset - fraction[..., None] * along, axis=-1))
        if start[1] != end[1]:
            crosses = (points[..., 1] < start[1]) != (points[..., 1] < end[1])
            inside ^= crosses & (offset[..., 0] < offset[..., 1] * along[0] / along[1])
    return np.where(inside, distance, -distance)
