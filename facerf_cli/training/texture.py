"""Stage `reflectance`: train only the Reflectance Network, on textures of synthetic heads or a dataset.

With S_f, the paper's feature loss on textures, L_L, is added to the default form's loss.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.dataset.faces import DatasetFaces, SampleCrops
from facerf_cli.errors import InputError
from facerf_cli.network.batch import Batch, concatenate
from facerf_cli.network.checkpoint import new_network
from facerf_cli.network.features import LightNetwork, feature_distance
from facerf_cli.network.inputs import SourceColours, from_root, mean_colours, without_cast
from facerf_cli.synth.bank.texture_samples import Sample, SampleSource
from facerf_cli.training.losses import clipped_si_mse, root_loss
from facerf_cli.training.objective import Objective, PeopleObjective, Validation, seeded, tiled
from facerf_cli.training.run import Run

_COLOUR_SEED, _COLOURS_MEASURED = 31415, 192
_SHEET_FACES = 5


@dataclass(frozen=True)
class PeopleSettings:
    """Lights per face and step, and held-out people, each drawn `held_out_draws` times."""

    lights: int = 8
    held_out_people: int = 12
    held_out_draws: int = 4


class SamplesObjective(PeopleObjective):
    """Base of the stages that train one network on sources and their targets under single lights."""

    chooses_by = "si_mse"

    def draw(self, count: int, generator_of: Callable[..., torch.Generator], step: int) -> Any:
        """Draw `count` samples; a dataset's samples share the stacks of their sources with other steps."""
        if not isinstance(self.source, DatasetFaces):
            return super().draw(count, generator_of, step)
        drawn = []
        for index in range(count):
            person, crops = self.source.draw_shared(self.settings.lights, generator_of, index, step)
            drawn.append(self.batch_of(crops, person, generator_of(index)))
        return concatenate(drawn)

    def draw_person(self, person: int, generator: torch.Generator) -> Any:
        people = torch.tensor([person])
        return self.batch_of(self.source.draw(people, self.settings.lights, generator), people, generator)

    def batch_of(self, sample: Sample | SampleCrops, people: Tensor, generator: torch.Generator) -> Any:
        """Make the batch of a sample of people [1]."""
        raise NotImplementedError

    def textures(self, sample: Sample | SampleCrops) -> Sample:
        """Unwrap the crops of a dataset; samples of baked heads are textures already."""
        return self.source.sample(sample) if isinstance(sample, SampleCrops) else sample

    @torch.no_grad()
    def validate(self) -> Validation:
        """Average the errors of held-out people that `measure_sample` returns; the first also by pose.

        The poses are the source's, and another one of the target.
        """
        errors: list[Tensor] = []
        same_pose: list[bool] = []
        rows: list[np.ndarray] = []
        for held_out in self.held_out_samples():
            sample, measured, face_rows = self.measure_sample(held_out.to(self.device))
            errors.append(torch.stack([*measured.values()]).cpu())
            turned = (sample.normals_source - sample.normals_target).abs().max()
            same_pose.append(bool(turned < 1e-3))
            rows += [face_rows] if len(rows) < _SHEET_FACES else []
        of_name, same = dict(zip(measured, torch.stack(errors).T, strict=True)), torch.tensor(same_pose)
        si_mse = of_name.pop("si_mse")
        parts = {"": torch.ones_like(same), "_same_pose": same, "_other_pose": ~same}
        metrics = {f"si_mse{name}": float(si_mse[part].mean()) for name, part in parts.items() if part.any()}
        metrics |= {name: float(values.mean()) for name, values in of_name.items()}
        return Validation(metrics, np.concatenate(rows))

    def measure_sample(self, batch: Any) -> tuple[Sample, dict[str, Tensor], np.ndarray]:
        """Return a held-out sample unwrapped, its errors (`si_mse` and others) and two rows of the sheet."""
        raise NotImplementedError


@dataclass(frozen=True)
class TextureObjectiveSettings(PeopleSettings):
    """Settings of the stage `reflectance`."""

    lights: int = 4
    held_out_lights: int = 6
    light_features: float = 0.25  # weight of L_L; its gradient is then a third of the other term's


