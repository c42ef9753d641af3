"""Faces of a prepared dataset under single lights, for S_f: read from their stacks, unwrapped in the step.

Workers read the crops of a few lights; the device unwraps them. Nothing is unwrapped or written before.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.dataset.crops import lit_mean_of
from facerf_cli.dataset.dataset import Dataset, provenance_of, read_dataset, read_stack
from facerf_cli.dataset.textures import heads_of, model_of
from facerf_cli.dataset.unwrapped import LEAST_INSIDE
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import grid_triangles, on_device
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.network.inputs import MEAN_RADIANCE, Batch
from facerf_cli.raster.camera import crop_camera
from facerf_cli.raster.texture import UnwrapSettings, unwrap
from facerf_cli.synth.bank.texture_samples import CAMERA, draw_target_lights

_FACES_KEPT = 512  # a worker, of .7 MB at 512 pixels
_AROUND_PX = 16  # rows read beyond the face, for texels that cross its border


@dataclass(frozen=True)
class LightTextures(Batch):
    """B faces under L single lights: textures [B, L, 3, T, T] linear, zero where unseen; lights [B, L, 3].

    The lights are unit vectors in the head's frame; `heads` [B] are the heads' indices.
    """

    textures: Tensor
    lights_head: Tensor
    heads: Tensor


@dataclass(frozen=True)
class LightCrops(Batch):
    """B faces under L single lights as stacks hold them: images [B, L, 3, S, S] float16, 0 far from the face.

    `colours` [B, 3, 3] are the matrices of a camera's colours and exposure. `seen` [B, 1, S, S] in 0..1 shows
    the face, `vertices` [B, V, 3] is its fitted mesh in the crop's camera.
    """

    images: Tensor
    colours: Tensor
    seen: Tensor
    vertices: Tensor
    lights_head: Tensor
    heads: Tensor

    def unwrapped(self, side: int) -> LightTextures:
        """The textures of the faces, where most of a texel's pixels lie on the face."""
        faces, lights = self.images.shape[:2]
        planes = torch.cat([self.images.flatten(1, 2).float(), self.seen], 1)
        camera, triangles = crop_camera(planes.shape[-1]), on_device(planes.device, grid_triangles)
        settings = UnwrapSettings(samples=math.ceil(camera.width_px / side), measured=False)
        found, _ = unwrap(planes, self.vertices, triangles, camera, side, settings)
        textures = found[:, :-1] * (found[:, -1:] > LEAST_INSIDE)
        textures = self.colours[:, None] @ textures.view(faces, lights, 3, -1)
        return LightTextures(textures.view(faces, lights, 3, side, side), self.lights_head, self.heads)


@dataclass(frozen=True, eq=False)
class LightStacks:
    """The stacks of a prepared dataset; heads are indices of `dataset.subjects`."""

    dataset: Dataset
    model: MorphableModel
    provenance: dict[str, Any]

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Heads of the split train, and at most `held_out` of the split validation."""
        return heads_of(self.dataset, held_out)

    def draw(self, head: Tensor, lights: int, generator: torch.Generator) -> LightCrops:
        """Read a head [1] under random lights of one of its cameras; the camera's colours are random, too."""
        subject = self.dataset.subjects[int(head)]
        cameras = self.dataset.cameras[subject]
        camera = cameras[int(torch.randint(len(cameras), (), generator=generator))]
        path = self.dataset.stack_path(subject, camera)
        face = _face_of(path, self.model)
        chosen = draw_target_lights(face.directions, min(lights, len(face.directions)), generator).tolist()
        directions = face.directions[chosen] @ face.rotation  # R^T w, of row vectors
        seen, colours = face.seen[None, None].float(), face.exposure * CAMERA.colours(generator)
        images = torch.zeros(1, len(chosen), 3, *face.seen.shape, dtype=torch.float16)
        images[0, ..., face.rows, :] = read_olats(path, chosen, face.rows)
        return LightCrops(images, colours[None], seen, face.vertices[None], directions[None], head)


@dataclass(frozen=True, eq=False)
class _Face:
    """The face of a stack: lights [L, 3], rotation [3, 3], seen [S, S] in `rows`, mesh [V, 3], exposure."""

    directions: Tensor
    rotation: Tensor
    seen: Tensor
    rows: slice
    vertices: Tensor
    exposure: float


@lru_cache(maxsize=_FACES_KEPT)  # every step of training needs some
def _face_of(path: Path, model: MorphableModel) -> _Face:
    header, fit = read_stack(path)
    exposure = MEAN_RADIANCE / lit_mean_of(path, header)  # raises where no row shows the face
    rows = np.flatnonzero(header.seen.any(1))
    return _Face(
        torch.from_numpy(header.directions).float(),
        torch.from_numpy(header.rotation).float(),
        torch.from_numpy(header.seen).half(),
        slice(max(int(rows[0]) - _AROUND_PX, 0), int(rows[-1]) + 1 + _AROUND_PX),
        fit.vertices_camera(model),
        exposure,
    )


def open_light_stacks(folder: Path, face_model: str) -> LightStacks:
    """Open the stacks of a prepared dataset whose fits are of a face model."""
    dataset = read_dataset(folder)
    model = model_of(dataset, face_model)
    return LightStacks(dataset, model, provenance_of(dataset, model))
