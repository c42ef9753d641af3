"""The relit face back in its photo, at the photo's own resolution.

The network's texture is coarser than the photo. What it says about light is therefore carried over as a
change: where the source texture was S and is R after relighting, a photo pixel P becomes

    R + g (P - S)  with  g = (R + k e) / (S + e),    k = mean R / mean S,

the render plus the photo's own detail. With a bright source this is P R / S; where the source is nearly black
(e is a small share of its mean) the quotient would be noise, and the render takes over. Own light returns P.
"""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor

from facerf_cli.face.crop import Crop
from facerf_cli.face.topology import region_mask
from facerf_cli.face.view import FaceView, smooth, view_face
from facerf_cli.raster.camera import CROP_FOCAL_PER_SIDE, PIXEL_CENTRE, Camera
from facerf_cli.raster.texture import inpaint

_OWN_REGIONS = ("eyes", "mouth", "brows")
_TINY = 1e-8
_OWN_SIDE = 128  # of masks; finer ones take seconds to draw
_SURROUND = 3  # crops along each side of the square in which hair and background follow the face's light
_UPRIGHT = 0.4  # a step up or down counts for so much: there are hair and neck, to the side is background
_SURROUND_PX = 64  # along a crop there


@dataclass(frozen=True)
class CompositeSettings:
    """Lengths (spread, reach) are shares of the crop's side."""

    dark: float = 0.08  # e above, a share of the source's mean
    spread: float = 0.04  # standard deviation of the blur of the change of light around the face
    reach: float = 0.22  # of that change to the side; further off all follows the mean change
    darker: float = 12.0  # hair and background follow at most so far below the mean change,
    brighter: float = 1.6  # and so far above it: a bright rim beside the face reads as a glow


def change_of_light(
    source: Tensor, relit: Tensor, seen: Tensor, settings: CompositeSettings = CompositeSettings()
) -> tuple[Tensor, Tensor]:
    """Gain and offset [3, T, T] that take the photo's pixels to the relit ones: P -> gain P + offset.

    source, relit [3, T, T] linear; seen [T, T] in 0..1. Eyes, brows and teeth stay the photo's: their gain is
    that of the skin around them, without offset.
    """
    own = torch.stack([region_mask(name, _OWN_SIDE) for name in _OWN_REGIONS]).amax(0)
    own = F.interpolate(own[None, None], source.shape[1:], mode="bilinear", align_corners=False)[0, 0]
    trusted = seen * (1 - own)
    gain, offset = _gain_and_offset(source, relit, trusted, settings.dark)
    floor = settings.dark * (source * trusted).sum() / (3 * trusted.sum().clamp(min=_TINY)) + _TINY
    around = inpaint(relit, trusted) / inpaint(source, trusted).clamp(min=float(floor))
    return torch.lerp(gain, around, own), offset * (1 - own)


def _gain_and_offset(source: Tensor, relit: Tensor, weight: Tensor, dark: float) -> tuple[Tensor, Tensor]:
    total = weight.sum().clamp(min=_TINY)
    mean_source = (source * weight).sum((1, 2), keepdim=True) / total
    mean_relit = (relit * weight).sum((1, 2), keepdim=True) / total
    floor = dark * mean_source.mean() + _TINY
    gain = (relit + floor * mean_relit / mean_source.clamp(min=_TINY)) / (source + floor)
    return gain, relit - gain * source


def composite(
    photo: np.ndarray,
    source: Tensor,
    relit: Tensor,
    seen: Tensor,
    view: FaceView,
    surround: "Surround | None",
    matte: np.ndarray | None = None,
    settings: CompositeSettings = CompositeSettings(),
) -> np.ndarray:
    """The photo [H, W, 3] with its face relit [H, W, 3], linear.

    `surround` None leaves everything outside the face's mask as it was, bit for bit. A `matte` [H, W] is what
    the light may change, whatever the face's mask says.
    """
    gain, offset = change_of_light(source, relit, seen, settings)
    change = view.render(torch.cat([gain, offset]))
    low = np.float32(1) if surround is None else surround.gain(source, relit)
    result = photo * low
    mask = view.mask.numpy()[..., None]
    face = photo[view.window] * change[..., :3].numpy() + change[..., 3:].numpy()
    result[view.window] += mask * (face.clip(min=0) - result[view.window])
    return result if matte is None else photo + matte[..., None] * (result - photo)


class Surround:
    """How hair, neck and background follow: the face's change of light, spread outward and blurred.

    With distance it becomes the mean change.
    """

    def __init__(
        self,
        vertices_camera: Tensor,
        crop: Crop,
        height_px: int,
        width_px: int,
        settings: CompositeSettings = CompositeSettings(),
    ) -> None:
        side = _SURROUND * _SURROUND_PX
        self._settings = settings
        camera = Camera(CROP_FOCAL_PER_SIDE * _SURROUND_PX, side, side, side / 2, side / 2)
        self._view = view_face(vertices_camera, camera, _SURROUND_PX)
        self._mask = torch.from_numpy(self._view.full(self._view.mask))
        outside = (self._mask < 0.5).numpy()
        away_px = torch.from_numpy(distance_transform_edt(outside, sampling=(_UPRIGHT, 1.0))).float()
        self._near = 1 - smooth(away_px / (settings.reach * _SURROUND_PX))
        self._grid = self._photo_grid(crop, height_px, width_px)

    def gain(self, source: Tensor, relit: Tensor) -> np.ndarray:
        """The change of light [H, W, 3] over the photo, for textures [3, T, T]."""
        pair = torch.from_numpy(self._view.full(self._view.render(torch.cat([source, relit]))))
        pair = pair.permute(2, 0, 1)
        mean = (pair * self._mask).sum((1, 2), keepdim=True) / self._mask.sum().clamp(min=_TINY)
        filled = inpaint(pair, self._mask).numpy()
        sigma = self._settings.spread * _SURROUND_PX
        blurred = torch.from_numpy(gaussian_filter(filled, (0, sigma, sigma), mode="nearest"))
        floor = self._settings.dark * mean[:3]
        change = mean[3:] / mean[:3].clamp(min=_TINY)
        local = (blurred[3:] + floor * change) / (blurred[:3] + floor).clamp(min=_TINY)
        local = local.minimum(change * self._settings.brighter).maximum(change / self._settings.darker)
        field = torch.lerp(change.expand_as(local), local, self._near)
        spread = F.grid_sample(
            field[None], self._grid, mode="bicubic", padding_mode="border", align_corners=False
        )
        return spread[0].permute(1, 2, 0).clamp(min=0).numpy()

    @staticmethod
    def _photo_grid(crop: Crop, height_px: int, width_px: int) -> Tensor:
        """Where each pixel of the photo lies in the square, for grid_sample [1, H, W, 2]."""
        x = ((torch.arange(width_px) + PIXEL_CENTRE - crop.x0_px) / crop.side_px - 0.5) * (2 / _SURROUND)
        y = ((torch.arange(height_px) + PIXEL_CENTRE - crop.y0_px) / crop.side_px - 0.5) * (2 / _SURROUND)
        return torch.stack([x.expand(height_px, -1), y[:, None].expand(-1, width_px)], -1)[None].float()
