"""A photo's face: its crop, the fitted face model, and its texture in UV space."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import PASS_LANDMARKS
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import GRID, grid_triangles
from facerf_cli.image.strips import fitted, resized
from facerf_cli.raster.camera import project
from facerf_cli.raster.texture import bake_attributes, inpaint, normal_map, sample_texture, unwrap

_INSIDE_PHOTO = 0.99  # fraction of a visible texel that lies at least inside the photo
_INSIDE_MASK = 0.9  # fraction of a texel above which it is inside a mask


@dataclass(frozen=True)
class FaceTexture:
    """A photo's face in UV space."""

    texture: Tensor  # [3, T, T], scene-linear; hidden texels are inpainted
    visible: Tensor  # [T, T] in 0..1
    normals: Tensor  # [3, T, T], unit vectors in camera space


@dataclass(frozen=True, eq=False)
class OtherHead:
    """Another head of a photo; `seen` caches an image and the coverage of the head's person in it."""

    landmarks_px: np.ndarray  # [68, 2] in the photo's pixels
    seen: list[np.ndarray] = field(default_factory=list)

    def scaled(self, scale: float) -> "OtherHead":
        """Return the head in the scaled photo."""
        return replace(self, landmarks_px=self.landmarks_px * scale)


@dataclass(frozen=True, eq=False)
class Head:
    """A photo's face as fitted."""

    cropped: np.ndarray  # [S, S, 3], the crop, scene-linear
    fit: FaceFit
    face: FaceTexture
    others: Sequence[OtherHead] | None = None  # the photo's other heads; None: not detected

    @property
    def landmarks_px(self) -> np.ndarray:
        """Landmarks [68, 2] in the crop's pixels; see `FaceFit`."""
        landmarks_px: np.ndarray = self.fit.landmarks_px.numpy()
        return landmarks_px

    def without(self, model: MorphableModel, mask: np.ndarray) -> "Head":
        """Return a copy that hides and inpaints the texels outside a mask [S, S] of the crop, in 0..1.

        Raises InputError if no part of the face remains.
        """
        side = self.face.texture.shape[-1]
        image = torch.from_numpy(mask.astype(np.float32))[None]
        vertices = self.fit.vertices_camera(model)
        texel_px = bake_attributes(project(vertices, self.fit.camera), GRID, side).movedim(0, -1)
        inside = sample_texture(image, texel_px / self.fit.camera.width_px)[..., 0]
        visible = self.face.visible * (inside > _INSIDE_MASK)
        if torch.equal(visible, self.face.visible):
            return self
        if visible.max() < 0.5:
            raise InputError("the face is masked out completely; use another matte")
        texture = inpaint(self.face.texture, visible)
        return replace(self, face=replace(self.face, texture=texture, visible=visible))


def unwrap_face(
    model: MorphableModel, fit: FaceFit, cropped: np.ndarray, side: int, photo_shape: tuple[int, ...]
) -> FaceTexture:
    """Unwrap a crop [S, S, 3] to a texture of `side` texels (paper, 'Network Architecture').

    `photo_shape` is [H, W, ...] of the photo. Raises InputError if the fitted face lies outside the photo.
    """
    vertices = fit.vertices_camera(model)
    inside = fit.crop.valid(*photo_shape[:2])  # outside the photo, the crop only repeats its border
    image = torch.from_numpy(np.dstack([cropped, inside.astype(np.float32)])).permute(2, 0, 1)
    unwrapped, visible = unwrap(image, vertices, grid_triangles(), fit.camera, side)
    texture, visible = unwrapped[:3], visible * (unwrapped[3] > _INSIDE_PHOTO)
    if visible.max() < 0.5:
        raise InputError(f"the fitted face lies outside the image; {PASS_LANDMARKS}")
    normals = normal_map(vertices, grid_triangles(), side)
    return FaceTexture(inpaint(texture, visible), visible, normals)


def shrunk_photo(photo: np.ndarray, head: Head, most_px: int) -> tuple[np.ndarray, Head]:
    """Shrink a photo [H, W, 3] to at most `most_px` a side, and convert its head to the smaller pixels."""
    height, width = fitted(photo.shape[0], photo.shape[1], most_px)
    if (height, width) == photo.shape[:2]:
        return photo, head
    scale = width / photo.shape[1]
    fit = replace(head.fit, crop=head.fit.crop.of_scaled(scale))
    others = None if head.others is None else [other.scaled(scale) for other in head.others]
    return resized(photo, height, width), replace(head, fit=fit, others=others)
