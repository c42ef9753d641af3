"""Image metrics, each with its definition and source, and means with confidence intervals.

Images are [H, W, 3] or [H, W], scene-linear Rec.709 or display-encoded as the caller chooses; 1 is white. The
mask [H, W] in 0..1 weights the pixels of every mean; channels have equal weight. A metric fits the exposure
of the prediction only if its definition mentions a scale.
"""

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from skimage.metrics import structural_similarity

from facerf_cli.image.colour import ita_deg, luminance

PSNR_HIGHEST_DB = 100.0  # reported for equal images, whose PSNR is infinite
_SMALLEST = 1e-12  # smallest denominator; avoids 0 / 0 for a black prediction
_SSIM_REACH_PX = 5  # half width of the SSIM window (Wang et al., 2004)

# Skin tones with the lowest ITA of each class, in degrees (Del Bino and Bernerd, 2013).
TONES = {
    "very light": 55.0,
    "light": 41.0,
    "intermediate": 28.0,
    "tan": 10.0,
    "brown": -30.0,
    "dark": -91.0,
}
_SKIN = 0.5  # mask value above which a pixel counts as skin
_GREY = 1e-6  # channel difference below which a colour has no ITA

# Bootstrap intervals.
_RESAMPLES, _SEED = 10_000, 0
_DRAWN_AT_ONCE = 1 << 22  # indices; bounds the memory
_PERCENTILES = (2.5, 97.5)


def best_scale(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Return the scale a >= 0, one for all channels, that minimizes |a P - T|^2 in the mask: <P, T> / <P, P>.

    Zhou et al., *Deep Single-Image Portrait Relighting*, ICCV 2019. A black prediction has the scale 0;
    negative scales are replaced by 0.
    """
    p, t, weight = _inside(prediction, truth, mask)
    return max(0.0, float((weight * p * t).sum() / max((weight * p * p).sum(), _SMALLEST)))


def si_mse(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Return the scale-invariant mean squared error: the mean of |a P - T|^2 for a = `best_scale`.

    Zhou et al., ICCV 2019; the paper's Si-MSE ('Results'). Nothing is clipped. The paper's Table 1 uses
    linear values.
    """
    scale = best_scale(prediction, truth, mask)
    p, t, weight = _inside(prediction, truth, mask)
    return float((weight * (scale * p - t) ** 2).sum() / weight.sum())


def si_mse_clipped(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Return `si_mse` to the truth clipped at white (1), so that a small highlight does not dominate."""
    return si_mse(prediction, np.minimum(truth, 1), mask)


def si_mse_channels(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Return `si_mse` with one scale per channel: one photo cannot separate red light from red skin."""
    return float(np.mean([si_mse(prediction[..., c], truth[..., c], mask) for c in range(3)]))


def mse(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Return the mean squared error of images clipped to 0..1, without a scale."""
    p, t, weight = _inside(np.clip(prediction, 0, 1), np.clip(truth, 0, 1), mask)
    return float((weight * (p - t) ** 2).sum() / weight.sum())


def psnr(squared: float) -> float:
    """Convert a mean squared error to the PSNR for a peak of 1, in dB, at most `PSNR_HIGHEST_DB`."""
    return float(-10 * np.log10(max(squared, 10 ** (-PSNR_HIGHEST_DB / 10))))


def ssim(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Return the structural similarity of clip(a P, 0, 1), a = `best_scale`, to clip(T, 0, 1); 1 if equal.

    Wang et al., *Image Quality Assessment: From Error Visibility to Structural Similarity*, 2004: Gaussian
    window of sigma 1.5 px over 11 px, data range 1, separate channels. Both images are multiplied by the
    mask, and the SSIM map is averaged with its weights, so pixels outside count as equal and black.
    """
    scale = best_scale(prediction, truth, mask)
    box = _box(mask, _SSIM_REACH_PX)
    weight = mask[box].astype(np.float64)
    shape = (*weight.shape, -1)
    p = np.clip(scale * prediction[box].astype(np.float64), 0, 1).reshape(shape) * weight[..., None]
    t = np.clip(truth[box].astype(np.float64), 0, 1).reshape(shape) * weight[..., None]
    reach = _SSIM_REACH_PX  # the library rejects images that are smaller than its window
    p, t = (np.pad(image, ((reach, reach), (reach, reach), (0, 0)), mode="symmetric") for image in (p, t))
    _, similar = structural_similarity(
        p, t, data_range=1, channel_axis=-1, gaussian_weights=True, use_sample_covariance=False, full=True
    )
    similar = similar[reach:-reach, reach:-reach].mean(-1)
    return float((weight * similar).sum() / weight.sum())


def light_error_deg(direction: np.ndarray, truth: np.ndarray) -> float:
    """Return the angle in degrees between two directions toward the light [3] of any nonzero length."""
    lengths = np.linalg.norm(direction), np.linalg.norm(truth)
    if not min(lengths) > 0:
        raise ValueError(f"directions of lengths {lengths[0]} and {lengths[1]} have no angle")
    # The arctangent of both products stays accurate for small angles.
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(direction, truth)), np.dot(direction, truth))))


