"""Stand-ins for what relights the people of Extended Yale B: anybody's face, a method of no cost."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from facerf_cli.capture.yale_b import HEIGHT_PX, WIDTH_PX
from facerf_cli.face.landmarks import Face
from facerf_cli.face.morphable import load_face_model
from facerf_cli.raster.camera import Camera, project


@dataclass(frozen=True, eq=False)
class Lambert:
    """A method whose face is white and without shape: the cosine of the light to the camera."""

    name: str
    models: Any

    def reflectance(self, fit: Any, face: Any, held_to_photo: bool) -> "Lambert":
        assert held_to_photo and face.texture.shape == (3, 256, 256)
        return self

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        cosines = torch.einsum("mlc,l->mc", weights, directions[:, 2].clamp_min(0))
        return cosines[..., None, None].expand(-1, -1, 256, 256)


@dataclass(frozen=True, eq=False)
class Networks:
    """Models without a network: the landmarks alone are fitted."""

    face: Any
    geometry: None = None


def someone() -> Face:
    """The mean face, seen by a camera that it fills."""
    model = load_face_model("builtin")
    points = model.landmarks(model.mean[None])[0] + torch.tensor([0, 0, -0.9])
    landmarks_px = project(points, Camera(4.0 * WIDTH_PX, WIDTH_PX, HEIGHT_PX, WIDTH_PX / 2, HEIGHT_PX / 2))
    return Face(landmarks_px.numpy(), (0, 0, WIDTH_PX, HEIGHT_PX), 1.0)
