"""Eyes: the photo's catchlights give way to the mirror image of the new light in the cornea.

The cornea is a ball before the iris that reflects a fixed share of the light; lights are seen in it as discs.
What is far brighter than the rest of an iris in the photo is a catchlight. All is linear in light.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from skimage.draw import polygon2mask
from torch import Tensor

from facerf_cli.image.colour import luminance
from facerf_cli.image.strips import Band, block_means
from facerf_cli.light.sphere import RIG_LIGHTS
from facerf_cli.light.studio_points import is_around
from facerf_cli.portrait.mesh import SeenEyes
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.raster.texture import smoothstep

_IRIS_OF_CORNEA = 5.9 / 7.8  # their radii, mm
_REFLECTED = 0.025  # by Fresnel's law, of light that arrives at a right angle
_SIDE = 64  # of the mirror image
_LIGHT_RAD = math.acos(1 - 2 / RIG_LIGHTS)  # radius of a light's disc, which fills a cell of the rig
_LEAST_PX = 2.0  # radius of an iris in which something can be seen
_RIM = 0.85  # of the radius: beyond it what is bright is the white of the eye
_FINE = 4  # parts of a pixel at the lids, along each side
_CATCHLIGHT = 1.5  # radiance from which on a pixel is a catchlight, over the median of the iris


def mirrored_in_cornea(directions: Tensor, weights: Tensor, arrives: Tensor) -> Tensor:
    """Radiance [M, N, 3, s, s] that N irises mirror under M sums, rgb weights [M, L, 3], of lights [L, 3].

    `arrives` [N, L] is the share of each light that reaches each iris, past nose and brows. The square lies
    around the iris, as the camera sees it; the eye looks at the camera. The same light from all around, as a
    room's, is not mirrored: it has nothing to show, and would lie before dark irises as a grey disc.
    """
    at = 2 * (torch.arange(_SIDE) + PIXEL_CENTRE) / _SIDE - 1
    down, right = torch.meshgrid(at, at, indexing="ij")
    x, y = right * _IRIS_OF_CORNEA, -down * _IRIS_OF_CORNEA
    normals = torch.stack([x, y, (1 - x * x - y * y).clamp_min(0).sqrt()])
    seen = 2 * normals[2] * normals - normals.new_tensor([0.0, 0.0, 1.0]).view(3, 1, 1)
    outer, inner = math.cos(1.2 * _LIGHT_RAD), math.cos(0.8 * _LIGHT_RAD)
    inside = (right.square() + down.square()) < 1
    discs = inside * smoothstep((torch.einsum("lc,cij->lij", directions, seen) - outer) / (inner - outer))
    # a disc that gives a white surface radiance 1 has itself the radiance 1 / sin^2
    shown = discs * (_REFLECTED / math.sin(_LIGHT_RAD) ** 2)
    return torch.einsum("mlc,nl,lij->mncij", weights, arrives * ~is_around(directions), shown)


@dataclass(frozen=True, eq=False)
class _Iris:
    """A window of the photo: share of the iris [h, w], what stays without catchlights [h, w], its grid."""

    number: int  # among the person's irises
    rows: slice
    columns: slice
    share: np.ndarray
    kept: np.ndarray
    grid: Tensor  # [1, h, w, 2], in the mirror image


class Eyes:
    """The irises of a person's eyes, as far as they show between the lids in a photo [H, W, 3]."""

    def __init__(self, photo: Band, eyes: SeenEyes, size_px: tuple[int, ...]) -> None:
        self._irises = []
        for number, (x_px, y_px, radius_px) in enumerate(eyes.irises_px.tolist()):
            rows, columns = (
                slice(max(0, math.floor(middle - radius_px)), min(length, math.ceil(middle + radius_px)))
                for middle, length in zip((y_px, x_px), size_px, strict=True)
            )
            if radius_px < _LEAST_PX or rows.start >= rows.stop or columns.start >= columns.stop:
                continue
            y, x = (
                (torch.arange(at.start, at.stop) + PIXEL_CENTRE - middle) / radius_px
                for at, middle in ((rows, y_px), (columns, x_px))
            )
            away = (x[None].square() + y[:, None].square()).sqrt().numpy()
            inner, disc = (((end - away) * radius_px + 0.5).clip(0, 1) for end in (_RIM, 1))
            share = disc * _between(eyes.lids_px[number], rows, columns)
            light = luminance(photo(rows)[:, columns])
            if (share > 0.5).any():
                most = _CATCHLIGHT * np.median(light[share > 0.5])
                darker = (1 - most / np.maximum(light, 1e-9)).clip(min=0)
                kept = (1 - inner * darker).astype(np.float32)
                grid = torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], -1)[None]
                self._irises.append(_Iris(number, rows, columns, share.astype(np.float32), kept, grid))

    def lit(self, relit: Band, mirrored: Tensor) -> Band:
        """A relit image [H, W, 3], by rows, with the mirror images [N, 3, s, s] in its eyes."""
        images = [self._placed(iris, mirrored[iris.number]) for iris in self._irises]

        def of(rows: slice) -> np.ndarray:
            pixels = relit(rows)
            for iris, image in zip(self._irises, images, strict=True):
                first, last = max(rows.start, iris.rows.start), min(rows.stop, iris.rows.stop)
                if first < last:
                    part = pixels[first - rows.start : last - rows.start, iris.columns]
                    own = slice(first - iris.rows.start, last - iris.rows.start)
                    share, kept = iris.share[own, :, None], iris.kept[own, :, None]
                    part += share * (part * (kept - 1) + image[own])
            return pixels

        return of

    @staticmethod
    def _placed(iris: _Iris, mirrored: Tensor) -> np.ndarray:
        """The mirror image [h, w, 3] in the window of an iris, without what is finer than its pixels."""
        side = max(2, min(_SIDE, len(iris.share)))
        small = F.interpolate(mirrored[None], (side, side), mode="area")
        found = F.grid_sample(small, iris.grid, padding_mode="border", align_corners=False)
        return np.asarray(found[0].permute(1, 2, 0).numpy())


def _between(lids_px: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
    """Share [h, w] of the opening between lids, an outline [N, 2], in a window of the photo."""
    size = rows.stop - rows.start, columns.stop - columns.start
    corners = (lids_px - (columns.start, rows.start)) * _FINE - PIXEL_CENTRE
    inside = polygon2mask((size[0] * _FINE, size[1] * _FINE), corners[:, ::-1])
    return block_means(inside[..., None], _FINE)[..., 0]
