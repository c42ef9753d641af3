"""Stage `diffuse-sh`: the network of the diffuse baseline (`network/diffuse_sh.py`), on textures.

The albedo is trained on targets under known lights, the light on the source, with the albedo held constant.
If the source also trained the albedo, the source itself under a constant light would be a perfect solution,
in which training stays. Spherical harmonics of order 2 cannot represent a single light, and the baseline is
not used with one: a target is a sum of several. All are at the network's exposure.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facerf_cli.light.sh import rig_coefficients
from facerf_cli.light.sphere import RigLight
from facerf_cli.network.diffuse_sh import ORDER, DiffuseEstimate, DiffuseNetwork, shading
from facerf_cli.network.inputs import Batch, to_root
from facerf_cli.synth.bank.texture_samples import Sample, SampleSource
from facerf_cli.training.losses import clipped_si_mse, root_loss
from facerf_cli.training.objective import Validation, metrics_by_pose
from facerf_cli.training.sheets import tiled
from facerf_cli.training.texture import HeadsObjective, HeadsSettings

_SHEET_FACES = 5
_TOTAL = 1.5  # of a sum's weights: a face lit from the front then has about the albedo's radiance
_UNEVEN = 2.0  # exponent of the uniform draws: some sums are nearly a single light
_TINT = 0.15  # standard deviation of the logarithm of a light's colour


@dataclass(frozen=True)
class SumSettings(HeadsSettings):
    """Settings of the stage, with the sums of a face and step."""

    sums: int = 3


@dataclass(frozen=True)
class DiffuseBatch(Batch):
    """B faces with M targets each: fields as in `Sample`, and the targets' lights."""

    source: Tensor  # [B, 3, T, T]
    visible: Tensor  # [B, 1, T, T]
    normals_source: Tensor  # [B, 3, T, T]
    normals_target: Tensor  # [B, 3, T, T]
    targets: Tensor  # [B, M, 3, T, T]
    coefficients: Tensor  # [B, M, 9, 3] in camera space
    weight: Tensor  # [B, 1, T, T]
    heads: Tensor  # [B] indices


class DiffuseObjective(HeadsObjective):
    """`root_loss` of the source under its estimated light, and of sums of known lights."""

    chooses_by = "si_mse"

    def __init__(
        self,
        source: SampleSource,
        network: DiffuseNetwork | None = None,
        settings: SumSettings = SumSettings(),
    ) -> None:
        network = network or DiffuseNetwork()
        network.set_mean_face(source.mean_face()[0])
        super().__init__("diffuse_sh", network, source, settings)

    def draw_head(self, head: Tensor, generator: torch.Generator) -> DiffuseBatch:
        """Draw a face and random sums of its single lights."""
        sample = self.source.draw(head, self.settings.lights, generator)
        weights = draw_sums(self.settings.sums, sample.lights.shape[1], generator)
        return sum_lights(sample, weights, head)

    def forward(self, batch: DiffuseBatch) -> dict[str, Tensor]:
        """Compute `source`, for the light alone, and `targets`, for the albedo; means over faces."""
        with self.mixed_precision():
            estimate = self.network(batch.source, batch.normals_source, batch.visible)
        source = (batch.source / estimate.exposure)[:, None]
        targets = batch.targets / estimate.exposure[:, None]
        own, _ = predicted_images(estimate._replace(albedo=estimate.albedo.detach()), batch)
        _, relit = predicted_images(estimate, batch)
        return {
            "source": root_loss(to_root(own), source, batch.visible),
            "targets": root_loss(to_root(relit), targets, batch.weight),
        }

    @torch.no_grad()
    def validate(self) -> Validation:
        """Measure the mean Si-MSE of held-out heads, clipped at white: of targets, by pose, and of sources.

        The sheet has two rows a face: source and targets; predicted source and targets, albedo and shading.
        """
        errors: list[tuple[Tensor, Tensor]] = []
        same_pose: list[bool] = []
        rows: list[np.ndarray] = []
        for batch in self.held_out_samples():
            there = batch.to(self.device)
            estimate = self.network(there.source, there.normals_source, there.visible)
            own, relit = (image.cpu() for image in predicted_images(estimate, there))
            of_source = clipped_si_mse(own, batch.source[:, None], batch.visible).mean()
            errors.append((clipped_si_mse(relit, batch.targets, batch.weight).mean(), of_source))
            turned = (batch.normals_source - batch.normals_target).abs().max()
            same_pose.append(bool(turned < 1e-3))
            rows += [_sheet_rows(batch, estimate, own, relit)] if len(rows) < _SHEET_FACES else []
        of_targets, of_sources = torch.tensor(errors).T
        metrics = metrics_by_pose(of_targets, torch.tensor(same_pose))
        return Validation({**metrics, "si_mse_source": float(of_sources.mean())}, np.concatenate(rows))


def draw_sums(sums: int, lights: int, generator: torch.Generator) -> Tensor:
    """Draw non-negative weights [M, L, 3] of lights, from nearly one light to nearly equal weights."""
    share = torch.rand(sums, lights, 1, generator=generator) ** _UNEVEN
    tint = torch.exp(_TINT * torch.randn(sums, lights, 3, generator=generator))
    weights = share * tint
    return _TOTAL * weights / weights.mean(2, keepdim=True).sum(1, keepdim=True)


def sum_lights(sample: Sample, weights: Tensor, heads: Tensor) -> DiffuseBatch:
    """Sum the lights of a sample of one face with weights [M, L, 3]."""
    coefficients = [rig_coefficients(RigLight(sample.lights[0], w), ORDER) for w in weights]
    return DiffuseBatch(
        source=sample.source,
        visible=sample.visible,
        normals_source=sample.normals_source,
        normals_target=sample.normals_target,
        targets=torch.einsum("mlc,lcij->mcij", weights, sample.target[0])[None],
        coefficients=torch.stack(coefficients)[None],
        weight=sample.weight,
        heads=heads,
    )


def predicted_images(estimate: DiffuseEstimate, batch: DiffuseBatch) -> tuple[Tensor, Tensor]:
    """Predicted sources [B, 1, 3, T, T] and targets [B, M, 3, T, T], at the network's exposure."""
    albedo = estimate.albedo[:, None]
    own = shading(batch.normals_source, estimate.coefficients[:, None])
    return albedo * own, albedo * shading(batch.normals_target, batch.coefficients)


def _sheet_rows(batch: DiffuseBatch, estimate: DiffuseEstimate, own: Tensor, relit: Tensor) -> np.ndarray:
    """Two rows of textures [2T, (M + 3) T, 3] of one face."""
    exposure = estimate.exposure[0].cpu()
    seen, mask = batch.visible[0], (batch.weight[0] > 0).float()
    albedo = estimate.albedo[0].cpu()
    lit = shading(batch.normals_source, estimate.coefficients[:, None].cpu())[0, 0]
    truth = [batch.source[0] / exposure, *(batch.targets[0] / exposure * mask)]
    guess = [own[0, 0] * seen, *(relit[0] * mask)]
    blank = torch.zeros_like(albedo)
    return tiled([[*truth, blank, blank], [*guess, albedo, lit / 4]])
