"""Methods without networks that record what the protocols ask of them, and people of known albedo."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.baselines import Kind
from facerf_cli.baselines.base import Explained
from facerf_cli.capture.yale_b import HEIGHT_PX, WIDTH_PX
from facerf_cli.evaluation.people import ComparedFace, DatasetPerson, Method
from facerf_cli.face.fit import Geometry
from facerf_cli.face.head import FaceTexture, Head
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.light.light import Light
from facerf_cli.light.sphere import RigLight
from facerf_cli.person import Person, Target
from facerf_cli.portrait.find import Face
from facerf_cli.raster.camera import Camera, project
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Networks, Sides

LIGHTS = torch.eye(3)
BRIGHTEST = torch.tensor([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Unlit:
    """A reflectance that returns the photo's texture under any light, times `gain`."""

    face: FaceTexture
    gain: float = 1.0
    asked: list[tuple[Tensor, Tensor, Tensor | None]] = field(default_factory=list)

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        self.asked.append((directions, weights, turn))
        return self.gain * self.face.texture.expand(len(weights), -1, -1, -1)


@dataclass(frozen=True, eq=False)
class FaceModelOnly:
    """Models without a network: the landmarks alone are fitted, and images are rendered."""

    face: MorphableModel
    geometry: None = None
    default_geometry: Geometry = "landmarks"
    networks: Networks = SHIPPED_NETWORKS
    device: str = "cpu"

    def sides(self, texture_side: int | None = None) -> Sides:
        return Sides(256, 512)


@dataclass(frozen=True, eq=False)
class Double(Method):
    """A method whose reflectance is `Unlit`; its light is brighter with each photo, to tell them apart.

    Images are rendered as the product renders them, by `models.face`.
    """

    name: str
    kind: Kind = "field"
    models: Any = None
    gain: float = 1.0
    made: list[Explained] = field(default_factory=list)

    def explain(self, head: Head) -> Explained:
        weights = torch.tensor([0.1, 0.2, 1.0])[:, None].expand(3, 3) * (1 + len(self.made))
        self.made.append(Explained(Unlit(head.face, self.gain), RigLight(LIGHTS, weights)))
        return self.made[-1]

    def images(
        self, photo: np.ndarray | None, head: Head, lights: Light, target: Target
    ) -> Iterator[np.ndarray]:
        for row in lights.weights:
            light = RigLight(lights.directions, row)
            framed_by = photo if target.fit is None else None
            yield Person(self.models, framed_by, head, self.reflectance(head)).image(light, target)

    def reflectance(self, head: Head) -> Any:
        return Unlit(head.face, self.gain)


@dataclass(frozen=True, eq=False)
class PersonOfAlbedo(DatasetPerson):
    """A person whose sources are images of the albedo, computed from the stack's frontal light."""

    def source(self, pair: Any) -> np.ndarray:
        path = self.dataset.stack_path(self.name, pair.source_camera)
        front, cosine = self._frontal(pair.source_camera)
        lit = read_olats(path, slice(front, front + 1))[0].float().permute(1, 2, 0).numpy()
        albedo = np.where(cosine[..., None] > 0.02, lit / np.maximum(cosine, 0.02)[..., None], 0)
        return albedo.astype(np.float32)

    def source_of(self, pair: Any) -> ComparedFace:
        face = super().source_of(pair)
        lit = self._frontal(pair.source_camera)[1] > 0.02
        assert face.photo.alpha is not None
        return replace(face, photo=replace(face.photo, alpha=face.photo.alpha * lit))

    def _frontal(self, camera: str) -> tuple[int, np.ndarray]:
        """The light nearest to the camera's axis, and its cosine to each pixel's normal."""
        header = self.header(camera)
        front = int(header.directions[:, 2].argmax())
        return front, header.normals @ header.directions[front]


class Lambert(Double):
    """A method whose face is white and flat: the cosine of the light to the camera's axis."""

    def reflectance(self, head: Head) -> Any:
        assert head.face.texture.shape == (3, 256, 256)
        return self

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        cosines = torch.einsum("mlc,l->mc", weights, directions[:, 2].clamp_min(0))
        return cosines[..., None, None].expand(-1, -1, 256, 256)


def someone() -> Face:
    """The mean face, seen by a camera that it fills."""
    model = load_face_model("builtin")
    points = model.landmarks(model.mean[None])[0] + torch.tensor([0, 0, -0.9])
    landmarks_px = project(points, Camera(4.0 * WIDTH_PX, WIDTH_PX, HEIGHT_PX, WIDTH_PX / 2, HEIGHT_PX / 2))
    return Face((0, 0, WIDTH_PX, HEIGHT_PX), 1.0, landmarks_px.numpy())
