"""The face of a photo: its crop, the fitted face model, and its texture in UV space."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import GIVE_LANDMARKS
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import GRID, grid_triangles
from facerf_cli.image.strips import fitted, resized
from facerf_cli.raster.camera import project
from facerf_cli.raster.texture import bake_attributes, inpaint, normal_map, sample_texture, unwrap

_INSIDE_PHOTO = 0.99  # share of a texel's pixels that lie inside the photo, from which on it is visible
_SEEN_WELL = 0.9  # share of a texel that a mask must show


@dataclass(frozen=True)
class FaceTexture:
    """A photo in UV space: texture [3, T, T], hidden texels filled; visible [T, T]; normals [3, T, T].

    The texture is scene-linear, `visible` in 0..1; normals are unit vectors in camera space.
    """

    texture: Tensor
    visible: Tensor
    normals: Tensor


@dataclass(frozen=True, eq=False)
class OtherHead:
    """Another head of a photo, with landmarks [68, 2] in its pixels.

    `seen` holds an image and what is seen of the head there: each of the photo's people asks for the same.
    """

    landmarks_px: np.ndarray
    seen: list[np.ndarray] = field(default_factory=list)

    def scaled(self, scale: float) -> "OtherHead":
        """The head in the photo resized by a factor."""
        return replace(self, landmarks_px=self.landmarks_px * scale)


@dataclass(frozen=True, eq=False)
class Head:
    """The face of a photo: its crop [S, S, 3], scene-linear, the fitted face model, and its texture.

    `others` are the photo's other heads; None where nobody looked.
    """

    cropped: np.ndarray
    fit: FaceFit
    face: FaceTexture
    others: Sequence[OtherHead] | None = None

    @property
    def landmarks_px(self) -> np.ndarray:
        """Landmarks [68, 2] in the crop's pixels; see `FaceFit`."""
        landmarks_px: np.ndarray = self.fit.landmarks_px.numpy()
        return landmarks_px

    def without(self, model: MorphableModel, mask: np.ndarray) -> "Head":
        """The head without the texels that a mask [S, S] of the crop, 0..1, does not show.

        They are filled from those around them. Raises InputError where nothing of the face is left.
        """
        side = self.face.texture.shape[-1]
        image = torch.from_numpy(mask.astype(np.float32))[None]
        vertices = self.fit.vertices_camera(model)
        places = bake_attributes(project(vertices, self.fit.camera), GRID, side).movedim(0, -1)
        kept = sample_texture(image, places / self.fit.camera.width_px)[..., 0]
        visible = self.face.visible * (kept > _SEEN_WELL)
        if torch.equal(visible, self.face.visible):
            return self
        if visible.max() < 0.5:
            raise InputError("the face is masked out: no part of it is left; give another matte")
        texture = inpaint(self.face.texture, visible)
        return replace(self, face=replace(self.face, texture=texture, visible=visible))


def unwrap_face(
    model: MorphableModel, fit: FaceFit, cropped: np.ndarray, side: int, photo_shape: tuple[int, ...]
) -> FaceTexture:
    """Unwrap the crop of a photo to a texture (paper, 'Network Architecture').

    Args:
        model: The face model of the fit.
        fit: The face in the crop.
        cropped: The crop [S, S, 3], scene-linear.
        side: Texels of the texture's side.
        photo_shape: [H, W, ...] of the photo.

    Raises:
        InputError: The fitted face lies outside the photo.
    """
    vertices = fit.vertices_camera(model)
    inside = fit.crop.valid(*photo_shape[:2])  # outside the photo the crop only repeats its border
    image = torch.from_numpy(np.dstack([cropped, inside.astype(np.float32)])).permute(2, 0, 1)
    unwrapped, visible = unwrap(image, vertices, grid_triangles(), fit.camera, side)
    texture, visible = unwrapped[:3], visible * (unwrapped[3] > _INSIDE_PHOTO)
    if visible.max() < 0.5:
        raise InputError(f"the fitted face lies outside the image; {GIVE_LANDMARKS}")
    normals = normal_map(vertices, grid_triangles(), side)
    return FaceTexture(inpaint(texture, visible), visible, normals)


def shrunk_photo(photo: np.ndarray, head: Head, most_px: int) -> tuple[np.ndarray, Head]:
    """A photo [H, W, 3] of `most_px` at most, and its head in the pixels of the smaller one."""
    height, width = fitted(photo.shape[0], photo.shape[1], most_px)
    if (height, width) == photo.shape[:2]:
        return photo, head
    scale = width / photo.shape[1]
    fit = replace(head.fit, crop=head.fit.crop.of_scaled(scale))
    others = None if head.others is None else [one.scaled(scale) for one in head.others]
    return resized(photo, height, width), replace(head, fit=fit, others=others)
