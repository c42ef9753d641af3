"""Fine relief of skin: pores and their net of furrows, wrinkles with age, the lines of the lips."""

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from facerf_cli.stage.noise import blurred, noise, slopes, splat
from facerf_cli.stage.people import People
from facerf_cli.stage.window import LANDMARK_MM, Window, blob, blobs, mask

_WRINKLE_WIDTH_MM = 0.9
# Wrinkles on the picture's right and their mirror images: name, depth at 75 years in millimetres, points in
# millimetres as offsets from a landmark.
_FOLDS: dict[str, tuple[float, tuple[tuple[int, float, float], ...]]] = {
    "nasolabial": (0.50, ((35, 5, -6), (35, 10, 2), (54, 6, -9), (54, 8.5, 0), (54, 8, 7))),
    "marionette": (0.28, ((54, 3, 3), (54, 5, 9), (54, 6, 17))),
    "crow's foot, upper": (0.22, ((45, 6, -3), (45, 14, -8), (45, 22, -11))),
    "crow's foot, middle": (0.24, ((45, 6, 0), (45, 15, 0), (45, 24, 1))),
    "crow's foot, lower": (0.22, ((45, 5, 4), (45, 13, 8), (45, 21, 14))),
    "under the eye": (0.25, ((42, -1, 6), (47, 0, 9), (46, 2, 9.5), (45, 2, 7))),
    "tear trough": (0.22, ((42, -2, 5), (42, 2, 11), (47, 4, 16))),
    "frown": (0.28, ((22, -5, 8), (22, -4, 1), (22, -5, -7))),
    "cheek": (0.16, ((54, 20, -14), (54, 24, 0), (54, 22, 14))),
}
_FOREHEAD_MM, _FOREHEAD_HALF_MM = (-12.0, 0.0, 11.0), 46.0  # heights about one third above the brows


def draw_relief(
    people: People, window: Window, smooth_skin: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Slopes [B, 2, T, T], and how deep each place lies in a wrinkle [B, 1, T, T], about 0..1.

    `smooth_skin` [B, 1, T, T] is 1 where skin is bare and 0 where hair or anything else covers it.
    """
    count = len(people.melanin)
    age = ((people.age - 18) / 57).view(-1, 1, 1, 1)
    grain = torch.randn(count, 1, window.side, window.side, generator=generator)
    net = noise(count, window, 2.2, generator, octaves=2)
    dents = noise(count, window, 6.0, generator, octaves=1)
    coarse = 0.6 + 0.5 * age + 0.4 * people.oiliness.view(-1, 1, 1, 1)
    texel = min(window.texel_mm)
    height = coarse * (_pore_places(window) * 0.016 * min(texel, 1.2) * grain + 0.014 * net + 0.02 * dents)
    lips = mask(window, "lips", 1.5)
    lines = noise(count, window, (1.7, 9.0), generator, octaves=1)
    height = height * (1 - lips) + lips * 0.05 * lines
    wrinkles = torch.cat([_wrinkles(float(years), window, generator) for years in people.age])
    relief = slopes(height * smooth_skin - wrinkles * (1 - lips), window)
    return relief.clamp(-0.8, 0.8), (wrinkles / 0.4).clamp(0, 1.2)


def _pore_places(window: Window) -> Tensor:
    """Pores are large on nose, inner cheeks and chin, hardly there beside the eyes."""
    cheeks = blobs(window, 0.37, 0.52, 22)
    return 0.55 + (0.9 * blob(window, 30, 15) + 0.7 * cheeks + 0.4 * blob(window, 8, 14)).clamp(0, 1)


def _wrinkles(age: float, window: Window, generator: torch.Generator) -> Tensor:
    """Depth [1, 1, T, T] in millimetres of every fold and line of a person of that age."""
    grown = max(0.0, (age - 22) / 53) ** 1.4
    places, amounts = [], []
    for depth, points in _FOLDS.values():
        base = np.array([LANDMARK_MM[index] + [dx, dy] for index, dx, dy in points])
        strength = depth * (0.10 + grown) * _between(0.3, 1.2, generator)
        for side in (-1, 1):
            moved = base + 0.8 * torch.randn(len(base), 2, generator=generator).numpy()
            places.append(_line(moved * [side, 1]))
            amounts.append(_tapered(strength * _between(0.7, 1.3, generator), len(places[-1])))
    furrowed = _between(0, 1, generator)
    for above in _FOREHEAD_MM:
        x = np.linspace(-_FOREHEAD_HALF_MM, _FOREHEAD_HALF_MM, 7) * _between(0.7, 1.1, generator)
        y = 6 + above - 0.0015 * x**2 + 1.5 * torch.randn(7, generator=generator).numpy()
        places.append(_line(np.stack([x, y], -1)))
        amounts.append(_tapered(0.3 * grown * furrowed, len(places[-1])))
    layers = splat(window, torch.cat(places), torch.cat(amounts))
    width = _WRINKLE_WIDTH_MM
    # A line of amount a per 0.4 mm, spread by a Gaussian of sigma s, is a / (0.4 s sqrt(2 pi)) deep.
    return blurred(layers, window, width) * (0.4 * width * (2 * np.pi) ** 0.5)


def _line(points: np.ndarray) -> Tensor:
    """A smooth curve [N, 2] through points, a place every 0.4 mm."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
    at = np.arange(0, length[-1], 0.4)
    return torch.from_numpy(CubicSpline(length, points)(at)).float()


def _tapered(amount: float, count: int) -> Tensor:
    along = torch.linspace(0, 1, count)
    return amount * torch.sin(torch.pi * (0.1 + 0.8 * along)) ** 1.5


def _between(low: float, high: float, generator: torch.Generator) -> float:
    return float(low + (high - low) * torch.rand((), generator=generator))
