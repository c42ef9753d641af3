"""The training samples of the texture stages from a prepared dataset's textures (`dataset/unwrapped.py`).

Samples take the place of the synthetic ones of `synth/bank/texture_samples.py`, with photographed instead of
rendered lights. A source is an unwrapped image of `relight-dataset`; for lazy pairs it is the weighted sum of
the stack's textures, which is the same, for unwrapping is linear. Without pairs a random light is drawn, as
for synthetic heads.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor

from facerf_cli.dataset.dataset import Dataset, people_of, provenance_of, read_dataset
from facerf_cli.dataset.pairs import load_pairs
from facerf_cli.dataset.unwrapped import UnwrappedView, build_textures, sources_path, texture_path
from facerf_cli.errors import InputError
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import grid_triangles
from facerf_cli.light.sphere import RIG_LIGHTS
from facerf_cli.light.transport import BakeSettings
from facerf_cli.raster.texture import inpaint, normal_map
from facerf_cli.synth.bank.heads import HeadBakeSettings, bake_head
from facerf_cli.synth.bank.texture_samples import Sample, draw_light, draw_target_lights, simulate_camera


def heads_of(dataset: Dataset, held_out: int) -> tuple[Tensor, Tensor]:
    """Places in `subjects` of the people to train on, and of at most `held_out` to validate on."""
    places = {subject: place for place, subject in enumerate(dataset.subjects)}
    train, validation = (
        torch.tensor([places[subject] for subject in people_of(dataset, split)])
        for split in ("train", "validation")
    )
    return train, validation[:held_out]


_SAME_POSE_SHARE = 0.5  # of samples without pairs
_MEAN_SIDE = 64  # texels along a side of the mean face's shadows, as in the network


@dataclass(frozen=True, eq=False)
class DatasetTextures:
    """A prepared dataset and its textures, a `SampleSource`; its heads are indices of `dataset.subjects`."""

    dataset: Dataset
    model: MorphableModel
    side: int
    provenance: dict[str, Any]
    sources: dict[str, Path]  # unwrapped sources, of subjects that have them
    rig_lights: int = RIG_LIGHTS  # of the mean face's shadows

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Heads of the split train, and at most `held_out` of the split validation."""
        return heads_of(self.dataset, held_out)

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        """Normals [3, T, T], visibility [L, T, T] and its directions [L, 3] of the face model's mean."""
        settings = HeadBakeSettings(_MEAN_SIDE, self.rig_lights, bake=BakeSettings(bounce_samples=0))
        mean = bake_head(self.model, 0, 0, settings)
        normals = normal_map(mean["vertices"], grid_triangles(), _MEAN_SIDE)
        return normals, mean["visibility"].float() / 255, mean["directions"]

    def draw(self, heads: Tensor, lights: int, generator: torch.Generator) -> Sample:
        """Draw one sample of every subject in `heads` [B], with `lights` target lights.

        The albedo of real skin is unknown. The exposure is that of the face under a constant map of radiance
        1 instead, which equals the albedo but for light that other parts of the face occlude.
        """
        subjects = [self.dataset.subjects[int(head)] for head in heads]
        lights = min(lights, *(len(self.dataset.lights_of(subject)) for subject in subjects))
        faces = [self._draw_face(subject, lights, generator) for subject in subjects]
        names = _FaceTextures.__dataclass_fields__
        of = {name: torch.stack([getattr(face, name) for face in faces]) for name in names}
        lit = of.pop("lit")
        source, of["target"] = simulate_camera(of.pop("texture"), of["target"], lit, of["visible"], generator)
        filled = [inpaint(*pair) for pair in zip(source, of["visible"][:, 0], strict=True)]
        return Sample(source=torch.stack(filled), **of)

    def _draw_face(self, subject: str, lights: int, generator: torch.Generator) -> "_FaceTextures":
        pairs, weights = load_pairs(self.dataset).get(subject, ([], None))
        if weights is None:
            return self._draw_without_pairs(subject, lights, generator)
        row = int(torch.randint(len(pairs), (), generator=generator))
        pair = pairs[row]
        with self._open(subject, pair.source_camera) as file:
            source = UnwrappedView.read(file)
            if subject in self.sources:
                rows = np.load(self.sources[subject], mmap_mode="r")
                texture = torch.from_numpy(rows[row].astype(np.float32))
            else:  # a lazy pair
                texture = _weighted_sum(file, torch.from_numpy(np.array(weights[row])))
        return self._face(subject, pair.target_camera, source, texture, pair.target_light, lights, generator)

    def _draw_without_pairs(self, subject: str, lights: int, generator: torch.Generator) -> "_FaceTextures":
        """Draw cameras, light and targets of a subject without pairs."""
        cameras = self.dataset.cameras[subject]
        camera, other = (cameras[int(i)] for i in torch.randint(len(cameras), (2,), generator=generator))
        same = torch.rand((), generator=generator) < _SAME_POSE_SHARE
        with self._open(subject, camera) as file:
            source = UnwrappedView.read(file)
            texture = _weighted_sum(file, draw_light(source.directions, generator))
        return self._face(subject, camera if same else other, source, texture, None, lights, generator)

    def _face(
        self,
        subject: str,
        target_camera: str,
        source: "UnwrappedView",
        texture: Tensor,
        first_light: int | None,
        lights: int,
        generator: torch.Generator,
    ) -> "_FaceTextures":
        """Add random target lights, `first_light` first where it is given, to a source."""
        with self._open(subject, target_camera) as file:
            target = UnwrappedView.read(file)
            lights = min(lights, len(target.directions))
            chosen = draw_target_lights(target.directions, lights, generator)
            if first_light is not None:
                rest = chosen[chosen != first_light]
                chosen = torch.cat([torch.tensor([first_light]), rest])[:lights]
            olats = file.get_slice("olats")
            images = torch.stack([olats[int(light)] for light in chosen]).float()
        source_to_target = target.rotation @ source.rotation.T
        return _FaceTextures(
            texture=texture,
            lit=source.lit,
            visible=source.visible,
            normals_source=source.normals,
            target=images,
            lights=target.directions[chosen],
            # The source's normals turned, as in `Field.olats`.
            normals_target=torch.einsum("dc,cij->dij", source_to_target, source.normals),
            weight=target.visible * (0.3 + 0.7 * source.visible),
        )

    def _open(self, subject: str, camera: str) -> Any:
        return safe_open(texture_path(self.dataset, self.side, subject, camera), framework="pt")


