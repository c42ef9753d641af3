"""A face and a method without networks, for the people of Extended Yale B."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.capture.yale_b import HEIGHT_PX, WIDTH_PX
from facerf_cli.face.head import Head
from facerf_cli.face.morphable import load_face_model
from facerf_cli.light.sphere import RigLight
from facerf_cli.pipeline import Person
from facerf_cli.portrait.find import Face
from facerf_cli.raster.camera import Camera, project
from facerf_cli.relighting.composition import Target


@dataclass(frozen=True, eq=False)
class Lambert:
    """A method whose face is white and flat: the cosine of the light to the camera's axis."""

    name: str
    models: Any

    def images(
        self,
        photo: np.ndarray,
        head: Head,
        directions: Tensor,
        weights: Tensor,
        target: Target,
        network_alone: bool,
    ) -> Iterator[np.ndarray]:
        assert not network_alone and head.face.texture.shape == (3, 256, 256)
        for row in weights:
            light = RigLight(directions, row)
            yield Person(self.models, photo, head, self).image(light, target).pixels

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        cosines = torch.einsum("mlc,l->mc", weights, directions[:, 2].clamp_min(0))
        return cosines[..., None, None].expand(-1, -1, 256, 256)


def someone() -> Face:
    """The mean face, seen by a camera that it fills."""
    model = load_face_model("builtin")
    points = model.landmarks(model.mean[None])[0] + torch.tensor([0, 0, -0.9])
    landmarks_px = project(points, Camera(4.0 * WIDTH_PX, WIDTH_PX, HEIGHT_PX, WIDTH_PX / 2, HEIGHT_PX / 2))
    return Face((0, 0, WIDTH_PX, HEIGHT_PX), 1.0, landmarks_px.numpy())
