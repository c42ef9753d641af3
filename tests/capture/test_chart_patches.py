"""Corners, homographies and what is sampled between them."""

import numpy as np
import pytest

from facerf_cli.capture.chart_colours import published_colours
from facerf_cli.capture.chart_patches import (
    area_corners,
    centres,
    four_turns,
    homography,
    is_convex,
    project,
    sample,
    shrunk,
)
from tests.capture.chart_image import CORNERS, chart_image


def test_a_homography_meets_its_corners_and_many_points() -> None:
    matrix = homography(area_corners(), CORNERS)
    np.testing.assert_allclose(project(matrix, area_corners()), CORNERS)
    images = project(matrix, centres())
    again = homography(centres(), images + 0.01 * np.random.default_rng(0).standard_normal(images.shape))
    assert np.abs(project(again, area_corners()) - CORNERS).max() < 0.1


def test_the_middles_are_sampled() -> None:
    patches = sample(chart_image(noise=0.0, exposure=1.0), CORNERS)
    np.testing.assert_allclose(patches.colours, published_colours(), atol=1e-6)
    assert patches.counts.min() > 150 and patches.noise.max() < 1e-6 and not patches.at_white.any()
    careless = CORNERS + np.array([[4, -4], [-4, 4], [4, 4], [-4, -4]])
    patches = sample(chart_image(noise=0.0, exposure=1.0), careless)
    np.testing.assert_allclose(patches.colours, published_colours(), atol=1e-6)


def test_noise_and_clipping_are_counted() -> None:
    patches = sample(chart_image(noise=0.02, exposure=1.13).clip(max=1), CORNERS)
    grey = 1.13 * published_colours()[19, 1]
    assert patches.noise[19] == pytest.approx(0.02 * np.sqrt(grey + 0.01), rel=0.15)
    assert 0.2 < patches.at_white[18] < 0.9 and not patches.at_white[[0, 5, 20]].any()


def test_a_patch_outside_the_image_has_no_pixels() -> None:
    patches = sample(np.ones((20, 30, 3), np.float32), CORNERS)
    assert patches.counts.min() == 0 and not patches.colours[patches.counts == 0].any()


def test_turns_are_clockwise_whichever_way_corners_go() -> None:
    turns = four_turns(CORNERS)
    assert [turn[0].tolist() for turn in turns] == CORNERS.tolist()
    backward = four_turns(CORNERS[::-1])
    assert {tuple(turn.ravel()) for turn in turns} == {tuple(turn.ravel()) for turn in backward}


def test_convex() -> None:
    assert is_convex(CORNERS) and is_convex(CORNERS[::-1])
    assert not is_convex(CORNERS[[0, 2, 1, 3]])  # crossed
    assert not is_convex(np.array([[0.0, 0], [10, 0], [3, 3], [0, 10]])) and not is_convex(np.ones((4, 2)))


def test_shrunk_is_the_mean() -> None:
    image = np.arange(7 * 9 * 3, dtype=np.float32).reshape(7, 9, 3)
    small, scale = shrunk(image, 3)
    assert scale == 3 and small.shape == (2, 3, 3)
    assert small[1, 2] == pytest.approx(image[3:6, 6:9].mean((0, 1)))