def tone_of(ita: float) -> str:
    """Return the class in `TONES` for an ITA in degrees."""
    return next((name for name, lowest in TONES.items() if ita > lowest), "dark")


def tone_drift_deg(
    prediction: np.ndarray, truth: np.ndarray, skin: np.ndarray, albedo: np.ndarray
) -> float | None:
    """Return the ITA of predicted skin minus the ITA of the truth, in degrees; above 0 is too light.

    prediction and truth [H, W, 3] are linear, under white light from near the camera; `skin` [H, W] exceeds
    one half where both show skin. One factor scales both images, so that the truth's median skin has the
    luminance of the true `albedo` [3]; therefore a wrong exposure counts as a wrong tone. Without skin, or if
    the truth is grey, the result is None.
    """
    inside = skin > _SKIN
    if not inside.any():
        return None
    ours, true = (np.median(image[inside].astype(np.float64), 0) for image in (prediction, truth))
    if np.ptp(true) < _GREY or not luminance(true) > 0:
        return None
    exposure = luminance(np.asarray(albedo, np.float64)) / luminance(true)
    return float(ita_deg(ours * exposure) - ita_deg(true * exposure))


def _inside(
    prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return both images' pixels where the mask is above 0 [N, C], and their weights [N, C]; float64."""
    if prediction.shape != truth.shape or truth.shape[:2] != mask.shape or truth.ndim not in (2, 3):
        raise ValueError(f"images {prediction.shape} and {truth.shape} and a mask {mask.shape}")
    inside = mask > 0
    if not inside.any():
        raise ValueError("the mask is empty")
    p, t = (image[inside].astype(np.float64).reshape(inside.sum(), -1) for image in (prediction, truth))
    return p, t, np.broadcast_to(mask[inside].astype(np.float64)[:, None], t.shape)


def _box(mask: np.ndarray, margin_px: int) -> tuple[slice, slice]:
    """Return the mask's bounding box with a margin, clipped to the image."""

    def span(sums: np.ndarray) -> slice:
        nonzero = np.flatnonzero(sums > 0)
        return slice(max(0, nonzero[0] - margin_px), nonzero[-1] + 1 + margin_px)

    return span(mask.sum(1)), span(mask.sum(0))


@dataclass(frozen=True)
class Interval:
    """Mean of a metric over images, its 95 % interval over groups, and the images' median and deviation."""

    mean: float
    median: float
    low: float
    high: float
    sd: float  # over images
    images: int
    groups: int

    def as_dict(self) -> dict[str, float]:
        """Return the fields for JSON, with the key 'pictures' for `images`."""
        return {"pictures" if name == "images" else name: value for name, value in vars(self).items()}


def mean_interval(values: Iterable[tuple[Hashable, float]]) -> Interval | None:
    """Return the mean of (group, value) pairs with its interval; None without pairs.

    Images of one person are similar, so people (groups) are resampled with all of their images: a cluster
    bootstrap with percentile intervals (Efron and Tibshirani, *An introduction to the bootstrap*, 1993). The
    interval of a single group is NaN.
    """
    by_group: dict[Hashable, list[float]] = {}
    for group, value in values:
        by_group.setdefault(group, []).append(value)
    if not by_group:
        return None
    everything = np.concatenate([np.asarray(group, float) for group in by_group.values()])
    low, high = _bootstrap(list(by_group.values()))
    mean, median, sd = (float(f(everything)) for f in (np.mean, np.median, np.std))
    return Interval(mean, median, low, high, sd, len(everything), len(by_group))


def _bootstrap(groups: Sequence[Sequence[float]]) -> tuple[float, float]:
    if len(groups) < 2:
        return float("nan"), float("nan")
    totals = np.array([sum(group) for group in groups])
    counts = np.array([len(group) for group in groups])
    random, means = np.random.default_rng(_SEED), np.empty(_RESAMPLES)
    for first in range(0, _RESAMPLES, at_once := max(1, _DRAWN_AT_ONCE // len(groups))):
        part = means[first : first + at_once]
        drawn = random.integers(len(groups), size=(len(part), len(groups)))
        part[:] = totals[drawn].sum(1) / counts[drawn].sum(1)
    low, high = np.percentile(means, _PERCENTILES)
    return float(low), float(high)
