"""Methods that answer at once, and what the protocols asked of them."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.baselines.base import Explained
from facerf_cli.evaluation.people import Person
from facerf_cli.face.fit import FaceFit
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.light.sphere import RigLight
from facerf_cli.pipeline import FaceTexture

LIGHTS = torch.eye(3)
BRIGHTEST = torch.tensor([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Unlit:
    """A reflectance that gives the photo's texture back under any light, times `gain`."""

    face: FaceTexture
    gain: float = 1.0
    asked: list[tuple[Tensor, Tensor, Tensor | None]] = field(default_factory=list)

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        self.asked.append((directions, weights, turn))
        return self.gain * self.face.texture.expand(len(weights), -1, -1, -1)


@dataclass(frozen=True, eq=False)
class Double:
    """A method whose reflectance is `Unlit`; its light is brighter with each photo, to tell them apart."""

    name: str
    models: Any = None
    kind: str = "field"
    gain: float = 1.0
    made: list[Explained] = field(default_factory=list)

    def reflectance(self, fit: FaceFit, face: FaceTexture, held_to_photo: bool) -> Unlit:
        return Unlit(face, self.gain)

    def explained(self, fit: FaceFit, face: FaceTexture, held_to_photo: bool = False) -> Explained:
        weights = torch.tensor([0.1, 0.2, 1.0])[:, None].expand(3, 3) * (1 + len(self.made))
        self.made.append(Explained(Unlit(face, self.gain), RigLight(LIGHTS, weights)))
        return self.made[-1]


@dataclass(frozen=True, eq=False)
class PersonOfAlbedo(Person):
    """A person whose sources are pictures of the albedo, as the stack under one front light tells it."""

    def source(self, pair: Any) -> tuple[np.ndarray, FaceTexture]:
        shot = self.shot(pair.source_camera)
        path = self.dataset.stack_path(self.name, pair.source_camera)
        front = int(shot.header.directions[:, 2].argmax())
        lit = read_olats(path, slice(front, front + 1))[0].float().permute(1, 2, 0).numpy()
        cosine = shot.header.normals @ shot.header.directions[front]
        albedo = np.where(cosine[..., None] > 0.02, lit / np.maximum(cosine, 0.02)[..., None], 0)
        seen = replace(shot.view, seen=shot.view.seen * (cosine > 0.02)).texture_of(albedo.astype(np.float32))
        return albedo.astype(np.float32), seen
