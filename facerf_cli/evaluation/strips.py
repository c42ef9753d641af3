"""Strips of a case's images for the report: source over truth, then each method's image over its error."""

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageOps

from facerf_cli.evaluation.measure import Comparison
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.image.metrics import best_scale

ERROR_HIGHEST = 0.2  # of display values 0..1: the end of the false colours
# Dark to bright by violet and orange; the lightness only rises, so that the error also reads in grey.
ERROR_COLOURS = ((8, 6, 20), (87, 22, 110), (187, 55, 84), (249, 142, 9), (252, 250, 176))
_TILE_PX = 192  # the longer side
_GAP_PX = 4  # between tiles
_GAP = (128,) * 3  # grey of the gap, that glares neither on a light page nor on a dark one
_OUTSIDE = 0.16  # display value of what is not compared


@dataclass(frozen=True)
class Strip:
    """Facts on a case's strip: source over truth, then the methods' images over their errors.

    Images are at the truth's exposure `ev`, the methods' multiplied by `scales`, which are 1 if no scale was
    sought. A source has its own exposure; without a source, the mask is there. `file` is the path of the JPEG
    below the evaluation's folder, once it is written.
    """

    case: str
    file: str
    methods: tuple[str, ...]
    ev: float
    scales: tuple[float, ...]
    has_source: bool
    size_px: tuple[int, int]  # width, height


def draw_strip(comparison: Comparison, scaled: bool) -> tuple[Strip, Image.Image]:
    """Draw a case's strip; `scaled` multiplies predictions by the scale that Si-MSE finds."""
    truth, mask, source = comparison.truth, comparison.mask, comparison.source
    ev = auto_exposure_ev(truth, mask)
    true = _display(truth, ev)
    first = mask if source is None else _display(source, auto_exposure_ev(source))
    columns, scales = [(first, true)], []
    weight = mask[..., None].astype(np.float32)
    for prediction in comparison.predictions.values():
        scales.append(best_scale(prediction, truth, mask) if scaled else 1.0)
        ours = _display(scales[-1] * prediction, ev)
        inside = weight * ours + (1 - weight) * np.float32(_OUTSIDE)
        columns.append((inside, _error(ours, true, mask)))
    longer = max(truth.shape[:2])
    height, width = (round(_TILE_PX * side / longer) or 1 for side in truth.shape[:2])
    size_px = len(columns) * (width + _GAP_PX) - _GAP_PX, 2 * (height + _GAP_PX) - _GAP_PX
    image = Image.new("RGB", size_px, _GAP)
    for column, tiles in enumerate(columns):
        for row, tile in enumerate(tiles):
            place = column * (width + _GAP_PX), row * (height + _GAP_PX)
            image.paste(_fitted(tile, (width, height)), place)
    strip = Strip(
        comparison.case.name,
        "",
        tuple(comparison.predictions),
        ev,
        tuple(scales),
        source is not None,
        size_px,
    )
    return strip, image


def _display(linear: np.ndarray, ev: float) -> np.ndarray:
    """Encode linear light of any shape as display values 0..1."""
    return linear_to_srgb(np.clip(linear * np.float32(2.0**ev), 0, 1))


def _error(ours: np.ndarray, true: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The channels' mean absolute difference of display values [H, W, 3], in false colours [H, W, 3]."""
    apart = np.abs(ours - true).mean(-1) * (mask > 0) / ERROR_HIGHEST
    stops = np.linspace(0, 1, len(ERROR_COLOURS))
    return np.stack([np.interp(apart, stops, channel) for channel in np.array(ERROR_COLOURS).T / 255], -1)


def _fitted(display: np.ndarray, size_px: tuple[int, int]) -> Image.Image:
    """An image [h, w, 3] or [h, w] in 0..1, resized to fit into a tile and centred on it."""
    data = (np.clip(np.nan_to_num(display), 0, 1) * 255 + 0.5).astype(np.uint8)
    image, grey = Image.fromarray(data).convert("RGB"), (round(255 * _OUTSIDE),) * 3
    method = Image.Resampling.LANCZOS if image.width > size_px[0] else Image.Resampling.BICUBIC
    return ImageOps.pad(image, size_px, method, grey)
