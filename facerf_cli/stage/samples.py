"""Training samples: a source texture as the pipeline would unwrap it, and its true OLAT textures.

What all sources of samples share; `baked_faces.py` and `data/captured.py` make them.
"""

from dataclasses import dataclass, fields
from typing import Any, Protocol

import torch
from torch import Tensor

from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.stage.draws import Uniform
from facerf_cli.stage.shading import scatter


@dataclass(frozen=True)
class Sample:
    """B faces, L lights each; all fields in the fitted chart, camera space, normalised to the same exposure.

    source [B, 3, T, T] with unseen texels filled, visible [B, 1, T, T], normals_source and normals_target
    [B, 3, T, T] of the fitted mesh, lights [B, L, 3], target [B, L, 3, T, T], weight [B, 1, T, T] of the
    loss.
    """

    source: Tensor
    visible: Tensor
    normals_source: Tensor
    normals_target: Tensor
    lights: Tensor
    target: Tensor
    weight: Tensor

    def to(self, device: torch.device) -> "Sample":
        """The same sample on `device`."""
        return Sample(*(getattr(self, field.name).to(device) for field in fields(self)))


class SampleSource(Protocol):
    """What training draws from: the bank of baked heads, or a prepared dataset."""

    @property
    def provenance(self) -> dict[str, Any]:
        """For the checkpoint; its 'licence' is the words for the whole."""

    @property
    def side(self) -> int:
        """Texels along a side of every field."""

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Whom to train on, and at most `held_out` whom to validate on; numbers that `draw` takes."""

    def draw(self, heads: Tensor, lights: int, generator: torch.Generator) -> Sample:
        """One sample of every head in `heads` [B], with `lights` target lights."""

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        """Normals [3, T, T], visibility [L, T, T] and its directions [L, 3] of the mean face, head frame."""


def draw_target_lights(in_camera: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Numbers [count] of lights [L, 3], mostly in front, as photographs are lit; some from elsewhere."""
    preference = torch.sigmoid(6 * (in_camera[:, 2] + 0.1)) + 0.05
    return torch.multinomial(preference, count, generator=generator)


def photograph(
    source: Tensor, target: Tensor, albedo: Tensor, visible: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """What a camera makes of sources [B, 3, T, T]; and these and targets [B, L, 3, T, T] exposed to train.

    Targets are scaled so that the mean of `albedo` over the visible face becomes `MEAN_RADIANCE`; see
    network.reflectance.
    """
    faces = len(source)
    uniform = Uniform(generator, (faces, 1, 1, 1))
    balance = torch.exp(uniform(-0.12, 0.12, faces, 3, 1, 1))
    grey = (uniform(0, 1) < 0.25).float()
    source, target, albedo = (
        _greyed(x, grey) for x in (source * balance, target * balance[:, None], albedo * balance)
    )
    target = target * (MEAN_RADIANCE / _mean(albedo, visible))[:, None]
    source = source / _mean(source, visible)
    clip = uniform(1.6, 6.0)
    source = _blurred((source / clip).clamp(0, 1), uniform(0, 1.2)) ** torch.exp(uniform(-0.22, 0.22))
    noise = torch.randn(source.shape, generator=generator) * uniform(0, 0.02)
    source = (source + noise * (source + 0.02).sqrt()).clamp(0, 1)
    return source / _mean(source, visible) * MEAN_RADIANCE, target


def _greyed(field: Tensor, grey: Tensor) -> Tensor:
    """Some faces [B, ..., 3, T, T] without colour."""
    mixed = field.mean(-3, keepdim=True)
    share = grey.view(-1, *([1] * (field.dim() - 1)))
    return field * (1 - share) + mixed * share


def _mean(field: Tensor, visible: Tensor) -> Tensor:
    """Mean over channels and visible texels [B, 1, 1, 1] of a field [B, 3, T, T]."""
    total = (field.mean(1, keepdim=True) * visible).sum((2, 3), keepdim=True)
    return total / visible.sum((2, 3), keepdim=True).clamp_min(1e-6) + 1e-6


def _blurred(field: Tensor, sigma: Tensor) -> Tensor:
    return scatter(field, sigma.view(-1, 1).expand(-1, 3).clamp_min(0.05))
