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
from facerf_cli.face.regions import region_mask
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.raster.camera import CROP_FOCAL_PER_SIDE, PIXEL_CENTRE, Camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import inpaint, sample_texture, vertex_normals

_OWN_REGIONS = ("eyes", "mouth", "brows")
_TINY = 1e-8
_MASK_SIDE, _OWN_SIDE = 256, 128  # of masks; finer ones take seconds to draw
_SURROUND = 3  # crops along each side of the square in which hair and background follow the face's light
_UPRIGHT = 0.4  # a step up or down counts for so much: there are hair and neck, to the side is background
_SURROUND_PX = 64  # along a crop there


@dataclass(frozen=True)
class CompositeSettings:
    """Lengths (feather, spread, reach) are shares of the crop's side."""

    dark: float = 0.08  # e above, a share of the source's mean
    feather: float = 0.04  # of the mask's border, inward
    spread: float = 0.04  # standard deviation of the blur of the change of light around the face
    reach: float = 0.22  # of that change to the side; further off all follows the mean change
    darker: float = 12.0  # hair and background follow at most so far below the mean change,
    brighter: float = 1.6  # and so far above it: a bright rim beside the face reads as a glow


@dataclass(frozen=True, eq=False)
class FaceView:
    """A fitted face seen by its photo's camera; one z-buffer serves every texture.

    All tensors cover the window [h, w] of the photo [H, W] at `top`, `left`.
    """

    height_px: int
    width_px: int
    top: int
    left: int
    uv: Tensor  # [h, w, 2]
    normal: Tensor  # [h, w, 3] camera space
    position_m: Tensor  # [h, w, 3] camera space
    coverage: Tensor  # [h, w] 0 or 1
    mask: Tensor  # [h, w] 0..1, the face inside jaw and hairline with a soft border

    def render(self, texture: Tensor) -> Tensor:
        """A texture [C, T, T] in the window [h, w, C], zero off the mesh."""
        return sample_texture(texture, self.uv) * self.coverage[..., None]

    def full(self, window: Tensor) -> np.ndarray:
        """Values of the window [h, w, ...] in the photo's frame [H, W, ...], zero beyond it."""
        frame = np.zeros((self.height_px, self.width_px, *window.shape[2:]), np.float32)
        frame[self.window] = window.numpy()
        return frame

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the photo."""
        height, width = self.coverage.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)


def photo_camera(crop: Crop, height_px: int, width_px: int) -> Camera:
    """The crop's camera, continued over the whole photo in the photo's pixels."""
    half = crop.side_px / 2
    focal_px = crop.camera.focal_px / crop.scale
    return Camera(focal_px, width_px, height_px, crop.x0_px + half, crop.y0_px + half)


def view_face(
    vertices_camera: Tensor,
    camera: Camera,
    side_px: float,
    settings: CompositeSettings = CompositeSettings(),
) -> FaceView:
    """See the mesh [V, 3] with a camera; `side_px` is the crop's side in its pixels."""
    top, left, window = _window(vertices_camera, camera)
    triangles = grid_triangles()
    fragments = rasterize(vertices_camera, triangles, window)
    attributes = torch.cat([grid_uv(), vertex_normals(vertices_camera, triangles), vertices_camera], 1)
    seen = interpolate(attributes, triangles, fragments)
    uv, normal, position_m = seen[..., :2], seen[..., 2:5], seen[..., 5:]
    coverage = fragments.covered.float()
    mask = sample_texture(region_mask("face", _MASK_SIDE)[None], uv)[..., 0]
    inside = (mask * coverage > 0.02).numpy()
    if not inside.all():  # the chart's border is steep where the face turns away, so it is softened in pixels
        edge_px = torch.from_numpy(distance_transform_edt(inside)).float()
        mask = mask * _smooth(edge_px / max(settings.feather * side_px, 1))
    unit = F.normalize(normal, dim=-1)
    return FaceView(camera.height_px, camera.width_px, top, left, uv, unit, position_m, coverage, mask)


def _window(vertices_camera: Tensor, camera: Camera) -> tuple[int, int, Camera]:
    """First row and column of the part of the picture that holds the mesh, a pixel to spare; its camera."""
    in_front = torch.cat([vertices_camera[:, :2], vertices_camera[:, 2:].clamp(max=-_TINY)], 1)
    x, y = project(in_front, camera).T
    left, right = (int(v.floor().clamp(0, camera.width_px - 1)) for v in (x.min() - 1, x.max() + 1))
    top, bottom = (int(v.floor().clamp(0, camera.height_px - 1)) for v in (y.min() - 1, y.max() + 1))
    width, height = right + 1 - left, bottom + 1 - top
    return top, left, Camera(camera.focal_px, width, height, camera.cx_px - left, camera.cy_px - top)


def _smooth(x: Tensor) -> Tensor:
    x = x.clamp(0, 1)
    return x * x * (3 - 2 * x)


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
        self._view = view_face(vertices_camera, camera, _SURROUND_PX, settings)
        self._mask = torch.from_numpy(self._view.full(self._view.mask))
        outside = (self._mask < 0.5).numpy()
        away_px = torch.from_numpy(distance_transform_edt(outside, sampling=(_UPRIGHT, 1.0))).float()
        self._near = 1 - _smooth(away_px / (settings.reach * _SURROUND_PX))
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
