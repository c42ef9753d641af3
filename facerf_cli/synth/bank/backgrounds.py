"""Bank of backgrounds: views of skies, and heaps of shapes that cover each other.

Such heaps have the statistics of natural images (Lee et al., *Occlusion models for natural images*, 2001). A
network that has seen them does not mistake patterns of a background for a person.
"""

import math
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.files.atomic import atomic_path
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.synth.camera import turned
from facerf_cli.synth.random_fields import Uniform
from facerf_cli.synth.sky.skies import draw_sky

BACKGROUND_PX, BACKGROUND_MAPS, BACKGROUND_HEAPS = 320, 60, 240  # side, and numbers of a bank
_MAP_PX = 768  # width of the maps
_VIEWS = 4  # of each map
_ANGLE = (0.35, 0.9)  # tangent of half the angle that a view shows
_SHAPES = (40, 260)
_RADIUS = (0.015, 0.5)  # of a shape, in sides of the image
_WHITE = 4.0  # radiance, over the image's mean, that is stored as white


def load_backgrounds(path: Path, maps: int, heaps: int, seed: int) -> Tensor:
    """Read the backgrounds [N, 3, S, S] of a bank, or draw and save them; uint8, the root of radiance."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        drawn = torch.cat([*(views_of_map(index, seed) for index in range(maps)), heaps_of(heaps, seed)])
        with atomic_path(path) as temporary:
            save_file({"backgrounds": drawn}, temporary)
    return load_file(path)["backgrounds"]


def views_of_map(index: int, seed: int) -> Tensor:
    """Photograph a procedural environment map [4, 3, S, S] in several directions, as `load_backgrounds`."""
    radiance = torch.from_numpy(draw_sky(index, seed, _MAP_PX)[0])
    return views_of(radiance, _VIEWS, torch.Generator().manual_seed(seed * 7919 + index))


def views_of(radiance: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Photograph an environment map [H, W, 3] `count` times, [N, 3, S, S], as `load_backgrounds`."""
    uniform = Uniform(generator)
    views = []
    for _ in range(count):
        tangent = uniform(*_ANGLE) * (2 * (torch.arange(BACKGROUND_PX) + PIXEL_CENTRE) / BACKGROUND_PX - 1)
        down, right = torch.meshgrid(tangent, tangent, indexing="ij")
        azimuth = uniform(-math.pi, math.pi) + right.atan()
        elevation = uniform(-0.25, 0.2) - (down / (1 + right.square()).sqrt()).atan()
        wrapped = torch.remainder(azimuth / math.pi + 1, 2) - 1
        grid = torch.stack([wrapped, -elevation / (math.pi / 2)], -1)[None]
        seen = F.grid_sample(
            radiance.permute(2, 0, 1)[None], grid, padding_mode="border", align_corners=False
        )
        views.append(_stored(seen[0]))
    return torch.stack(views)


def heaps_of(count: int, seed: int) -> Tensor:
    """Draw heaps of shapes [N, 3, S, S] that cover each other, as `load_backgrounds`."""
    generator = torch.Generator().manual_seed(seed * 7919 + 1_000_003)
    return torch.stack([_stored(_heap(generator)) for _ in range(count)])


def _stored(radiance: Tensor) -> Tensor:
    return (255 * (radiance / (_WHITE * radiance.mean().clamp_min(1e-6))).clamp(0, 1).sqrt()).round().byte()


def _heap(generator: torch.Generator) -> Tensor:
    """Draw one heap [3, S, S]; all its shapes share a palette."""
    uniform = Uniform(generator)
    at = (torch.arange(BACKGROUND_PX) + PIXEL_CENTRE) / BACKGROUND_PX
    image = _material(generator, uniform(0.02, 0.6) * torch.exp(uniform(-0.3, 0.3, 3, 1, 1)))
    palette = uniform(0.01, 0.9, 5, 1) ** 1.5 * torch.exp(0.35 * torch.randn(5, 3, generator=generator))
    boxes = float(torch.rand((), generator=generator))  # share of rectangles
    smallest, largest = (math.log(radius) for radius in _RADIUS)
    upright = torch.rand((), generator=generator) < 0.5
    for _ in range(int(torch.randint(*_SHAPES, (), generator=generator))):
        radius = torch.exp(uniform(smallest, largest) * uniform(0.6, 1))
        x0, y0 = uniform(-0.1, 1.1, 2)
        tilt = uniform(-0.05, 0.05) if upright else uniform(0, math.pi)
        long, wide = radius, radius * uniform(0.25, 1)
        low_y, high_y, low_x, high_x = (
            int((BACKGROUND_PX * v).clamp(0, BACKGROUND_PX))
            for v in (y0 - 1.5 * radius, y0 + 1.5 * radius, x0 - 1.5 * radius, x0 + 1.5 * radius)
        )
        if high_y <= low_y or high_x <= low_x:
            continue
        y, x = torch.meshgrid(at[low_y:high_y] - y0, at[low_x:high_x] - x0, indexing="ij")
        along, across = turned(x, y, tilt)
        along, across = along / long, across / wide
        if torch.rand((), generator=generator) < boxes:
            inside = torch.maximum(along.abs(), across.abs()) < 1
        else:
            inside = along.square() + across.square() < 1
        colour = palette[int(torch.randint(5, (), generator=generator))] * uniform(0.5, 1.5)
        shade = 1 + uniform(-0.5, 0.5) * along + uniform(-0.5, 0.5) * across
        grain = 1 + uniform(0, 0.25) * torch.randn(inside.shape, generator=generator)
        patch = image[:, low_y:high_y, low_x:high_x]
        filled = colour[:, None, None] * (shade * grain).clamp_min(0)
        image[:, low_y:high_y, low_x:high_x] = torch.where(inside, filled, patch)
    return image


def _material(generator: torch.Generator, colour: Tensor) -> Tensor:
    """Return a wall [3, S, S] of a colour with a slow gradient and blotches."""
    uniform = Uniform(generator)
    cells = int(torch.randint(2, 12, (), generator=generator))
    blotches = torch.randn(1, 1, cells, cells, generator=generator) * uniform(0, 0.5)
    wide = F.interpolate(blotches, (BACKGROUND_PX, BACKGROUND_PX), mode="bilinear", align_corners=False)[0]
    return colour * wide.exp()
