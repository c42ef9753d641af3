"""A relit face in its photo, whose hair and background follow the change of its light.

So a person is relit whose reflectance is the face's alone: the paper's field, and the models that it is
compared with.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor

from facerf_cli.baselines.base import Reflectance
from facerf_cli.face.crop import Crop
from facerf_cli.face.head import Head
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.view import photo_camera, view_face
from facerf_cli.image.colour import ExposureRule
from facerf_cli.image.strips import Rows, Window
from facerf_cli.light.studio_points import Lights
from facerf_cli.portrait.matte import PersonColours
from facerf_cli.raster.camera import CROP_FOCAL_PER_SIDE, PIXEL_CENTRE, Camera
from facerf_cli.raster.texture import inpaint, smoothstep
from facerf_cli.relighting.detail import TINY, FaceDetail
from facerf_cli.relighting.face_alone import exposure_of_face, face_layer, relit_faces, require_face_layers
from facerf_cli.relighting.field import Field
from facerf_cli.relighting.relightable import Relit

_DARK = 0.08  # of the mean source, added before the change of light is taken
_SURROUND = 3  # crops along each side of the square in which hair and background follow the face's light
_SURROUND_PX = 64  # pixels along a crop there
_SPREAD = 0.04  # standard deviation of the blur of the change of light, in crop sides
_REACH = 0.22  # of that change to the side, in crop sides; beyond it all follows the mean change
_DARKER, _BRIGHTER = 12.0, 1.6  # that change is at most so far below and above the mean change of a light
_UPRIGHT = 0.4  # of a step up or down, as a share of a step aside: above and below are hair and neck


@dataclass(frozen=True, eq=False)
class FaceLight:
    """A face under one sum of lights, ready to be rendered by rows."""

    change: Tensor
    face: Tensor
    own: Tensor | None
    layers: Sequence[str]


class FaceInPhoto:
    """A face in its photo [H, W, 3]; `matte` [H, W] says what follows its light, None: all of the photo."""

    def __init__(
        self,
        model: MorphableModel,
        photo: np.ndarray,
        head: Head,
        reflectance: Reflectance,
        matte: np.ndarray | None = None,
    ) -> None:
        self.size_px = photo.shape[0], photo.shape[1]
        self.photo, self._head, self._reflectance = photo, head, reflectance
        self.matte = np.broadcast_to(np.float32(1), self.size_px) if matte is None else matte
        self.own: Rows = photo if matte is None else PersonColours(photo, matte)
        self.vertices_m = head.fit.vertices_camera(model)
        crop = head.fit.crop
        self.view = view_face(self.vertices_m, photo_camera(crop, *self.size_px), crop.side_px)
        self._detail = FaceDetail(head.face, self.view)
        face = reflectance.face if isinstance(reflectance, Field) else head.face
        self.surround = Surround(self.vertices_m, crop, face.texture, self.size_px[1])

    @property
    def nbytes(self) -> int:
        """Bytes of one texture and the light around it."""
        return self._head.face.texture.nbytes + self.surround.nbytes

    def share(self, rows: slice) -> np.ndarray:
        """Share [h, W] of the face in rows of the photo."""
        window = Window(rows, slice(0, self.size_px[1]))
        return np.minimum(self.matte[rows], face_layer(self.view, "face", window)["face.A"])

    def relit(self, lights: Lights) -> Iterator[Relit]:
        """Relight face and surround by each sum of lights."""
        changes = self.surround.changes
        return relit_faces(self._reflectance, lights, self.vertices_m, self._head, changes=changes)

    def ready(self, relit: Relit, layers: Sequence[str] = ()) -> FaceLight:
        """Compute all that does not depend on rows; raises UsageError for layers of people."""
        require_face_layers(layers)
        assert relit.change is not None
        return FaceLight(relit.change, self._detail.ready(relit.texture), relit.own, layers)

    def render(
        self, window: Window, own: np.ndarray, lights: Sequence[FaceLight]
    ) -> Iterator[dict[str, np.ndarray]]:
        """Yield rows of the photo, whose person has its `own` colours [h, W, 3], under each light."""
        part = window.common(self.view.window)
        share = self.view.mask[part.inside(self.view.window)].numpy()[..., None]
        at = part.inside(window)
        if on_face := all(part.shape):
            face = self._detail.over(part, own[at])
        for light in lights:
            found = self.surround.over_photo(own, light.change, window.rows)
            if on_face:
                found[at] += share * (face(light.face) - found[at])
            if light.own is not None and light.own.any():
                found = found + light.own.detach().numpy() * own
            image = {"rgb": found}
            for name in light.layers:
                image |= face_layer(self.view, name, window)
            yield image

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        """The exposure in EV, by a rule, of the face's texture."""
        return exposure_of_face(self._head, relit, rule)