@dataclass(frozen=True)
class _FaceTextures:
    """One face of a sample, before the simulated camera."""

    texture: Tensor  # [3, T, T] of the source
    lit: Tensor  # [3, T, T] of the source under a constant map of radiance 1
    visible: Tensor  # [1, T, T] of the source
    normals_source: Tensor  # [3, T, T]
    target: Tensor  # [L, 3, T, T]
    lights: Tensor  # [L, 3] in the target's camera space
    normals_target: Tensor  # [3, T, T]
    weight: Tensor  # [1, T, T]


def _weighted_sum(file: Any, weights: Tensor) -> Tensor:
    """Sum a file's OLAT textures with weights [L, 3]: [3, T, T]."""
    olats = file.get_tensor("olats")  # [L, 3, T, T]
    channels = [weights[:, c] @ olats[:, c].flatten(1).float() for c in range(3)]
    return torch.stack(channels).view(olats.shape[1:])


def model_of(dataset: Dataset, face_model: str) -> MorphableModel:
    """Load the face model that a dataset was fitted with; raise InputError where another is given."""
    model = load_face_model(face_model)
    if model.name != dataset.face_model:
        fitted = f"fitted with the face model {dataset.face_model}, not {model.name}"
        raise InputError(f"{dataset.folder}: {fitted}; give --fit-with")
    return model


def open_dataset_textures(
    folder: Path, face_model: str, side: int, jobs: int, rig_lights: int = RIG_LIGHTS
) -> DatasetTextures:
    """Open the dataset in a folder and make missing textures of its splits train and validation."""
    dataset = read_dataset(folder)
    model = model_of(dataset, face_model)
    subjects = [*dataset.splits["train"], *dataset.splits["validation"]]
    textures = DatasetTextures(dataset, model, side, provenance_of(dataset, model), {}, rig_lights)
    textures.heads(1)  # raises for a split without subjects before anything is unwrapped
    build_textures(dataset, face_model, side, subjects, jobs)
    written = {subject: sources_path(dataset, side, subject) for subject in subjects}
    return replace(textures, sources={name: path for name, path in written.items() if path.exists()})
