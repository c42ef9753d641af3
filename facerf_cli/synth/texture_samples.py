"""Training samples of textures: their form, and the random lights and cameras that all sources share."""

from dataclasses import dataclass, fields
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.synth.random_fields import Uniform
from facerf_cli.synth.shading import scatter

_FLASH_SHARE = 0.2  # share of draws that are lit by a flash near the camera


@dataclass(frozen=True)
class Sample:
    """Textures of B faces with L target lights each, on the UV map of the fitted mesh, of equal exposure.

    Normals and lights are in camera space, of the source or of the target pose.
    """

    source: Tensor  # [B, 3, T, T], with invisible texels filled in
    visible: Tensor  # [B, 1, T, T]
    normals_source: Tensor  # [B, 3, T, T] of the fitted mesh
    normals_target: Tensor  # [B, 3, T, T]
    lights: Tensor  # [B, L, 3] directions
    target: Tensor  # [B, L, 3, T, T]
    weight: Tensor  # [B, 1, T, T] of the loss

    def to(self, device: torch.device) -> "Sample":
        """Move the sample to `device`."""
        return Sample(*(getattr(self, field.name).to(device) for field in fields(self)))


class SampleSource(Protocol):
    """Source of training samples: the bank of baked heads, or a prepared dataset."""

    @property
    def provenance(self) -> dict[str, Any]:
        """Origin of the data, stored in the checkpoint; its 'licence' covers all of it."""

    @property
    def side(self) -> int:
        """Texels along a side of every field."""

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Indices for `draw` of the heads to train on, and of at most `held_out` heads to validate on."""

    def draw(self, heads: Tensor, lights: int, generator: torch.Generator) -> Sample:
        """Draw one sample of each head in `heads` [B], with `lights` target lights."""

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        """Normals [3, T, T], visibility [L, T, T] and light directions [L, 3] of the mean, head frame."""


def draw_light(directions: Tensor, generator: torch.Generator) -> Tensor:
    """Draw weights [L, 3] of rig lights at camera-space directions [L, 3].

    A fifth of the draws are a flash near the camera; the others are one to three area lights over a dome.
    """
    uniform = Uniform(generator)
    kind = torch.rand((), generator=generator)
    if kind < _FLASH_SHARE:
        axis = F.normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.15 * torch.randn(3, generator=generator), dim=0)
        return _lobe(directions, axis, 400.0) * torch.ones(3) + 0.0015
    lobes = 1 + int(torch.randint(3, (), generator=generator))
    weights = torch.zeros(len(directions), 3)
    for lobe in range(lobes):
        axis = F.normalize(torch.randn(3, generator=generator) + torch.tensor([0.0, 0.45, 0.75]), dim=0)
        sharpness = float(torch.exp(uniform(0.3, 6.0)))
        power = 1.0 if lobe == 0 else float(torch.exp(uniform(-2.5, 0.2)))
        weights += power * _lobe(directions, axis, sharpness) * _tint(0.22, generator)
    ambient = float(torch.exp(uniform(-5.0, 0.5)))
    slope = uniform(-0.8, 0.8, 3)
    dome = (1 + directions @ slope).clamp_min(0.05)[:, None] / len(directions)
    return weights + ambient * dome * _tint(0.18, generator)


def _lobe(directions: Tensor, axis: Tensor, sharpness: float) -> Tensor:
    """Weights [L, 1] of an area light: a von Mises-Fisher lobe of unit sum."""
    return (sharpness * (directions @ axis)).softmax(0)[:, None]


def _tint(spread: float, generator: torch.Generator) -> Tensor:
    """Draw the colour of a light [3] between warm and cold, with a little green or magenta."""
    warm, green = torch.randn(2, generator=generator) * spread * torch.tensor([1.0, 0.3])
    return torch.exp(torch.stack([warm, green, -1.3 * warm]))


def draw_target_lights(in_camera: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw indices [count] of lights at directions [L, 3], mostly in front of the face, as in photos."""
    preference = torch.sigmoid(6 * (in_camera[:, 2] + 0.1)) + 0.05
    return torch.multinomial(preference, count, generator=generator)


def simulate_camera(
    source: Tensor, target: Tensor, albedo: Tensor, visible: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Simulate a camera on sources [B, 3, T, T], and expose sources and targets [B, L, 3, T, T] for training.

    Sources get a colour cast, clipping, blur, a tone curve and noise, and a mean of `MEAN_RADIANCE`. Targets
    get the same cast, and the scale that makes the mean albedo of the visible face `MEAN_RADIANCE`.
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
    """Remove the colour of the faces [B, ..., 3, T, T] where grey [B, 1, 1, 1] is 1."""
    mixed = field.mean(-3, keepdim=True)
    share = grey.view(-1, *([1] * (field.dim() - 1)))
    return field * (1 - share) + mixed * share


def _mean(field: Tensor, visible: Tensor) -> Tensor:
    """Mean over channels and visible texels [B, 1, 1, 1] of a field [B, 3, T, T]."""
    total = (field.mean(1, keepdim=True) * visible).sum((2, 3), keepdim=True)
    return total / visible.sum((2, 3), keepdim=True).clamp_min(1e-6) + 1e-6


def _blurred(field: Tensor, sigma: Tensor) -> Tensor:
    """Blur a field [B, 3, T, T] by Gaussians of sigma [B, 1, 1, 1] texels."""
    return scatter(field, sigma.view(-1, 1).expand(-1, 3).clamp_min(0.05))
