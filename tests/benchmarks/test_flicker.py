"""The measures of flicker, on clips whose flicker is known."""

import sys
from pathlib import Path

import numpy as np
import pytest
from skimage.data import astronaut

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from _talking_head import Clip
from _video_of_photo import camera_at, panned
from flicker import ROUGH, changes, flicker, flow_between, steady_twin, warped_errors

from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear

FRAMES, SIDE = 7, 96


def patterned(number: int) -> np.ndarray:
    """A smooth image [SIDE, SIDE, 3] of radiance 0.1 to 0.5, that is `number` pixels to the right."""
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    values = 0.3 + 0.1 * np.sin((x - number) / 9)[..., None] + 0.1 * np.cos(y / 7)[..., None]
    return np.asarray(np.repeat(values, 3, -1))


def moving_clip() -> Clip:
    """All of the frame moves right by a pixel a frame, in a light that does not change it."""
    truth = np.stack([patterned(n) for n in range(FRAMES)])
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    places = [np.stack([x - n, y, 0 * x], -1) * 0.002 for n in range(FRAMES)]

    def flow(pixels: float) -> np.ndarray:
        return np.broadcast_to([pixels, 0.0], (SIDE, SIDE, 2))

    middle = FRAMES // 2
    shown = np.asarray(linear_to_srgb(truth))
    return Clip(
        shown,
        shown,
        np.ones((FRAMES, SIDE, SIDE)),
        np.stack(places),
        np.stack([flow(0.0 if n == 0 else -1.0) for n in range(FRAMES)]),
        np.stack([flow(middle - n) for n in range(FRAMES)]),
        np.stack([flow(n - middle) for n in range(FRAMES)]),
    )


def with_error(clip: Clip, factor: np.ndarray) -> np.ndarray:
    """The truth, its radiance and the floor of the measure times factors that broadcast."""
    return np.asarray(linear_to_srgb(((srgb_to_linear(clip.truth) + 0.02) * factor - 0.02).clip(0, 1)))


def test_jumps_are_flicker_and_drifts_and_errors_that_move_are_none() -> None:
    clip = moving_clip()
    x = np.arange(SIDE)[None].repeat(SIDE, 0)
    stain = np.stack([1 + 0.2 * np.sin((x - n) / 3) for n in range(FRAMES)])[..., None]
    images = with_error(clip, stain)
    assert changes(images - clip.truth, clip, patches=False) > 0.01
    assert flicker(images, clip.truth, clip) < 1e-4
    known = np.isfinite(clip.from_the_middle(clip.truth[clip.middle]))
    np.testing.assert_allclose(steady_twin(images, clip)[known], images[known], atol=1e-6)
    clip, time = moving_clip(), np.arange(FRAMES)[:, None, None, None]
    drift = np.exp(0.02 * time + 0.005 * time**2)
    assert flicker(with_error(clip, drift), clip.truth, clip) < 1e-4
    jumps = np.exp(0.01 * (-1.0) ** time)
    wanted = 100 * 0.01 * np.abs(ROUGH).sum() * np.sqrt(2 / (ROUGH**2).sum())
    assert flicker(with_error(clip, drift * jumps), clip.truth, clip) == pytest.approx(wanted, rel=1e-3)
    twin = steady_twin(with_error(clip, jumps), clip)
    assert flicker(twin, clip.truth, clip) < 1e-4


def test_the_warped_error_of_a_panned_photo_is_its_noise_and_a_jump_is_more() -> None:
    photo = astronaut()[20:180, 140:300] / 255
    source = [np.asarray(linear_to_srgb(frame)) for frame in panned(photo, 4)]
    flow = flow_between(source[0], source[1])
    wanted = np.diff([camera_at(n, photo.shape)([80, 80])[0] for n in (0, 1)], axis=0)[0]
    middle = flow[::-1, 40:120, 40:120].mean((1, 2))  # x, y
    np.testing.assert_allclose(middle, wanted, atol=0.1)
    jumping = [frame * (0.97 if n % 2 else 1.0) for n, frame in enumerate(source)]
    mattes = [np.ones(photo.shape[:2])] * 4
    found = warped_errors({"source": source, "jumping": jumping}, source, mattes)
    assert found["source"][0] < 3 < 4 < found["jumping"][0]  # noise of 1.5 of 255 in both frames: 1.7
