"""Closed-form matting finds the shares that two colours were mixed with."""

import numpy as np
import pytest

from facerf_cli.portrait.matte import solve_matte


@pytest.mark.parametrize("colours", [((0.9, 0.9, 0.9), (0.1, 0.1, 0.1)), ((0.2, 0.1, 0.1), (0.3, 0.8, 0.4))])
def test_shares_of_a_mixture_are_found_without_a_hint(colours: tuple[tuple[float, ...], ...]) -> None:
    x = np.linspace(-1, 2, 60)
    truth = np.tile(x.clip(0, 1), (40, 1))
    own, other = (np.array(colour, np.float32) for colour in colours)
    image = truth[..., None] * own + (1 - truth[..., None]) * other
    unknown = np.tile((x > -0.2) & (x < 1.2), (40, 1))
    expected = np.where(unknown, 0.5, truth)
    found = solve_matte(image.astype(np.float32), expected, unknown)
    # the pull toward .5 and the smoothness of windows leave a fourth of what is expected wrongly
    assert np.abs(found - truth).max() < 0.15 and np.abs(expected - truth).max() > 0.4


def test_known_pixels_stay_and_nothing_unknown_is_no_work() -> None:
    image, expected = np.random.default_rng(0).random((12, 12, 3), np.float32), np.zeros((12, 12))
    expected[:, 6:] = 1
    assert (solve_matte(image, expected, np.zeros((12, 12), bool)) == expected).all()
    unknown = np.zeros((12, 12), bool)
    unknown[:, 5:7] = True
    found = solve_matte(image, expected, unknown)
    assert (found[~unknown] == expected[~unknown]).all() and ((found >= 0) & (found <= 1)).all()
