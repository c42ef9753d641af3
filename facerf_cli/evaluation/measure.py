"""The images of a case and the figures of each method on them: the metrics that every protocol shares."""

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.metrics import mse, psnr_of, si_mse, si_mse_channels, si_mse_clipped, ssim
from facerf_cli.evaluation.options import Measures, Space
from facerf_cli.face.descriptor import face_descriptor
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb, srgb_to_linear
from facerf_cli.network.checkpoint import read_tensors
from facerf_cli.network.features import SMALLEST_PX, Lpips
from facerf_cli.network.vgg import load_vgg


@dataclass(frozen=True)
class Case:
    """One image to be measured.

    `name` is a path without suffix, unique in its run; predictions in files are found by it. `person` is
    whose face it shows: intervals resample people. Facts that are text break the tables down
    ('pose': 'same pose'); numbers go to the list of images only.
    """

    name: str
    person: str
    facts: Mapping[str, str | float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Comparison:
    """A case with its images, scene-linear Rec.709 [H, W, 3], all in one frame.

    They are compared inside the mask [H, W] in 0..1. `source` is the image that the methods were given, in
    its own frame. landmarks_px [68, 2] are those of the truth, for the face-recognition distance; without
    them it is not measured. `source_face`, for that of the source, is the face's mask [h, w] in the source
    and its landmarks [68, 2] there. `extra` holds each method's figures that only the protocol can compute
    ('light_error_deg'). `light` is a lat-long map of the light to render, for methods that read maps.
    """

    case: Case
    truth: np.ndarray
    mask: np.ndarray
    predictions: Mapping[str, np.ndarray]  # by method
    source: np.ndarray | None = None
    landmarks_px: np.ndarray | None = None
    source_face: tuple[np.ndarray, np.ndarray] | None = None
    extra: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # by method
    light: np.ndarray | None = None


CPU = torch.device("cpu")
NEAR_BLACK = 0.02  # root mean square: the Si-MSE of a darker truth is below .0004 for any image
SOURCE = "source, not relit"  # the row of the source's Face dis
_PACKAGE, _FILE = "lpips", "weights/v0.1/vgg.pth"  # Zhang et al., LPIPS v0.1, BSD 2-Clause
_ADVICE = "give --lpips lpips/weights/v0.1/vgg.pth of the package lpips"
# SHA-256 of the heads' values, float32 little-endian. Version 0.0 has heads of the same names and shapes.
_DIGEST = "9153a2043dccf3b525d4f13db916e93ef040548ea923b6f2100de5ebac141a78"


@cache
def perceptual_metric(
    heads: Path | None, vgg_weights: str | Path, device: torch.device = CPU
) -> Callable[[np.ndarray, np.ndarray], float]:
    """Load LPIPS of two sRGB images [H, W, 3] in 0..1, computed on a device, once a process.

    `heads` is the file of `--lpips` (None: that of the installed package), `vgg_weights` the value of
    `--vgg-weights`. Raises UsageError or InputError for weights that are missing or others.
    """
    network = Lpips()
    path = heads or _installed_heads()
    try:
        network.load_heads(read_tensors(path, _ADVICE))
    except ValueError as error:
        raise InputError(f"{path}: no heads of LPIPS on VGG ({error}); {_ADVICE}") from None
    if _digest(network) != _DIGEST:
        raise InputError(f"{path}: not the published heads of LPIPS v0.1 on VGG; {_ADVICE}")
    load_vgg(vgg_weights, network.trunk)
    return lpips_by(network.eval().requires_grad_(False).to(device))


def lpips_by(network: Lpips) -> Callable[[np.ndarray, np.ndarray], float]:
    """LPIPS of two sRGB images [H, W, 3] in 0..1, on the network's device."""
    device = network.heads[0].device

    def distance(prediction_srgb: np.ndarray, truth_srgb: np.ndarray) -> float:
        if min(truth_srgb.shape[:2]) < SMALLEST_PX:
            raise InputError(f"LPIPS: needs images of {SMALLEST_PX} px a side; leave --vgg-weights out")
        both = srgb_to_linear(np.stack([prediction_srgb, truth_srgb]))
        tensors = torch.from_numpy(both).permute(0, 3, 1, 2).to(device)
        return float(network(tensors[:1], tensors[1:]))

    return distance


def _installed_heads() -> Path:
    """Find the heads' file of the package `lpips` without importing it, since that needs torchvision."""
    spec = find_spec(_PACKAGE)
    path = Path(spec.origin).parent / _FILE if spec and spec.origin else None
    if path is None or not path.is_file():
        raise UsageError(f"LPIPS: its own weights are missing; install the package {_PACKAGE}, or {_ADVICE}")
    return path


def _digest(network: Lpips) -> str:
    values = torch.cat([head.detach().flatten() for head in network.heads]).numpy().astype("<f4")
    return hashlib.sha256(values.tobytes()).hexdigest()


@dataclass(frozen=True)
class Metric:
    """A metric in a table: its title, its direction, and its digits after the decimal point."""

    title: str
    lower_is_better: bool = True
    digits: int = 5

    @property
    def better(self) -> str:
        """Which values are better, in a word."""
        return "less" if self.lower_is_better else "more"


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
class Row:
    """One method's figures on one image: `values` by metric; `facts` are the case's."""

    case: str
    person: str
    method: str
    facts: Mapping[str, str | int | float]
    values: Mapping[str, float]


def measure(
    comparison: Comparison, measures: Measures, faces: bool = True, device: torch.device = CPU
) -> list[Row]:
    """Measure each method's prediction, and with `faces` Face dis, of the source too if its face is known.

    Each Si-MSE is NaN where the truth `is_near_black`. Face dis and LPIPS compare images as `shown` returns
    them, in any space; LPIPS is computed on the device. Raises InputError where a prediction has another size
    than the truth or values that are not finite, or where the mask is empty.
    """
    _check(comparison)
    case, landmarks_px = comparison.case, comparison.landmarks_px if faces else None
    truth, mask = comparison.truth, comparison.mask
    true = shown(truth, truth, mask)
    descriptor = None if landmarks_px is None else face_descriptor(true, landmarks_px)
    rows = []
    for method, prediction in comparison.predictions.items():
        values = _pixel_values(prediction, comparison, measures.space)
        ours = shown(prediction, truth, mask)
        if measures.vgg_weights is not None:
            lpips = perceptual_metric(measures.lpips, measures.vgg_weights, device)
            values["lpips"] = lpips(ours, true)
        if descriptor is not None and landmarks_px is not None:
            values["face_distance"] = float(np.linalg.norm(face_descriptor(ours, landmarks_px) - descriptor))
        values |= comparison.extra.get(method, {})
        rows.append(Row(case.name, case.person, method, case.facts, values))
    if descriptor is not None and comparison.source is not None and comparison.source_face is not None:
        source, (face, places_px) = comparison.source, comparison.source_face
        given = face_descriptor(shown(source, source, face), places_px)
        distance = float(np.linalg.norm(given - descriptor))
        rows.append(Row(case.name, case.person, SOURCE, case.facts, {"face_distance": distance}))
    return rows


def shown(image: np.ndarray, exposed_as: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Encode an image [H, W, 3] for a viewer: masked, exposed as an image within the mask, sRGB in 0..1."""
    exposed = np.clip(image * np.float32(2.0 ** auto_exposure_ev(exposed_as, mask)), 0, 1)
    return linear_to_srgb(exposed) * mask[..., None].astype(np.float32)


def is_near_black(truth: np.ndarray, mask: np.ndarray) -> bool:
    """True for a truth [H, W, 3] that is too dark within its mask [H, W] for Si-MSE to tell methods apart."""
    return float(np.average(np.square(truth, dtype=np.float64).mean(-1), weights=mask)) < NEAR_BLACK**2


def _pixel_values(prediction: np.ndarray, comparison: Comparison, space: Space) -> dict[str, float]:
    images = prediction, comparison.truth
    p, t = map(linear_to_srgb, images) if space == "display" else images
    mask = comparison.mask
    squared, alike = mse(p, t, mask), ssim(p, t, mask)
    dark = is_near_black(comparison.truth, mask)
    return {
        "si_mse": math.nan if dark else si_mse(p, t, mask),
        "si_mse_clipped": math.nan if dark else si_mse_clipped(p, t, mask),
        "si_mse_channels": math.nan if dark else si_mse_channels(p, t, mask),
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
