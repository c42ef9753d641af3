"""A case as one small picture to look at: what was seen and the truth, and each method over its error."""

from dataclasses import dataclass

import numpy as np
from PIL import Image

from facerf_cli.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.evaluation.cases import Comparison
from facerf_cli.metrics import best_scale

ERROR_HIGHEST = 0.2  # of display values 0..1: where the false colours end
# Dark to bright through violet and orange, in lightness that only rises, so that it also reads in grey.
ERROR_COLOURS = ((8, 6, 20), (87, 22, 110), (187, 55, 84), (249, 142, 9), (252, 250, 176))
_TILE_PX = 192
_GAP_PX = 4
_GAP = 128  # between tiles: neither a light page nor a dark one makes it glare
_PAPER = 0.16  # display value of what is left out of the comparison


@dataclass(frozen=True, eq=False)
class Strip:
    """Tiles [2 h, (1 + methods) w, 3], bytes for display: a column of source over truth, then the methods'.

    A method's column is its picture over its error, at the truth's exposure `ev`; `scales` is what each
    picture was multiplied by before, 1 where no scale was sought. A source has an exposure of its own; where
    there is none, the mask stands in its place.
    """

    pixels: np.ndarray
    methods: tuple[str, ...]
    ev: float
    scales: tuple[float, ...]
    has_source: bool


def strip_of(comparison: Comparison, scaled: bool) -> Strip:
    """The strip of a case; `scaled` shows a prediction at the scale that linear Si-MSE compares it at."""
    truth, mask = comparison.truth, comparison.mask
    ev = auto_exposure_ev(truth, mask)
    tile = _tile_size(truth.shape)
    true = _display(truth, ev)
    seen = mask if comparison.source is None else _seen(comparison.source)
    columns, scales = [_column(_fitted(seen, tile), _fitted(true, tile))], []
    for prediction in comparison.predictions.values():
        scale = best_scale(prediction, truth, mask) if scaled else 1.0
        ours = _display(scale * prediction, ev)
        columns.append(_column(_fitted(_inside(ours, mask), tile), _fitted(_error(ours, true, mask), tile)))
        scales.append(scale)
    methods = tuple(comparison.predictions)
    pixels = np.concatenate(columns, 1)[:-_GAP_PX, :-_GAP_PX]
    return Strip(pixels, methods, ev, tuple(scales), comparison.source is not None)


def _tile_size(shape: tuple[int, ...]) -> tuple[int, int]:
    """Width and height of a tile for pictures [H, W, ...]: the longer side is `_TILE_PX`."""
    longer = max(shape[:2])
    return round(_TILE_PX * shape[1] / longer) or 1, round(_TILE_PX * shape[0] / longer) or 1


def _display(linear: np.ndarray, ev: float) -> np.ndarray:
    """Linear light of any shape as display values 0..1."""
    return linear_to_srgb(np.clip(linear * np.float32(2.0**ev), 0, 1))


def _seen(source: np.ndarray) -> np.ndarray:
    """The source as display values, at its own exposure."""
    return _display(source, auto_exposure_ev(source))


def _inside(display: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A prediction [H, W, 3] where it is compared; what lies outside means nothing."""
    weight = mask[..., None].astype(np.float32)
    return weight * display + (1 - weight) * np.float32(_PAPER)


def _error(ours: np.ndarray, true: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The channels' mean absolute difference of display values [H, W, 3], in false colours [H, W, 3]."""
    apart = np.abs(ours - true).mean(-1) * (mask > 0) / ERROR_HIGHEST
    stops = np.linspace(0, 1, len(ERROR_COLOURS))
    channels = [np.interp(apart, stops, np.array(ERROR_COLOURS)[:, channel] / 255) for channel in range(3)]
    return np.stack(channels, -1)


def _fitted(display: np.ndarray, tile: tuple[int, int]) -> np.ndarray:
    """A picture [h, w, 3] or [h, w] in 0..1, made to fit a tile and centred on it, as bytes."""
    data = (np.clip(np.nan_to_num(display), 0, 1) * 255 + 0.5).astype(np.uint8)
    picture = Image.fromarray(data).convert("RGB")
    ratio = min(tile[0] / picture.width, tile[1] / picture.height)
    size = max(1, round(picture.width * ratio)), max(1, round(picture.height * ratio))
    paper = Image.new("RGB", tile, (round(255 * _PAPER),) * 3)
    resized = picture.resize(size, Image.Resampling.LANCZOS if ratio < 1 else Image.Resampling.BICUBIC)
    paper.paste(resized, ((tile[0] - size[0]) // 2, (tile[1] - size[1]) // 2))
    return np.asarray(paper)


def _column(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Two tiles in a column, each with a gap below and on its right."""
    frame = ((0, _GAP_PX), (0, _GAP_PX), (0, 0))
    return np.concatenate([np.pad(tile, frame, constant_values=_GAP) for tile in (above, below)])
