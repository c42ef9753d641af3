"""Metrics against the reference scorer, slow twins, and bounds."""

import importlib
import math
from collections.abc import Iterator
from types import ModuleType

import numpy as np
import pytest
import torch

from facerf_cli.evaluation.metrics import (
    PSNR_HIGHEST_DB,
    best_scale,
    light_error_deg,
    mean_interval,
    mse,
    psnr,
    si_mse,
    si_mse_clipped,
    ssim,
    tone_drift_deg,
    tone_of,
)
from facerf_cli.image.colour import ita_deg
from facerf_cli.training.losses import si_mse as training_si_mse
from tests.conftest import SHARED
from tests.oracles import metrics as slow
from tests.refusals import refused

Images = tuple[np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture
def images() -> Images:
    """Prediction, truth [14, 19, 3] and a soft mask; both images exceed 0..1."""
    random = np.random.default_rng(1)
    truth = random.gamma(1.5, 0.3, (14, 19, 3)).astype(np.float32)
    prediction = (0.4 * truth + 0.1 * random.normal(size=truth.shape)).astype(np.float32)
    mask = random.random((14, 19)) * (random.random((14, 19)) > 0.3)
    mask[:3], mask[:, -4:] = 0, 0
    return prediction, truth, mask


@pytest.fixture
def scorer(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[ModuleType, ModuleType]]:
    """The benchmark's own score.py and yale.py."""
    folder = SHARED / "bench" / "yale_b"
    if not (folder / "score.py").is_file():
        pytest.skip(f"{folder} is not here (set FACERF_SHARED)")
    monkeypatch.syspath_prepend(str(folder))
    yield importlib.import_module("score"), importlib.import_module("yale")


@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0, -1.0])
def test_figures_are_those_of_the_reference_scorer(
    scorer: tuple[ModuleType, ModuleType], scale: float
) -> None:
    score, yale = scorer
    random = np.random.default_rng(2)
    truth = (random.random((yale.H, yale.W)) ** 2).astype(np.float32)
    prediction = (scale * truth + 0.2 * random.normal(size=truth.shape)).astype(np.float32)
    expected = score.measure(prediction, truth)
    arguments = prediction, truth, yale.MASK
    found = {
        "scale": best_scale(*arguments),
        "si_mse": si_mse(*arguments),
        "raw_mse": mse(*arguments),
        "ssim": ssim(*arguments),
    }
    for name, value in found.items():
        assert value == pytest.approx(expected[name], rel=1e-9, abs=1e-12), name
    colours = [np.repeat(image[..., None], 3, -1) for image in (prediction, truth)]
    assert si_mse(*colours, yale.MASK) == pytest.approx(found["si_mse"])
    assert ssim(*colours, yale.MASK) == pytest.approx(found["ssim"])


def test_figures_are_those_of_the_slow_twins_and_of_training(images: Images) -> None:
    assert best_scale(*images) == pytest.approx(slow.best_scale(*images), rel=1e-6)
    assert si_mse(*images) == pytest.approx(slow.si_mse(*images), rel=1e-9)
    assert mse(*images) == pytest.approx(slow.mse(*images), rel=1e-9)
    assert ssim(*images) == pytest.approx(slow.ssim(*images), rel=1e-6)
    planes = [torch.from_numpy(image).double().permute(2, 0, 1)[None, None] for image in images[:2]]
    expected = training_si_mse(*planes, torch.from_numpy(images[2])[None, None])
    assert si_mse(*images) == pytest.approx(expected.item(), rel=1e-9)


def test_scales_are_ignored_and_never_negative(images: Images) -> None:
    prediction, truth, mask = images
    for metric in (si_mse, si_mse_clipped, ssim):
        assert metric(7 * prediction, truth, mask) == pytest.approx(metric(prediction, truth, mask), rel=1e-5)
    assert mse(7 * prediction, truth, mask) > 1.5 * mse(prediction, truth, mask)
    _, truth, mask = images
    for prediction in (-truth, 0 * truth):
        assert best_scale(prediction, truth, mask) == 0
        assert np.isfinite(ssim(prediction, truth, mask))