class Surround:
    """The change of light on the face, spread outward and blurred: hair, neck and background follow it.

    With distance it becomes the mean change. Next to the face it stays near the mean, since a bright rim
    there looks like a glow. The bounds apply to each light, so sums over lights stay linear.
    """

    def __init__(self, vertices_camera: Tensor, crop: Crop, source: Tensor, width_px: int) -> None:
        side = _SURROUND * _SURROUND_PX
        camera = Camera(CROP_FOCAL_PER_SIDE * _SURROUND_PX, side, side, side / 2, side / 2)
        self._view = view_face(vertices_camera, camera, _SURROUND_PX)
        self._mask = torch.from_numpy(self._view.full(self._view.mask))
        outside = (self._mask < 0.5).numpy()
        away_px = torch.from_numpy(distance_transform_edt(outside, sampling=(_UPRIGHT, 1.0))).float()
        self._near = 1 - smoothstep(away_px / (_REACH * _SURROUND_PX))
        self._crop, self._width_px = crop, width_px
        self._mean_source, self._around_source = self._mean_and_blur(source[None])

    def changes(self, olats: Tensor) -> Tensor:
        """The change of light [L, 3, s, s] from the source to each of OLAT textures [L, 3, T, T]."""
        mean, around = self._mean_and_blur(olats)
        floor = _DARK * self._mean_source
        change = mean / self._mean_source.clamp(min=TINY)
        local = (around + floor * change) / (self._around_source + floor).clamp(min=TINY)
        local = local.minimum(change * _BRIGHTER).maximum(change / _DARKER)
        return torch.lerp(change.expand_as(local), local, self._near)

    @property
    def nbytes(self) -> int:
        """Size of one change of light."""
        return 3 * self._mask.nbytes

    def over_photo(self, photo: np.ndarray, change: Tensor, rows: slice) -> np.ndarray:
        """Rows of the photo, which are [h, W, 3], under a change of light [3, s, s]."""
        grid = _photo_grid(self._crop, rows, self._width_px)
        over = F.grid_sample(change[None], grid, mode="bicubic", padding_mode="border", align_corners=False)
        # bicubic weights undershoot a little
        return np.asarray(photo * over[0].permute(1, 2, 0).clamp(min=0).numpy())

    def _mean_and_blur(self, textures: Tensor) -> tuple[Tensor, Tensor]:
        """Mean colours [N, 3, 1, 1] of textures [N, 3, T, T] on the face, and their blur [N, 3, s, s]."""
        rendered = self._view.full(self._view.render(textures.flatten(0, 1)))
        planes = torch.from_numpy(rendered).permute(2, 0, 1)
        mean = (planes * self._mask).sum((1, 2)) / self._mask.sum().clamp(min=TINY)
        sigma = _SPREAD * _SURROUND_PX
        blurred = gaussian_filter(inpaint(planes, self._mask).numpy(), (0, sigma, sigma), mode="nearest")
        shape = (len(textures), 3)
        return mean.view(*shape, 1, 1), torch.from_numpy(blurred).view(*shape, *self._mask.shape)


def _photo_grid(crop: Crop, rows: slice, width_px: int) -> Tensor:
    """The place of pixels of the photo's rows in the surround's square, for grid_sample [1, h, W, 2]."""
    x = ((torch.arange(width_px) + PIXEL_CENTRE - crop.x0_px) / crop.side_px - 0.5) * (2 / _SURROUND)
    y = ((torch.arange(rows.start, rows.stop) + PIXEL_CENTRE - crop.y0_px) / crop.side_px - 0.5) * (
        2 / _SURROUND
    )
    return torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, width_px)], -1)[None].float()
