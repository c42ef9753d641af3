"""Stage `diffuse-sh`: the network of the diffuse baseline (`network/diffuse_sh.py`), on textures.

The albedo is trained on targets under known lights, the light on the source, with the albedo held constant.
If the source also trained the albedo, the source itself under a constant light would be a degenerate optimum
that training does not leave. Spherical harmonics of order 2 cannot represent a single light, and the baseline
is not used with one: a target is a sum of several. All are at the network's exposure.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from facerf_cli.dataset.faces import DatasetFaces, SampleCrops
from facerf_cli.light.sh import rig_coefficients
from facerf_cli.light.sphere import RigLight
from facerf_cli.network.batch import Batch
from facerf_cli.network.diffuse_sh import ORDER, DiffuseEstimate, DiffuseNetwork, shading
from facerf_cli.network.inputs import to_root
from facerf_cli.synth.bank.texture_samples import Sample, SampleSource
from facerf_cli.training.losses import clipped_si_mse, root_loss
from facerf_cli.training.objective import Objective, tiled
from facerf_cli.training.run import Run
from facerf_cli.training.texture import PeopleSettings, SamplesObjective

_TOTAL = 1.5  # of a sum's weights: a face lit from the front then has about the albedo's radiance
_UNEVEN = 2.0  # exponent of the uniform draws: some sums are nearly a single light
_TINT = 0.15  # standard deviation of the logarithm of a light's colour


@dataclass(frozen=True)
class SumSettings(PeopleSettings):
    """Settings of the stage, with the sums of a face and step."""

    sums: int = 3


@dataclass(frozen=True)
class DiffuseBatch(Batch):
    """Samples of B faces, and M sums of their L lights: weights [B, M, L, 3], coefficients [B, M, 9, 3]."""

    sample: Sample | SampleCrops
    weights: Tensor
    coefficients: Tensor  # in camera space
    people: Tensor  # [B] indices


class DiffuseObjective(SamplesObjective):
    """`root_loss` of the source under its estimated light, and of sums of known lights."""

    def __init__(
        self,
        source: SampleSource | DatasetFaces,
        network: DiffuseNetwork | None = None,
        settings: SumSettings = SumSettings(),
    ) -> None:
        network = network or DiffuseNetwork()
        network.set_mean_face(source.mean_face()[0])
        super().__init__("diffuse_sh", network, source, settings)

    def batch_of(
        self, sample: Sample | SampleCrops, people: Tensor, generator: torch.Generator
    ) -> DiffuseBatch:
        """Draw random sums of the single lights of a sample."""
        weights = draw_sums(self.settings.sums, sample.lights.shape[1], generator)
        coefficients = [rig_coefficients(RigLight(sample.lights[0], w), ORDER) for w in weights]
        return DiffuseBatch(sample, weights[None], torch.stack(coefficients)[None], people)

    def forward(self, batch: DiffuseBatch) -> dict[str, Tensor]:
        """Compute `source`, which trains only the light, and `targets`, which train the albedo.

        Both are means over faces.
        """
        sample = sum_lights(self.textures(batch.sample), batch.weights)
        with self.mixed_precision():
            estimate = self.network(sample.source, sample.normals_source, sample.visible)
        source = (sample.source / estimate.exposure)[:, None]
        targets = sample.target / estimate.exposure[:, None]
        lit_by = batch.coefficients
        own, _ = predicted_images(estimate._replace(albedo=estimate.albedo.detach()), sample, lit_by)
        _, relit = predicted_images(estimate, sample, lit_by)
        return {
            "source": root_loss(to_root(own), source, sample.visible),
            "targets": root_loss(to_root(relit), targets, sample.weight),
        }

    def measure_sample(self, batch: DiffuseBatch) -> tuple[Sample, dict[str, Tensor], np.ndarray]:
        """Measure the Si-MSE of targets and source, clipped at white.

        The rows are source and targets; predicted source and targets, albedo and shading.
        """
        sample = sum_lights(self.textures(batch.sample), batch.weights)
        estimate = self.network(sample.source, sample.normals_source, sample.visible)
        own, relit = predicted_images(estimate, sample, batch.coefficients)
        of_target = clipped_si_mse(relit, sample.target, sample.weight).mean()
        of_source = clipped_si_mse(own, sample.source[:, None], sample.visible).mean()
        rows = _sheet_rows(sample, estimate, own, relit)
        return sample, {"si_mse": of_target, "si_mse_source": of_source}, rows


def draw_sums(sums: int, lights: int, generator: torch.Generator) -> Tensor:
    """Draw non-negative weights [M, L, 3] of lights, from nearly one light to nearly equal weights."""
    share = torch.rand(sums, lights, 1, generator=generator) ** _UNEVEN
    tint = torch.exp(_TINT * torch.randn(sums, lights, 3, generator=generator))
    weights = share * tint
    return _TOTAL * weights / weights.mean(2, keepdim=True).sum(1, keepdim=True)


def sum_lights(sample: Sample, weights: Tensor) -> Sample:
    """Replace the targets of a sample by sums of its lights with weights [B, M, L, 3]."""
    return replace(sample, target=torch.einsum("bmlc,blcij->bmcij", weights, sample.target))


def predicted_images(
    estimate: DiffuseEstimate, sample: Sample, coefficients: Tensor
) -> tuple[Tensor, Tensor]:
    """Predict sources [B, 1, 3, T, T] and targets [B, M, 3, T, T], at the network's exposure.

    coefficients: [B, M, 9, 3], of the targets' lights.
    """
    albedo = estimate.albedo[:, None]
    own = shading(sample.normals_source, estimate.coefficients[:, None])
    return albedo * own, albedo * shading(sample.normals_target, coefficients)


def _sheet_rows(sample: Sample, estimate: DiffuseEstimate, own: Tensor, relit: Tensor) -> np.ndarray:
    """Draw two rows of textures [2T, (M + 3) T, 3] of one face."""
    seen, mask = sample.visible[0], (sample.weight[0] > 0).float()
    albedo, exposure = estimate.albedo[0], estimate.exposure[0]
    lit = shading(sample.normals_source, estimate.coefficients[:, None])[0, 0]
    truth = [sample.source[0] / exposure, *(sample.target[0] / exposure * mask)]
    guess = [own[0, 0] * seen, *(relit[0] * mask)]
    blank = torch.zeros_like(albedo)
    return tiled([[*truth, blank, blank], [*guess, albedo, lit / 4]])


def build(run: Run) -> Objective:
    """Make the objective of the stage."""
    settings = SumSettings(held_out_people=run.sizes.held_out_people)
    objective: Objective = run.objective(DiffuseObjective)(run.faces(), run.network("diffuse_sh"), settings)
    return objective
