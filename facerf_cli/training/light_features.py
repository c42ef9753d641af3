"""Stage `light-features`: S_f learns to predict the direction of the single light of a texture.

The paper trains S_f 'to predict the light direction from images' after Meka et al. (*Deep reflectance
fields*, 2019), without details. Its features respond to shading, shadows and highlights, which the loss L_L
compares. Textures are the Reflectance Network's targets, of one light each, black if the target pose does not
see the face there.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.dataset.crops import CropPairs, open_pairs, spread_pairs
from facerf_cli.dataset.dataset import Dataset, provenance_of
from facerf_cli.dataset.faces import DatasetFaces, LightTextures, LitCrops
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.network.batch import concatenate
from facerf_cli.network.features import AppearanceNetwork, LightNetwork
from facerf_cli.network.inputs import head_rotation, resize
from facerf_cli.synth.bank.texture_samples import SampleSource
from facerf_cli.training.objective import Objective, PeopleObjective, Validation, tiled
from facerf_cli.training.run import Run
from facerf_cli.training.texture import PeopleSettings

_NORMALS_SIDE = 64  # texels along a side of the normals that head rotations are computed from
_SHEET_FACES, _CPU = 6, torch.device("cpu")
_PEOPLE = PeopleSettings()


class LightFeaturesObjective(PeopleObjective):
    """1 minus the cosine between the predicted and the true direction of light."""

    chooses_by = "angle_deg"

    def __init__(
        self,
        source: SampleSource | DatasetFaces,
        network: LightNetwork | None = None,
        settings: PeopleSettings = _PEOPLE,
    ) -> None:
        super().__init__("light_features", network or LightNetwork(), source, settings)
        if not isinstance(source, DatasetFaces):
            self.mean_normals = resize(source.mean_face()[0][None], _NORMALS_SIDE)[0]

    def draw_person(self, person: int, generator: torch.Generator) -> LightTextures | LitCrops:
        people = torch.tensor([person])
        if isinstance(self.source, DatasetFaces):
            return self.source.draw_lights(people, self.settings.lights, generator)
        sample = self.source.draw(people, self.settings.lights, generator)
        seen = (sample.weight > 0).float()
        head_to_camera = head_rotation(self.mean_normals, sample.normals_target)
        lights_head = sample.lights @ head_to_camera  # row vectors: R^T w
        return LightTextures(sample.target * seen[:, None], lights_head, people)

    def _unwrapped(self, batch: LightTextures | LitCrops) -> LightTextures:
        return self.source.light_textures(batch) if isinstance(batch, LitCrops) else batch

    def forward(self, batch: LightTextures | LitCrops) -> dict[str, Tensor]:
        """Compute the term `light`, a mean over faces and lights."""
        faces = self._unwrapped(batch)
        with self.mixed_precision():
            return {"light": 1 - _cosines(self.network, faces).mean()}

    @torch.no_grad()
    def validate(self) -> Validation:
        """Measure mean and median angles in degrees to the true light, also for front and back lights."""
        faces = [self._unwrapped(face.to(self.device)) for face in self.held_out_samples()]
        cosines = torch.cat([_cosines(self.network, face) for face in faces])
        batch = concatenate(faces)
        angles = torch.rad2deg(cosines.double().clamp(-1, 1).acos())
        metrics = {"angle_deg": float(angles.mean()), "angle_median_deg": float(angles.median())}
        front = batch.lights_head[..., 2] > 0  # of the plane of the face
        for name, lights in (("angle_front_deg", front), ("angle_behind_deg", ~front)):
            if lights.any():
                metrics[name] = float(angles[lights].mean())
        return Validation(metrics, _sheet(self.network, concatenate(faces[:_SHEET_FACES]).to(_CPU)))


def _cosines(network: LightNetwork, batch: LightTextures) -> Tensor:
    """Return cosines [B, L] between predicted and true directions."""
    predicted = network(batch.textures.flatten(0, 1)).view(batch.lights_head.shape)
    return (predicted * batch.lights_head).sum(-1)


def _sheet(network: LightNetwork, batch: LightTextures) -> np.ndarray:
    """Draw three rows for each face: textures, and balls under the true and under the predicted lights.

    The balls are seen from the front, in the head's frame.
    """
    rows = []
    for textures, lights in zip(batch.textures[:_SHEET_FACES], batch.lights_head[:_SHEET_FACES], strict=True):
        predicted = network(textures.to(next(network.parameters()).device)).cpu()
        rows += [textures, *(_balls(directions, textures.shape[-1]) for directions in (lights, predicted))]
    return tiled(rows)


def _balls(lights: Tensor, side: int) -> Tensor:
    """Draw grey balls [N, 3, side, side] under lights [N, 3], slightly brighter than the background."""
    along = torch.linspace(-1, 1, side) * 1.05
    y, x = torch.meshgrid(-along, along, indexing="ij")
    inside = 1 - x**2 - y**2
    normals = torch.stack([x, y, inside.clamp_min(0).sqrt()])
    shading = torch.einsum("nc,cij->nij", lights, normals).clamp_min(0) * 0.45 + 0.01
    return (shading * (inside > 0))[:, None].expand(-1, 3, -1, -1)


@dataclass(frozen=True)
class AppearanceObjectiveSettings:
    """Number of held-out pairs, and of training pairs that are left out."""

    held_out_pairs: int = 48
    every: int = 10  # one in this many training pairs is left out to measure the people


class AppearanceObjective(Objective):
    """Cross-entropy over the people of both crops of a pair, and 1 - cosine to the target's light."""

    chooses_by = "angle_deg"

    def __init__(
        self,
        dataset: Dataset,
        model: MorphableModel,
        network: AppearanceNetwork,
        settings: AppearanceObjectiveSettings = AppearanceObjectiveSettings(),
    ) -> None:
        super().__init__({"appearance_features": network}, provenance_of(dataset, model))
        pairs = open_pairs(dataset, "train", network.settings.side)
        kept = [pair for place, pair in enumerate(pairs.pairs) if place % settings.every]
        self._train = replace(pairs, pairs=kept)
        self._left_out = replace(pairs, pairs=pairs.pairs[:: settings.every])
        self._held_out = open_pairs(dataset, "validation", network.settings.side)
        self.settings = settings
        self._validation: list[list[CropPairs]] | None = None  # of known people, and of others

    def draw(self, count: int, generator_of: Callable[..., torch.Generator], step: int) -> CropPairs:
        return self._train.draw(count, generator_of, step)

    def forward(self, batch: CropPairs) -> dict[str, Tensor]:
        """Compute the terms `people` and `light`, means over images."""
        with self.mixed_precision():
            scores, lights = self.network(torch.cat([batch.source, batch.target]))
        people = torch.cat([batch.people, batch.people])
        return {
            "people": F.cross_entropy(scores, people),
            "light": 1 - (lights[len(batch.light) :] * batch.light).sum(-1).mean(),
        }

    @torch.no_grad()
    def validate(self) -> Validation:
        """Measure the angle to the light on held-out people, and the share of known people recognised."""
        if self._validation is None:
            count = self.settings.held_out_pairs
            readers = (self._left_out, self._held_out)
            self._validation = [
                reader.read(spread_pairs(reader, count, lambda pair: True)) for reader in readers
            ]
        known, strangers = self._validation
        right, angles = [], []
        for pair in known:
            scores, _ = self.network(torch.cat([pair.source, pair.target]).to(self.device))
            right.append(scores.argmax(1).cpu() == pair.people)
        for pair in strangers:
            _, lights = self.network(torch.cat([pair.source, pair.target]).to(self.device))
            cosine = (lights[1:].cpu() * pair.light).sum(-1).double().clamp(-1, 1)
            angles.append(torch.rad2deg(cosine.acos()))
        metrics = {
            "angle_deg": float(torch.cat(angles).mean()),
            "recognised": float(torch.cat(right).double().mean()),
        }
        return Validation(metrics, None)


def build(run: Run) -> Objective:
    """Make the objective of the stage `light-features`."""
    network = run.features("light_features", run.texture_side)
    settings = PeopleSettings(held_out_people=run.sizes.held_out_people)
    objective: Objective = run.objective(LightFeaturesObjective)(run.faces(), network, settings)
    return objective


def build_appearance(run: Run) -> Objective:
    """Make the objective of the stage `appearance-features`: V_f on a dataset's crops."""
    dataset = run.dataset()
    network = run.features("appearance_features", run.crop_side(dataset), people=len(dataset.subjects))
    model = load_face_model(dataset.face_model)
    objective: Objective = run.objective(AppearanceObjective)(dataset, model, network)
    return objective
