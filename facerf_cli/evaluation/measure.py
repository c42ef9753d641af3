"""Rows of figures from a comparison, one for each method: the metrics that every protocol shares."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from facerf_cli.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.errors import InputError
from facerf_cli.evaluation.case import Comparison
from facerf_cli.evaluation.perceptual import perceptual_metric
from facerf_cli.face.recognition import descriptor_distance, face_descriptor
from facerf_cli.metrics import mse, psnr_of, si_mse, si_mse_channels, si_mse_clipped, ssim

Space = Literal["linear", "display"]


@dataclass(frozen=True)
class Metric:
    """A metric in a table: its title, its direction, and its digits after the decimal point."""

    title: str
    lower_is_better: bool = True
    digits: int = 5


METRICS: Mapping[str, Metric] = {  # by name, in the order of tables; a row has those that apply to it
    "si_mse": Metric("Si-MSE"),
    "si_mse_clipped": Metric("Si-MSE, truth clipped at white"),
    "si_mse_channels": Metric("Si-MSE, a scale for each channel"),
    "mse": Metric("MSE"),
    "psnr": Metric("PSNR, dB", lower_is_better=False, digits=2),
    "ssim": Metric("SSIM", lower_is_better=False, digits=4),
    "dssim": Metric("DSSIM", digits=4),
    "lpips": Metric("LPIPS (VGG, v0.1)", digits=4),
    "face_distance": Metric("Face dis", digits=3),
    "light_error_deg": Metric("light direction, degrees", digits=1),
    "tone_drift_deg": Metric("skin tone drift, degrees of ITA", digits=1),  # without its sign
    "tone_shift_deg": Metric("skin tone drift, above 0 too light", digits=1),
}


@dataclass(frozen=True)
class Measures:
    """The choice of metrics and values; settings only, so that it can be sent to other processes.

    The pixel metrics are of linear values, or with the space 'display' of values encoded by sRGB. LPIPS is
    measured if VGG-16's weights are given (`vgg_weights`: 'imagenet' or a file); its own heads are read from
    the file `lpips`, or from the package of that name.
    """

    space: Space = "linear"
    lpips: Path | None = None
    vgg_weights: str | Path | None = None

    def check(self) -> None:
        """Load the weights, once a process; raises UsageError or InputError where they are missing."""
        if self.with_lpips:
            perceptual_metric(self.lpips, self.vgg_weights)

    @property
    def with_lpips(self) -> bool:
        """True if LPIPS is measured."""
        return self.lpips is not None or self.vgg_weights is not None


@dataclass(frozen=True)
class Row:
    """One method's figures on one image: `values` by metric; `facts` are the case's."""

    case: str
    person: str
    method: str
    facts: Mapping[str, str | int | float]
    values: Mapping[str, float]


def measure(comparison: Comparison, measures: Measures) -> list[Row]:
    """Measure each method's prediction.

    Face dis and LPIPS compare images as `shown` returns them, in any space. Raises InputError where a
    prediction has another size than the truth or values that are not finite, or where the mask is empty.
    """
    _check(comparison)
    case, landmarks_px = comparison.case, comparison.landmarks_px
    true = shown(comparison.truth, comparison)
    descriptor = None if landmarks_px is None else face_descriptor(true, landmarks_px)
    rows = []
    for method, prediction in comparison.predictions.items():
        values = _pixel_values(prediction, comparison, measures.space)
        ours = shown(prediction, comparison)
        if measures.with_lpips:
            values["lpips"] = perceptual_metric(measures.lpips, measures.vgg_weights)(ours, true)
        if descriptor is not None and landmarks_px is not None:
            values["face_distance"] = descriptor_distance(face_descriptor(ours, landmarks_px), descriptor)
        values |= comparison.extra.get(method, {})
        rows.append(Row(case.name, case.person, method, case.facts, values))
    return rows


def shown(image: np.ndarray, comparison: Comparison) -> np.ndarray:
    """Encode an image [H, W, 3] for a viewer: masked, at the truth's exposure, sRGB in 0..1."""
    ev = auto_exposure_ev(comparison.truth, comparison.mask)
    exposed = np.clip(image * np.float32(2.0**ev), 0, 1)
    return linear_to_srgb(exposed) * comparison.mask[..., None].astype(np.float32)


def _pixel_values(prediction: np.ndarray, comparison: Comparison, space: Space) -> dict[str, float]:
    images = prediction, comparison.truth
    p, t = map(linear_to_srgb, images) if space == "display" else images
    mask = comparison.mask
    squared, alike = mse(p, t, mask), ssim(p, t, mask)
    return {
        "si_mse": si_mse(p, t, mask),
        "si_mse_clipped": si_mse_clipped(p, t, mask),
        "si_mse_channels": si_mse_channels(p, t, mask),
        "mse": squared,
        "psnr": psnr_of(squared),
        "ssim": alike,
        "dssim": (1 - alike) / 2,
    }


def _check(comparison: Comparison) -> None:
    """Raise InputError where images cannot be compared."""
    name, truth, mask = comparison.case.name, comparison.truth, comparison.mask
    if mask.shape != truth.shape[:2]:
        raise InputError(
            f"{name}: the mask has {_size(mask)} pixels, the truth {_size(truth)}; give one of its size"
        )
    if not np.isfinite(truth).all():
        raise InputError(f"{name}: the truth holds values that are not finite; leave this image out")
    if not (mask > 0).any():
        raise InputError(f"{name}: nothing of the face is left in the mask; leave this image out")
    for method, prediction in comparison.predictions.items():
        if prediction.shape[:2] != truth.shape[:2]:
            raise InputError(
                f"{name}: {method} has {_size(prediction)} pixels, the truth {_size(truth)}; "
                "give an image in the truth's frame"
            )
        if not np.isfinite(prediction).all():
            raise InputError(f"{name}: {method} holds values that are not finite; give finite ones")


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