@dataclass(frozen=True)
class TextureBatch(Batch):
    """Samples and the indices of their people [B]."""

    sample: Sample | SampleCrops
    people: Tensor


class TextureObjective(SamplesObjective):
    """`root_loss` of OLAT textures at the network's exposure; `light` is a frozen S_f."""

    def __init__(
        self,
        source: SampleSource | DatasetFaces,
        network: Any = None,
        light: LightNetwork | None = None,
        settings: TextureObjectiveSettings = TextureObjectiveSettings(),
    ) -> None:
        network = network or new_network("reflectance", "default", {})
        if network.rig_lights:
            try:
                network.set_mean_face(*source.mean_face())
            except ValueError as error:
                advice = "use another --bank or --start-from"
                raise InputError(f"{error} when the heads were baked; {advice}") from None
        super().__init__("reflectance", network, source, settings)
        self.light = light
        self.source_colours = SourceColours.of(self._measure_colours())

    def _measure_colours(self) -> Tensor:
        """Measure mean colours [N, 3] of sources of the training people."""
        if isinstance(self.source, DatasetFaces):
            return self.source.source_colours(_COLOURS_MEASURED, seeded(_COLOUR_SEED))
        colours = []
        for index in range(_COLOURS_MEASURED):
            generator = seeded(_COLOUR_SEED, index)
            person = torch.tensor([self.any_person(generator)])
            sample = self.source.draw(person, 1, generator)
            colours.append(mean_colours(sample.source, sample.visible))
        return torch.cat(colours)

    def batch_of(
        self, sample: Sample | SampleCrops, people: Tensor, generator: torch.Generator
    ) -> TextureBatch:
        return TextureBatch(sample, people)

    def draw_held_out(self, person: int, generator: torch.Generator) -> Sample | SampleCrops:
        drawn: Sample | SampleCrops = self.source.draw(
            torch.tensor([person]), self.settings.held_out_lights, generator
        )
        return drawn

    def forward(self, batch: TextureBatch) -> dict[str, Tensor]:
        """Compute the term `root` and, with S_f, `light_features`, means over faces."""
        network, sample = self.network, self.textures(batch.sample)
        with self.mixed_precision():
            encoded = self.encoded(sample)
            root = network.decode_root(encoded, sample.normals_target, sample.lights).float()
        # the network divides by the exposure that it measures on visible texels
        target = sample.target / encoded.exposure[:, None]
        terms = {"root": root_loss(root, target, sample.weight)}
        if self.light is not None:
            seen = (sample.weight > 0).float()[:, None]
            textures = ((x * seen).flatten(0, 1) for x in (from_root(root), target))
            with self.mixed_precision():
                distance = feature_distance(self.light, *textures).mean()
            terms["light_features"] = self.settings.light_features * distance
        return terms

    def measure_sample(self, batch: Sample | SampleCrops) -> tuple[Sample, dict[str, Tensor], np.ndarray]:
        """Measure the Si-MSE, clipped at white; draw source and true, visible source and predicted OLATs."""
        sample = self.textures(batch)
        predicted = self.network.decode(self.encoded(sample), sample.normals_target, sample.lights)
        error = clipped_si_mse(predicted, sample.target, sample.weight).mean()
        mask = (sample.weight[0] > 0).float()
        truth = [sample.source[0], *(sample.target[0] * mask)]
        rows = [truth, [sample.source[0] * sample.visible[0], *(predicted[0] * mask)]]
        return sample, {"si_mse": error}, tiled(rows)

    def encoded(self, sample: Sample) -> Any:
        """Encode the sources of textures, without their colour cast, for the network's `decode`."""
        source = without_cast(sample.source, sample.visible, self.source_colours)
        return self.network.encode(source, sample.normals_source, sample.visible)


def build(run: Run) -> Objective:
    """Make the objective of the stage."""
    side = run.texture_side
    light, network = run.light_features(side), run.reflectance(side)
    settings = TextureObjectiveSettings(held_out_people=run.sizes.held_out_people)
    objective: Objective = run.objective(TextureObjective)(run.faces(), network, light, settings)
    return objective
