"""LPIPS where its weights are at hand: VGG-16's, and its own heads from a file or the package `lpips`.

From a picture's comparison to rows of figures, one a method: the metrics that every protocol shares.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from facerf_cli.colour import auto_exposure_ev, linear_to_srgb, srgb_to_linear
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.case import Comparison
from facerf_cli.face.recognition import descriptor_distance, face_descriptor
from facerf_cli.metrics import mse, psnr_of, si_mse, si_mse_channels, si_mse_clipped, ssim
from facerf_cli.network.feature_networks import SMALLEST_PX, Lpips
from facerf_cli.training.pretrained import load_vgg, read_tensors

LPIPS_LICENCE = "LPIPS v0.1, VGG heads: BSD 2-Clause, Zhang et al. (package lpips)"
_PACKAGE, _FILE = "lpips", "weights/v0.1/vgg.pth"
_ADVICE = "--lpips takes lpips/weights/v0.1/vgg.pth of the package lpips"
# Of the heads' values one after another, float32 little-endian. Version 0.0 has the same names and shapes.
_DIGEST = "9153a2043dccf3b525d4f13db916e93ef040548ea923b6f2100de5ebac141a78"


@cache
def perceptual_metric(
    heads: Path | None, vgg_weights: str | Path | None
) -> Callable[[np.ndarray, np.ndarray], float]:
    """LPIPS of two sRGB pictures [H, W, 3] in 0..1, loaded once a process.

    `heads` as `--lpips` has it (None: the installed package's), `vgg_weights` as `--vgg-weights`.
    """
    if vgg_weights is None:
        raise UsageError(
            "--lpips needs the weights of VGG-16, too: give --vgg-weights imagenet (fetches 528 MiB once), "
            "or --vgg-weights PATH of torchvision's vgg16-397923af.pth"
        )
    network = Lpips()
    _load_heads(network, heads or _bundled_heads())
    load_vgg(vgg_weights, network.trunk)
    network.eval().requires_grad_(False)

    def distance(ours_srgb: np.ndarray, true_srgb: np.ndarray) -> float:
        if min(true_srgb.shape[:2]) < SMALLEST_PX:
            raise InputError(f"LPIPS needs pictures of {SMALLEST_PX} px a side; leave --vgg-weights out")
        both = srgb_to_linear(np.stack([ours_srgb, true_srgb]))
        tensors = torch.from_numpy(both).permute(0, 3, 1, 2)
        return float(network(tensors[:1], tensors[1:]))

    return distance


def _bundled_heads() -> Path:
    """The heads' file of the package `lpips`, which is not imported: it needs torchvision."""
    spec = find_spec(_PACKAGE)
    path = Path(spec.origin).parent / _FILE if spec and spec.origin else None
    if path is None or not path.is_file():
        raise UsageError(f"LPIPS needs its own weights: install the package {_PACKAGE}, or {_ADVICE}")
    return path


def _load_heads(network: Lpips, path: Path) -> None:
    try:
        network.load_heads(read_tensors(path, _ADVICE))
    except ValueError as error:
        raise InputError(f"{path}: no heads of LPIPS on VGG: {error}") from None
    if _digest(network) != _DIGEST:
        raise InputError(f"{path}: not the published heads of LPIPS v0.1 on VGG; {_ADVICE}")


def _digest(network: Lpips) -> str:
    values = torch.cat([head.detach().flatten() for head in network.heads]).numpy().astype("<f4")
    return hashlib.sha256(values.tobytes()).hexdigest()


Space = Literal["linear", "display"]


@dataclass(frozen=True)
class Metric:
    """How a figure is shown: its title, whether less is better, and its digits after the point."""

    title: str
    lower_is_better: bool = True
    digits: int = 5


METRICS: Mapping[str, Metric] = {  # by name, in the order of tables; a row has those that it could have
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
    """Which metrics, of which values; picklable, for workers.

    `space` is of the pixel metrics: 'display' encodes pictures by sRGB first. LPIPS is measured where
    VGG-16's weights are given (`vgg_weights`: 'imagenet' or a file); its own heads come from `lpips`, or from
    the package of that name.
    """

    space: Space = "linear"
    lpips: Path | None = None
    vgg_weights: str | Path | None = None

    def check(self) -> None:
        """Load what is asked for, once a process: raises UsageError or InputError where it is not at hand."""
        if self.asks_for_lpips:
            perceptual_metric(self.lpips, self.vgg_weights)

    @property
    def asks_for_lpips(self) -> bool:
        """Whether rows will have it."""
        return self.lpips is not None or self.vgg_weights is not None


@dataclass(frozen=True)
class Row:
    """One method's figures on one picture: `values` by metric; `facts` are the case's."""

    case: str
    person: str
    method: str
    facts: Mapping[str, str | float]
    values: Mapping[str, float]


def measure(comparison: Comparison, how: Measures) -> list[Row]:
    """The rows of a picture, methods in their order.

    Face dis and LPIPS see both pictures as `shown` has them, whatever `how.space` says. Raises InputError
    where a prediction has another size than the truth or values that are not finite, or the mask is empty.
    """
    _check(comparison)
    case, landmarks_px = comparison.case, comparison.landmarks_px
    true = shown(comparison.truth, comparison)
    descriptor = None if landmarks_px is None else face_descriptor(true, landmarks_px)
    rows = []
    for method, prediction in comparison.predictions.items():
        values = _pixel_values(prediction, comparison, how.space)
        ours = shown(prediction, comparison)
        if how.asks_for_lpips:
            values["lpips"] = perceptual_metric(how.lpips, how.vgg_weights)(ours, true)
        if descriptor is not None and landmarks_px is not None:
            values["face_distance"] = descriptor_distance(face_descriptor(ours, landmarks_px), descriptor)
        values |= comparison.extra.get(method, {})
        rows.append(Row(case.name, case.person, method, case.facts, values))
    return rows


def shown(image: np.ndarray, comparison: Comparison) -> np.ndarray:
    """A picture [H, W, 3] as a viewer sees it: masked, at the truth's exposure, sRGB in 0..1."""
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
    """Raise InputError in words where pictures cannot be compared."""
    name, truth, mask = comparison.case.name, comparison.truth, comparison.mask
    if mask.shape != truth.shape[:2]:
        raise InputError(f"{name}: the mask has {_size(mask)} pixels, the truth {_size(truth)}")
    if not np.isfinite(truth).all():
        raise InputError(f"{name}: the truth holds values that are not finite")
    if not (mask > 0).any():
        raise InputError(f"{name}: nothing of the face is left in the mask; leave this picture out")
    for method, prediction in comparison.predictions.items():
        if prediction.shape[:2] != truth.shape[:2]:
            raise InputError(
                f"{name}: {method} has {_size(prediction)} pixels, the truth {_size(truth)}; predictions are "
                "to have the truth's frame"
            )
        if not np.isfinite(prediction).all():
            raise InputError(f"{name}: {method} holds values that are not finite")


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
