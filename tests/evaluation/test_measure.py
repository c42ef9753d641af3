"""A comparison becomes rows: which figures, of which values, and what cannot be compared."""

from dataclasses import replace

import numpy as np
import pytest

from facerf_cli.errors import InputError
from facerf_cli.evaluation import measure as module
from facerf_cli.evaluation.measure import METRICS, SOURCE, Case, Comparison, display, measure
from facerf_cli.evaluation.metrics import mse, si_mse, si_mse_channels, si_mse_clipped, ssim
from facerf_cli.evaluation.options import Measures
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb
from tests.refusals import refused

LANDMARKS = np.random.default_rng(5).uniform(5, 20, (68, 2))


@pytest.fixture
def comparison() -> Comparison:
    """Two methods on an image [20, 26, 3] that goes beyond white."""
    random = np.random.default_rng(0)
    truth = random.gamma(1.0, 0.5, (20, 26, 3)).astype(np.float32)
    near = (truth * 0.9 + 0.02 * random.normal(size=truth.shape)).astype(np.float32)
    mask = np.zeros((20, 26), np.float32)
    mask[4:17, 3:20], mask[8, 8:12] = 1, 0.5
    case = Case("a/b", "anna", {"pose": "same pose", "angle_deg": 12.0})
    return Comparison(case, truth, mask, {"near": near, "far": truth[::-1].copy()})


