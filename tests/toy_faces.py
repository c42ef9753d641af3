"""Faces that cost nothing to draw, for tests of the loop."""

from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.synth.bank.texture_samples import Sample
from facerf_cli.training.texture import TextureObjective, TextureObjectiveSettings

SIDE, RIG = 16, 8
NETWORK = DefaultReflectanceSettings(
    side=SIDE, encoder_widths=(4, 8), decoder_widths=(4, 8), template_channels=1, rig_lights=RIG
)


@dataclass(frozen=True)
class ToyFaces:
    """Bumps of random albedo under single lights, as the bank draws its heads."""

    poison: int = -1  # the head whose target is not finite
    side: int = SIDE
    provenance: dict[str, Any] = field(default_factory=lambda: {"heads": "toys", "licence": "MIT"})

    def people(self, held_out: int) -> tuple[Tensor, Tensor]:
        return torch.arange(held_out, 40), torch.arange(held_out)

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        directions = F.normalize(torch.randn(RIG, 3, generator=torch.Generator().manual_seed(0)), dim=1)
        return _normals(), torch.ones(RIG, SIDE, SIDE), directions

    def draw(self, people: Tensor, lights: int, generator: torch.Generator) -> Sample:
        faces = len(people)
        normals = _normals().expand(faces, 3, SIDE, SIDE).contiguous()
        directions = torch.randn(faces, lights, 3, generator=generator)
        directions = F.normalize(directions + torch.tensor([0.0, 0, 1]), dim=-1)
        albedo = 0.1 + 0.8 * torch.rand(faces, 3, 1, 1, generator=generator)
        albedo = albedo * (0.5 + torch.rand(faces, 3, SIDE, SIDE, generator=generator))
        shading = torch.einsum("blc,bcij->blij", directions, normals).clamp_min(0)
        target = albedo[:, None] * shading[:, :, None]
        target[people == self.poison] = torch.nan
        seen = torch.ones(faces, 1, SIDE, SIDE)
        source = albedo / albedo.mean((1, 2, 3), keepdim=True) * MEAN_RADIANCE
        return Sample(source, seen, normals, normals, directions, target, seen)


def _normals() -> Tensor:
    axis = torch.linspace(-0.7, 0.7, SIDE)
    y, x = torch.meshgrid(-axis, axis, indexing="ij")
    return F.normalize(torch.stack([x, y, torch.ones_like(x)]), dim=0)


def toy_objective(poison: int = -1) -> TextureObjective:
    """The same weights at every call."""
    torch.manual_seed(0)
    settings = TextureObjectiveSettings(lights=2, held_out_people=3, held_out_draws=1, held_out_lights=2)
    return TextureObjective(ToyFaces(poison), DefaultReflectanceNetwork(NETWORK), settings=settings)
