"""Random lights for training sources: from one flash to an overcast dome, as weights of a rig."""

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.stage.draws import Uniform


def draw_light(directions: Tensor, generator: torch.Generator) -> Tensor:
    """Weights [L, 3] of rig lights at camera-space directions [L, 3]: up to three lamps over a dome."""
    uniform = Uniform(generator)
    kind = torch.rand((), generator=generator)
    if kind < 0.2:  # a flash near the camera
        axis = F.normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.15 * torch.randn(3, generator=generator), dim=0)
        return _lamp(directions, axis, 400.0) * torch.ones(3) + 0.0015
    lamps = 1 + int(torch.randint(3, (), generator=generator))
    weights = torch.zeros(len(directions), 3)
    for lamp in range(lamps):
        axis = F.normalize(torch.randn(3, generator=generator) + torch.tensor([0.0, 0.45, 0.75]), dim=0)
        sharpness = float(torch.exp(uniform(0.3, 6.0)))
        power = 1.0 if lamp == 0 else float(torch.exp(uniform(-2.5, 0.2)))
        weights += power * _lamp(directions, axis, sharpness) * _tint(0.22, generator)
    ambient = float(torch.exp(uniform(-5.0, 0.5)))
    slope = uniform(-0.8, 0.8, 3)
    dome = (1 + directions @ slope).clamp_min(0.05)[:, None] / len(directions)
    return weights + ambient * dome * _tint(0.18, generator)


def _lamp(directions: Tensor, axis: Tensor, sharpness: float) -> Tensor:
    """A von Mises-Fisher lobe of unit sum [L, 1]."""
    return (sharpness * (directions @ axis)).softmax(0)[:, None]


def _tint(spread: float, generator: torch.Generator) -> Tensor:
    """A lamp's colour [3] along warm to cold, with a little green or magenta."""
    warm, green = torch.randn(2, generator=generator) * spread * torch.tensor([1.0, 0.3])
    return torch.exp(torch.stack([warm, green, -1.3 * warm]))