@pytest.fixture
def descriptors(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The images given to the face recogniser; its answer is their mean colour."""
    seen: list[np.ndarray] = []

    def describe(image: np.ndarray, landmarks_px: np.ndarray) -> np.ndarray:
        assert np.array_equal(landmarks_px, LANDMARKS)
        seen.append(image)
        return image.mean((0, 1))

    monkeypatch.setattr(module, "face_descriptor", describe)
    return seen


def test_a_row_a_method_in_their_order(comparison: Comparison) -> None:
    rows = measure(comparison, Measures())
    assert [(row.case, row.person, row.method) for row in rows] == [
        ("a/b", "anna", m) for m in ("near", "far")
    ]
    near, far = (row.values for row in rows)
    truth, mask, prediction = comparison.truth, comparison.mask, comparison.predictions["near"]
    for metric in (si_mse, si_mse_clipped, si_mse_channels, mse, ssim):
        assert near[metric.__name__] == pytest.approx(metric(prediction, truth, mask)), metric
    assert near["psnr"] == pytest.approx(-10 * np.log10(near["mse"]))
    assert near["dssim"] == pytest.approx((1 - near["ssim"]) / 2)
    assert rows[0].facts == comparison.case.facts and near.keys() == far.keys() <= METRICS.keys()
    for name, value in near.items():
        assert (value < far[name]) is METRICS[name].lower_is_better, name


def test_display_space_is_of_the_encoded_images(comparison: Comparison) -> None:
    (near, _) = measure(comparison, Measures(space="display"))
    p, t = linear_to_srgb(comparison.predictions["near"]), linear_to_srgb(comparison.truth)
    assert near.values["si_mse"] == pytest.approx(si_mse(p, t, comparison.mask))
    assert near.values["si_mse"] != pytest.approx(measure(comparison, Measures())[0].values["si_mse"])


def test_faces_are_shown_masked_and_at_the_truths_exposure(
    comparison: Comparison, descriptors: list[np.ndarray]
) -> None:
    rows = measure(replace(comparison, landmarks_px=LANDMARKS), Measures(space="linear"))
    true, near, _ = descriptors  # the truth's once
    gain = 2 ** auto_exposure_ev(comparison.truth, comparison.mask)
    for image, linear in ((true, comparison.truth), (near, comparison.predictions["near"])):
        expected = linear_to_srgb((linear * gain).clip(0, 1)) * comparison.mask[..., None]
        np.testing.assert_allclose(image, expected, atol=1e-6)
    distance = np.linalg.norm(true.mean((0, 1)) - near.mean((0, 1)))
    assert rows[0].values["face_distance"] == pytest.approx(distance)
    assert "face_distance" not in measure(comparison, Measures())[0].values
    unmeasured = measure(replace(comparison, landmarks_px=LANDMARKS), Measures(), faces=False)
    assert "face_distance" not in unmeasured[0].values


def test_the_source_has_face_dis_as_its_own_face_is_shown(
    comparison: Comparison, descriptors: list[np.ndarray]
) -> None:
    """A row of its own, so that it stands beside the methods'; in its own frame, mask and exposure."""
    source = np.random.default_rng(1).gamma(1.0, 0.1, (9, 7, 3)).astype(np.float32)
    mask = np.zeros((9, 7), np.float32)
    mask[2:8, 1:6] = 1
    given = replace(comparison, landmarks_px=LANDMARKS, source=source, source_face=(mask, LANDMARKS))
    *_, row = measure(given, Measures())
    expected = linear_to_srgb((source * 2 ** auto_exposure_ev(source, mask)).clip(0, 1)) * mask[..., None]
    np.testing.assert_allclose(descriptors[-1], expected, atol=1e-6)
    distance = np.linalg.norm(descriptors[0].mean((0, 1)) - expected.mean((0, 1)))
    assert (row.method, row.values) == (SOURCE, {"face_distance": pytest.approx(distance)})


def test_lpips_is_of_what_is_display(comparison: Comparison, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def metric(ours: np.ndarray, true: np.ndarray) -> float:
        seen.append((ours, true))
        return 0.25

    monkeypatch.setattr(module, "perceptual_metric", lambda heads, vgg, device: metric)
    rows, truth = measure(comparison, Measures(vgg_weights="imagenet")), comparison.truth
    assert [row.values["lpips"] for row in rows] == [0.25, 0.25]
    np.testing.assert_array_equal(seen[0][0], display(comparison.predictions["near"], truth, comparison.mask))
    np.testing.assert_array_equal(seen[0][1], display(truth, truth, comparison.mask))
    assert "lpips" not in measure(comparison, Measures())[0].values


def test_what_a_protocol_measured_is_kept_and_a_scale_a_channel_forgives_colour(
    comparison: Comparison,
) -> None:
    near, far = measure(replace(comparison, extra={"far": {"light_error_deg": 3.0}}), Measures())
    assert far.values["light_error_deg"] == 3 and "light_error_deg" not in near.values
    truth, mask = np.random.default_rng(0).random((6, 8, 3)), np.ones((6, 8))
    assert si_mse_channels(truth * [1, 2, 3], truth, mask) < 1e-20 < si_mse(truth * [1, 2, 3], truth, mask)
    assert si_mse_channels(truth[::-1], truth, mask) > 0.01


def test_what_cannot_be_compared_is_refused_in_words(comparison: Comparison) -> None:
    far, mask, truth = comparison.predictions["far"], comparison.mask, comparison.truth
    for changed, words in (
        ({"predictions": {"far": far[:, 1:]}}, "far has 25 x 20 pixels, the truth 26 x 20"),
        ({"truth": np.where(truth > 0.5, np.inf, truth)}, "the truth contains non-finite values"),
        ({"predictions": {"far": np.where(far > 0.5, np.nan, far)}}, "far contains non-finite values"),
        ({"mask": mask[1:]}, "the mask has 26 x 19 pixels"),
        ({"mask": 0 * mask}, "the mask contains no part"),
    ):
        refused(InputError, f"a/b: {words}", measure, replace(comparison, **changed), Measures())


def test_a_black_prediction_is_measured_and_a_truth_near_black_has_no_si_mse(comparison: Comparison) -> None:
    truth = comparison.truth
    (black,) = measure(replace(comparison, predictions={"black": 0 * truth}), Measures())
    assert all(np.isfinite(list(black.values.values())))
    level = np.sqrt(np.average((truth**2).mean(-1), weights=comparison.mask))
    for space in ("linear", "display"):
        for brightness, measured in ((0.0, False), (0.0199, False), (0.0201, True)):
            dim = replace(comparison, truth=truth * np.float32(brightness / level))
            for row in measure(dim, Measures(space=space)):
                unknown = {name for name, value in row.values.items() if np.isnan(value)}
                assert unknown == (set() if measured else {"si_mse", "si_mse_clipped", "si_mse_channels"})