def test_pixels_outside_the_mask_do_not_count_and_equal_images_are_equal(images: Images) -> None:
    prediction, truth, mask = images
    wild = np.where(mask[..., None] > 0, prediction, np.float32(50))
    for metric in (best_scale, si_mse, si_mse_clipped, mse, ssim):
        assert metric(wild, truth, mask) == metric(prediction, truth, mask)
    _, truth, mask = images
    assert si_mse(truth, truth, mask) == pytest.approx(0, abs=1e-15)
    assert ssim(truth, truth, mask) == pytest.approx(1)
    assert psnr(mse(truth, truth, mask)) == pytest.approx(PSNR_HIGHEST_DB)
    prediction, truth, mask = images
    refused(ValueError, "empty", si_mse, prediction, truth, 0 * mask)
    refused(ValueError, "(14, 18, 3)", mse, prediction[:, 1:], truth, mask)


def test_a_clipped_highlight_of_the_truth_counts_less() -> None:
    truth = np.full((5, 6, 3), 0.3)
    prediction, mask = truth.copy(), np.ones((5, 6))
    truth[2, 2] = 40
    whole, clipped = si_mse(prediction, truth, mask), si_mse_clipped(prediction, truth, mask)
    assert clipped < 0.02 < 10 < whole
    assert si_mse_clipped(truth, truth, mask) > 0  # the prediction is not clipped


@pytest.mark.parametrize("angle_deg", [0, 1e-5, 0.01, 30, 90, 179.9, 180])
def test_angles_between_lights(angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    turned = 3 * np.array([np.cos(angle), 0, np.sin(angle)])
    assert light_error_deg(turned, np.array([0.2, 0, 0])) == pytest.approx(angle_deg, rel=1e-6, abs=1e-9)


def test_ita_of_known_colours() -> None:
    # L* 70, b* 18 and L* 30, b* 10 at a* 0: linear Rec.709 by an independent conversion (colour-science).
    colour = pytest.importorskip("colour")
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    for lightness, yellow in ((70, 18), (30, 10)):
        xyz = colour.Lab_to_XYZ([lightness, 8, yellow], white)
        linear = np.linalg.inv(colour.RGB_COLOURSPACES["ITU-R BT.709"].matrix_RGB_to_XYZ) @ xyz
        expected = np.degrees(np.arctan((lightness - 50) / yellow))
        assert float(ita_deg(linear)) == pytest.approx(expected, abs=0.1)


def test_tone_drift_uses_only_the_skin_and_no_light_has_no_angle() -> None:
    albedo = np.array([0.45, 0.30, 0.22])
    truth = np.broadcast_to(0.3 * albedo, (6, 8, 3)).copy()
    skin = np.zeros((6, 8))
    skin[1:4, 2:7] = 1
    truth[0] = [0.1, 0.9, 0.1]
    assert tone_drift_deg(truth, truth, skin, albedo) == pytest.approx(0, abs=1e-9)
    darker, lighter = (tone_drift_deg(gain * truth, truth, skin, albedo) for gain in (0.7, 1.3))
    assert darker is not None and lighter is not None and darker < -3 < 3 < lighter
    assert tone_drift_deg(truth, truth, 0 * skin, albedo) is None
    grey = np.broadcast_to(truth.mean(-1, keepdims=True), truth.shape)
    assert tone_drift_deg(truth, grey, skin, albedo) is None
    refused(ValueError, "no angle", light_error_deg, np.zeros(3), np.array([0, 0, 1.0]))


@pytest.mark.parametrize(
    ("ita", "tone"),
    [(55.1, "very light"), (55, "light"), (41, "intermediate"), (28, "tan"), (10, "brown"), (-30, "dark")],
)
def test_tones_are_the_published_classes(ita: float, tone: str) -> None:
    assert tone_of(ita) == tone


def test_interval_is_as_wide_as_that_of_the_groups_means_and_one_group_has_none() -> None:
    random = np.random.default_rng(0)
    groups = random.normal(size=40)
    interval = mean_interval((g, groups[g] + 0.01 * random.normal()) for g in range(40) for _ in range(50))
    assert interval is not None and (interval.images, interval.groups) == (2000, 40)
    half = 1.96 * groups.std() / math.sqrt(40)
    np.testing.assert_allclose(interval.high - interval.low, 2 * half, rtol=0.1)
    assert interval.low < interval.mean < interval.high
    interval = mean_interval([("a", 1.0), ("a", 3.0)])
    assert interval is not None and interval.mean == 2 and math.isnan(interval.low)
    assert mean_interval([]) is None
