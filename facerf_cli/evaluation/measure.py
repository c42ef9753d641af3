"""Metrics of the methods on one case: compare their images with the ground truth."""

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import BeforeValidator

from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.metrics import mse, psnr, si_mse, si_mse_channels, si_mse_clipped, ssim
from facerf_cli.evaluation.options import Measures, Space
from facerf_cli.face.descriptor import face_descriptor
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb, srgb_to_linear
from facerf_cli.network.checkpoint import read_tensors
from facerf_cli.network.features import SMALLEST_PX, Lpips
from facerf_cli.network.vgg import load_vgg


@dataclass(frozen=True)
class Case:
    """Name, person and facts of a measured image.

    `name` is a path without suffix, unique in the run, that locates predictions in files. Confidence
    intervals resample by `person`. Text in `facts` breaks down the tables ('pose': 'same pose'); numbers only
    appear in images.csv.
    """

    name: str
    person: str
    facts: Mapping[str, str | float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Images of a case, scene-linear Rec.709 [H, W, 3], which share one frame except `source`.

    `source_face` contains the mask [h, w] and the landmarks [68, 2] of the face in the source. `extra`
    contains each method's metrics that only the protocol can compute ('light_error_deg').
    """

    case: Case
    truth: np.ndarray
    mask: np.ndarray  # [H, W] in 0..1, weight of the compared pixels
    predictions: Mapping[str, np.ndarray]  # by method
    source: np.ndarray | None = None  # the methods' input
    landmarks_px: np.ndarray | None = None  # [68, 2] of the truth; without them, Face dis is not measured
    source_face: tuple[np.ndarray, np.ndarray] | None = None
    extra: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # by method
    light: np.ndarray | None = None  # lat-long map of the light to render, for methods that read maps


CPU = torch.device("cpu")
NEAR_BLACK = 0.02  # root mean square; every prediction of a darker truth has a Si-MSE below .0004
SOURCE = "source, not relit"  # method name of the source's Face dis
_PACKAGE, _FILE = "lpips", "weights/v0.1/vgg.pth"  # Zhang et al., LPIPS v0.1, BSD 2-Clause
_ADVICE = "use --lpips lpips/weights/v0.1/vgg.pth of the package lpips"
# SHA-256 of the heads' values, float32 little-endian. Version 0.0 has heads of the same names and shapes.
_DIGEST = "9153a2043dccf3b525d4f13db916e93ef040548ea923b6f2100de5ebac141a78"


@cache
def perceptual_metric(
    heads: Path | None, vgg_weights: str | Path, device: torch.device = CPU
) -> Callable[[np.ndarray, np.ndarray], float]:
    """Load LPIPS as a function of two sRGB images [H, W, 3] in 0..1, once per process.

    `heads` is the file of `--lpips` (None: the file of the installed package), `vgg_weights` the value of
    `--vgg-weights`. Raises UsageError or InputError for missing or unexpected weights.
    """
    network = Lpips()
    path = heads or _installed_heads()
    try:
        network.load_heads(read_tensors(path, _ADVICE))
    except ValueError as error:
        raise InputError(f"{path}: not the heads of LPIPS on VGG ({error}); {_ADVICE}") from None
    if _digest(network) != _DIGEST:
        raise InputError(f"{path}: not the published heads of LPIPS v0.1 on VGG; {_ADVICE}")
    load_vgg(vgg_weights, network.trunk)
    return lpips_by(network.eval().requires_grad_(False).to(device))


def lpips_by(network: Lpips) -> Callable[[np.ndarray, np.ndarray], float]:
    """Return LPIPS as a function of two sRGB images [H, W, 3] in 0..1, computed on the network's device."""
    device = network.heads[0].device

    def distance(prediction_srgb: np.ndarray, truth_srgb: np.ndarray) -> float:
        if min(truth_srgb.shape[:2]) < SMALLEST_PX:
            raise InputError(f"LPIPS: needs images of at least {SMALLEST_PX} px a side; remove --vgg-weights")
        both = srgb_to_linear(np.stack([prediction_srgb, truth_srgb]))
        tensors = torch.from_numpy(both).permute(0, 3, 1, 2).to(device)
        return float(network(tensors[:1], tensors[1:]))

    return distance


def _installed_heads() -> Path:
    """Locate the file of the package `lpips` without importing it, because the import needs torchvision."""
    spec = find_spec(_PACKAGE)
    path = Path(spec.origin).parent / _FILE if spec and spec.origin else None
    if path is None or not path.is_file():
        raise UsageError(f"LPIPS: its weights are missing; install the package {_PACKAGE}, or {_ADVICE}")
    return path


def _digest(network: Lpips) -> str:
    values = torch.cat([head.detach().flatten() for head in network.heads]).numpy().astype("<f4")
    return hashlib.sha256(values.tobytes()).hexdigest()


@dataclass(frozen=True)
class Metric:
    """How tables show a metric: title, direction, and digits after the decimal point."""

    title: str
    lower_is_better: bool = True
    digits: int = 5

    @property
    def better(self) -> str:
        return "less" if self.lower_is_better else "more"


METRICS: Mapping[str, Metric] = {  # in the order of tables; a row contains the metrics that apply to it
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
    "tone_drift_deg": Metric("skin tone drift, degrees of ITA", digits=1),  # absolute value of the shift
    "tone_shift_deg": Metric("skin tone drift, above 0 too light", digits=1),
}


@dataclass(frozen=True)
class Row:
    """Metrics of one method on one image, `values` by name, with the facts of its case."""

    case: str
    person: str
    method: str
    facts: Mapping[str, str | int | float]
    values: Mapping[str, Annotated[float, BeforeValidator(lambda x: math.nan if x is None else x)]]


def measure(
    comparison: Comparison, measures: Measures, faces: bool = True, device: torch.device = CPU
) -> list[Row]:
    """Measure each method's prediction; with `faces`, also measure Face dis of the methods and the source.

    Each Si-MSE is NaN if the truth `is_near_black`. Face dis and LPIPS always compare images encoded by
    `display`; LPIPS is computed on the device. Raises InputError if images differ in size or contain
    non-finite values, or if the mask is empty.
    """
    _require_comparable(comparison)
    case, landmarks_px = comparison.case, comparison.landmarks_px if faces else None
    truth, mask = comparison.truth, comparison.mask
    true = display(truth, truth, mask)
    descriptor = None if landmarks_px is None else face_descriptor(true, landmarks_px)
    rows = []
    for method, prediction in comparison.predictions.items():
        values = _pixel_values(prediction, comparison, measures.space)
        ours = display(prediction, truth, mask)
        if measures.vgg_weights is not None:
            lpips = perceptual_metric(measures.lpips, measures.vgg_weights, device)
            values["lpips"] = lpips(ours, true)
        if descriptor is not None and landmarks_px is not None:
            values["face_distance"] = float(np.linalg.norm(face_descriptor(ours, landmarks_px) - descriptor))
        values |= comparison.extra.get(method, {})
        rows.append(Row(case.name, case.person, method, case.facts, values))
    if descriptor is not None and comparison.source is not None and comparison.source_face is not None:
        source, (face, source_landmarks_px) = comparison.source, comparison.source_face
        of_source = face_descriptor(display(source, source, face), source_landmarks_px)
        distance = float(np.linalg.norm(of_source - descriptor))
        rows.append(Row(case.name, case.person, SOURCE, case.facts, {"face_distance": distance}))
    return rows


def display(image: np.ndarray, exposed_as: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Mask an image [H, W, 3] and encode it as sRGB in 0..1, at the automatic exposure of `exposed_as`."""
    exposed = np.clip(image * np.float32(2.0 ** auto_exposure_ev(exposed_as, mask)), 0, 1)
    return linear_to_srgb(exposed) * mask[..., None].astype(np.float32)


def is_near_black(truth: np.ndarray, mask: np.ndarray) -> bool:
    """Return True if a truth [H, W, 3] is too dark inside its mask [H, W] for Si-MSE to separate methods."""
    return float(np.average(np.square(truth, dtype=np.float64).mean(-1), weights=mask)) < NEAR_BLACK**2


def _pixel_values(prediction: np.ndarray, comparison: Comparison, space: Space) -> dict[str, float]:
    images, mask = (prediction, comparison.truth), comparison.mask
    p, t = map(linear_to_srgb, images) if space == "display" else images
    squared, alike = mse(p, t, mask), ssim(p, t, mask)
    dark = is_near_black(comparison.truth, mask)
    return {
        "si_mse": math.nan if dark else si_mse(p, t, mask),
        "si_mse_clipped": math.nan if dark else si_mse_clipped(p, t, mask),
        "si_mse_channels": math.nan if dark else si_mse_channels(p, t, mask),
        "mse": squared,
        "psnr": psnr(squared),
        "ssim": alike,
        "dssim": (1 - alike) / 2,
    }


def _require_comparable(comparison: Comparison) -> None:
    """Raise InputError if the images cannot be compared."""
    name, truth, mask = comparison.case.name, comparison.truth, comparison.mask
    height, width = truth.shape[:2]
    images = {"the mask": mask, "the truth": truth, **comparison.predictions}
    for method, image in images.items():
        if image.shape[:2] != (height, width):
            raise InputError(
                f"{name}: {method} has {image.shape[1]} x {image.shape[0]} pixels, the truth "
                f"{width} x {height}; use an image in the truth's frame"
            )
        if not np.isfinite(image).all():
            raise InputError(f"{name}: {method} contains non-finite values; correct or remove this image")
    if not (mask > 0).any():
        raise InputError(f"{name}: the mask contains no part of the face; remove this image")
