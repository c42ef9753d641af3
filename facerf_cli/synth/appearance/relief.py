"""Fine relief of skin: pores and the furrows between them, wrinkles with age, the lines of the lips."""

from functools import lru_cache

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag
from torch import Tensor

from facerf_cli.synth.appearance.people import People, each
from facerf_cli.synth.head.mesh import arc_lengths
from facerf_cli.synth.random_fields import (
    LANDMARK_MM,
    Window,
    blob,
    blobs,
    blurred,
    mask,
    noise,
    slopes,
    splat,
)

_WRINKLE_WIDTH_MM = 0.9  # sigma of a wrinkle's profile
_STEP_MM = 0.4  # between sample points along a wrinkle
# Wrinkles on the right side of the image, each of which has a mirror image: name, depth at 75 years in
# millimetres, and points (landmark, x offset, y offset in millimetres).
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
_FOREHEAD_MM = (-12.0, 0.0, 11.0)  # heights of the forehead's lines around a line above the brows
_FOREHEAD_HALF_MM = 46.0  # half length
_FOREHEAD_DEPTH_MM = 0.3


def draw_relief(
    people: People, window: Window, pores: Tensor, bare: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Draw slopes [B, 2, T, T] of the skin, and the depth [B, 1, T, T] of wrinkles, about 0..1.

    `pores` [B, 1, T, T] is noise with bumps of the size of pores; `bare` [B, 1, T, T] is 1 where skin is bare
    and 0 where hair covers it.
    """
    count = len(people.melanin)
    age = each((people.age - 18) / 57)
    grain = torch.randn(count, 1, window.side, window.side, generator=generator)
    dents = noise(count, window, 6.0, generator, octaves=1)
    coarse = 0.6 + 0.5 * age + 0.4 * each(people.oiliness)
    grain = 0.03 * min(1.0, min(window.texel_mm)) * grain
    height = coarse * (_pore_places(window) * (grain + 0.022 * pores) + 0.014 * dents)
    lips = mask(window, "lips", 1.5)
    lines = noise(count, window, (1.7, 9.0), generator, octaves=1)
    height = height * (1 - lips) + lips * 0.07 * lines
    wrinkles = _wrinkles(people, window, generator)
    relief = slopes(height * bare - wrinkles * (1 - lips), window)
    return relief.clamp(-0.8, 0.8), (wrinkles / 0.6).clamp(0, 1.2)


def _pore_places(window: Window) -> Tensor:
    """Strength [1, 1, T, T] of pores: high on nose, inner cheeks and chin, low near the eyes."""
    cheeks = blobs(window, 0.37, 0.52, 22)
    return 0.55 + (0.9 * blob(window, 30, 15) + 0.7 * cheeks + 0.4 * blob(window, 8, 14)).clamp(0, 1)


@lru_cache(maxsize=1)
def _fold_lines() -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """All K folds together: control points [P, 2], basis [N, P], taper [N], fold index [N] and depth [K].

    The product of basis and control points is the N sample points, for each of which taper scales the depth.
    The mirror image of a fold is a separate fold and follows it.
    """
    folds = [
        np.array([LANDMARK_MM[index] + [dx, dy] for index, dx, dy in points]) for _, points in _FOLDS.values()
    ]
    depths = [depth for depth, _ in _FOLDS.values()]
    folds = [fold * [side, 1] for fold in folds for side in (1, -1)]
    depths = [depth for depth in depths for _ in "ab"]
    x = np.linspace(-_FOREHEAD_HALF_MM, _FOREHEAD_HALF_MM, 7)
    folds += [np.stack([x, 6 + above - 0.0015 * x**2], -1) for above in _FOREHEAD_MM]
    depths += [_FOREHEAD_DEPTH_MM] * len(_FOREHEAD_MM)
    bases, tapers, numbers = [], [], []
    for number, points in enumerate(folds):
        length = arc_lengths(points)
        at = np.arange(0, length[-1], _STEP_MM)
        bases.append(CubicSpline(length, np.eye(len(points)))(at))
        tapers.append(np.sin(np.pi * (0.1 + 0.8 * at / length[-1])) ** 1.5)
        numbers.append(np.full(len(at), number))
    return (
        torch.from_numpy(np.concatenate(folds)).float(),
        torch.from_numpy(block_diag(*bases)).float(),
        torch.from_numpy(np.concatenate(tapers)).float(),
        torch.from_numpy(np.concatenate(numbers)),
        torch.tensor(depths),
    )


def _wrinkles(people: People, window: Window, generator: torch.Generator) -> Tensor:
    """Draw the depth [B, 1, T, T] in millimetres of all wrinkles at each person's age."""
    points, basis, taper, fold, depth = _fold_lines()
    count, folds = len(people.age), len(depth)
    grown = ((people.age - 22) / 53).clamp_min(0)[:, None] ** 1.4
    jitter = 0.8 * torch.randn(count, *points.shape, generator=generator)
    pairs = (folds - len(_FOREHEAD_MM)) // 2
    common = torch.rand(count, pairs + 1, generator=generator)  # both sides of the face are similar
    common = torch.cat(
        [common[:, :-1].repeat_interleave(2, 1), common[:, -1:].expand(-1, folds - 2 * pairs)], 1
    )
    own = 0.7 + 0.6 * torch.rand(count, folds, generator=generator)
    strength = depth * (0.08 + 1.8 * grown) * (0.25 + common) * own
    places = basis @ (points + jitter)  # [B, N, 2]
    amount = strength[:, fold] * taper * _STEP_MM
    face = torch.arange(count).repeat_interleave(len(fold))
    layers = splat(window, places.view(-1, 2), amount.reshape(-1), face, count)
    # A line of amount a per millimetre, blurred by a Gaussian of sigma s, has the depth a / (s sqrt(2 pi)).
    return blurred(layers, window, _WRINKLE_WIDTH_MM) * (_WRINKLE_WIDTH_MM * (2 * np.pi) ** 0.5)
