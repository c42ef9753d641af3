"""Cuts are found in films that also move, flicker, flash and are switched to another light."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from skimage.data import astronaut, coffee

from facerf_cli.relighting.sequence import takes, thumbnail, with_cuts

ONE, OTHER = astronaut()[:300, :400], coffee()[:300, :400]


def cuts_of(frames: Sequence[np.ndarray]) -> list[int]:
    return [number for number, _, cut in with_cuts(frames.__getitem__, 0, len(frames)) if cut]


def noisy(image: np.ndarray, seed: int) -> np.ndarray:
    grain = np.random.default_rng(seed).normal(0, 12, image.shape)
    return (image + grain).clip(0, 255).astype(np.uint8)


def test_cuts_are_found_between_still_shots_and_at_both_ends() -> None:
    frames = [noisy(ONE, seed) for seed in range(6)] + [noisy(OTHER, seed) for seed in range(6)]
    assert cuts_of(frames) == [6]
    assert cuts_of([ONE, *[OTHER] * 5, ONE]) == [1, 6]
    assert cuts_of([ONE, OTHER]) == [1]
    assert cuts_of([ONE]) == []
    pans = [[image[:280, 4 * step : 4 * step + 300] for step in range(6)] for image in (ONE, OTHER)]
    assert cuts_of([*pans[0], *pans[1]]) == [6]
    assert cuts_of([*[ONE // 3] * 5, *[ONE] * 5]) == [5]


def test_a_fast_pan_a_flash_and_a_fade_are_no_cuts() -> None:
    wide = np.concatenate([astronaut(), astronaut()[:, ::-1], astronaut()], 1)
    pan = [wide[:400, 80 * step : 80 * step + 500] for step in range(12)]
    moves = [np.abs(thumbnail(a) - thumbnail(b)).mean() for a, b in pairwise(pan)]
    assert max(moves) > 0.1 and cuts_of(pan) == []
    flash = [ONE] * 4 + [np.full_like(ONE, 255)] + [ONE] * 4
    assert cuts_of(flash) == []
    shares = np.linspace(0, 1, 9)
    assert cuts_of([((1 - a) * ONE + a * OTHER).astype(np.uint8) for a in shares]) == []


def test_frames_are_shown_once_in_order() -> None:
    shown: list[int] = []

    def show(number: int) -> np.ndarray:
        shown.append(number)
        return np.full((12, 16, 3), number, np.uint8)

    found = list(with_cuts(show, 8, 20))
    assert [(number, int(image[0, 0, 0]), cut) for number, image, cut in found] == [
        (number, number, False) for number in range(8, 20)
    ]
    assert shown == list(range(4, 20))


@pytest.mark.parametrize(
    ("cuts", "wanted"), [([], [range(5)]), ([2], [range(2), range(2, 5)]), ([4], [range(4), range(4, 5)])]
)
def test_takes(cuts: list[int], wanted: list[range]) -> None:
    assert takes(5, cuts) == wanted
