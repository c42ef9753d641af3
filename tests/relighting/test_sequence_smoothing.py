"""Smoothing by the frames on both sides: what it must keep, and what it must remove."""

import numpy as np
import pytest
import torch

from facerf_cli.relighting.sequence import REACH, smoothed, steadied


def test_a_parabola_is_kept_by_both_sides_alike_and_noise_is_not() -> None:
    time = np.arange(40.0)
    path = np.stack([0.1 * time**2 - time, 3 - 2 * time], -1)
    np.testing.assert_allclose(smoothed(path, np.ones(40)), path, atol=1e-9)
    noise = np.random.default_rng(0).normal(size=path.shape)
    left = smoothed(path + noise, np.ones(40)) - path
    assert np.abs(np.diff(left, axis=0)).mean() < 0.25 * np.abs(np.diff(noise, axis=0)).mean()
    step = (np.arange(42) >= 21).astype(float)
    there = smoothed(step, np.ones(42))
    np.testing.assert_allclose(there, 1 - there[::-1], atol=1e-9)  # a filter with delay is not symmetric
    path = 2.0 * np.arange(12)
    wrong = np.where(np.arange(12) == 5, 100.0, path)
    weights = (np.arange(12) != 5).astype(float)
    np.testing.assert_allclose(smoothed(wrong, weights), path, atol=1e-9)
    assert np.isnan(smoothed(path, np.zeros(12))).all()


@pytest.mark.parametrize("frames", [1, 2, 3, REACH])
def test_a_short_shot_is_smoothed_by_what_there_is(frames: int) -> None:
    path = 4.0 - np.arange(frames)
    np.testing.assert_allclose(smoothed(path, np.ones(frames)), path, atol=1e-9)


def test_maps_are_averaged_where_images_look_alike_and_kept_where_they_do_not() -> None:
    images = [torch.full((3, 20, 30), 0.5) for _ in range(3)]
    maps = [torch.full((2, 20, 30), value) for value in (0.0, 1.0, 5.0)]
    images[2][:, :, 15:] = 0.9  # another thing is seen there in the third frame
    mean = steadied(maps, images, 1)
    shares, values = torch.tensor([2 / 3, 1, 2 / 3]), torch.tensor([0.0, 1.0, 5.0])
    for part, frames in ((slice(0, 10), 3), (slice(20, 30), 2)):
        expected = float(shares[:frames] @ values[:frames] / shares[:frames].sum())
        torch.testing.assert_close(mean[:, :, part], torch.full((2, 20, 10), expected))
