"""A case as a small image: source over truth, then each method over its error; and the choice of cases."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from PIL import Image

from facerf_cli.evaluation.measure import Comparison, Row
from facerf_cli.evaluation.summary import metric_named
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.image.metrics import best_scale

ERROR_HIGHEST = 0.2  # of display values 0..1: the end of the false colours
# Dark to bright by violet and orange; the lightness only rises, so that the error also reads in grey.
ERROR_COLOURS = ((8, 6, 20), (87, 22, 110), (187, 55, 84), (249, 142, 9), (252, 250, 176))
_TILE_PX = 192  # the longer side
_GAP_PX = 4  # between tiles
_GAP = 128  # grey of the gap, that glares neither on a light page nor on a dark one
_OUTSIDE = 0.16  # display value of what is not compared

# How many strips of an item are kept.
_WORST, _WORST_OF_OTHERS, _BEST, _TYPICAL = 8, 2, 2, 2
_SAMPLE = 16  # cases from which the most typical ones are chosen


@dataclass(frozen=True, eq=False)
class Strip:
    """Tiles in two rows [2 h, (1 + methods) w, 3], bytes for display: source over truth, then the methods'.

    A method's column is its image over its error, at the truth's exposure `ev`; `scales` are the factors by
    which images were multiplied before, 1 if no scale was sought. A source has its own exposure; without a
    source, the mask is shown.
    """

    pixels: np.ndarray
    methods: tuple[str, ...]
    ev: float
    scales: tuple[float, ...]
    has_source: bool


def strip_of(comparison: Comparison, scaled: bool) -> Strip:
    """Draw a case's strip; `scaled` multiplies predictions by the scale that Si-MSE finds."""
    truth, mask = comparison.truth, comparison.mask
    ev = auto_exposure_ev(truth, mask)
    tile = _tile_size(truth.shape)
    true = _display(truth, ev)
    source = comparison.source
    given = mask if source is None else _display(source, auto_exposure_ev(source))
    columns, scales = [_column(_fitted(given, tile), _fitted(true, tile))], []
    for prediction in comparison.predictions.values():
        scale = best_scale(prediction, truth, mask) if scaled else 1.0
        ours = _display(scale * prediction, ev)
        columns.append(_column(_fitted(_inside(ours, mask), tile), _fitted(_error(ours, true, mask), tile)))
        scales.append(scale)
    pixels = np.concatenate(columns, 1)[:-_GAP_PX, :-_GAP_PX]
    return Strip(pixels, tuple(comparison.predictions), ev, tuple(scales), source is not None)


def _tile_size(shape: tuple[int, ...]) -> tuple[int, int]:
    """Width and height of a tile for images [H, W, ...]."""
    longer = max(shape[:2])
    return round(_TILE_PX * shape[1] / longer) or 1, round(_TILE_PX * shape[0] / longer) or 1


def _display(linear: np.ndarray, ev: float) -> np.ndarray:
    """Encode linear light of any shape as display values 0..1."""
    return linear_to_srgb(np.clip(linear * np.float32(2.0**ev), 0, 1))


def _inside(display: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A prediction [H, W, 3] where it is compared, grey elsewhere."""
    weight = mask[..., None].astype(np.float32)
    return weight * display + (1 - weight) * np.float32(_OUTSIDE)


def _error(ours: np.ndarray, true: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The channels' mean absolute difference of display values [H, W, 3], in false colours [H, W, 3]."""
    apart = np.abs(ours - true).mean(-1) * (mask > 0) / ERROR_HIGHEST
    stops = np.linspace(0, 1, len(ERROR_COLOURS))
    channels = [np.interp(apart, stops, np.array(ERROR_COLOURS)[:, channel] / 255) for channel in range(3)]
    return np.stack(channels, -1)


def _fitted(display: np.ndarray, tile: tuple[int, int]) -> np.ndarray:
    """An image [h, w, 3] or [h, w] in 0..1, resized to fit into a tile and centred on it, as bytes."""
    data = (np.clip(np.nan_to_num(display), 0, 1) * 255 + 0.5).astype(np.uint8)
    image = Image.fromarray(data).convert("RGB")
    ratio = min(tile[0] / image.width, tile[1] / image.height)
    size = max(1, round(image.width * ratio)), max(1, round(image.height * ratio))
    canvas = Image.new("RGB", tile, (round(255 * _OUTSIDE),) * 3)
    resized = image.resize(size, Image.Resampling.LANCZOS if ratio < 1 else Image.Resampling.BICUBIC)
    canvas.paste(resized, ((tile[0] - size[0]) // 2, (tile[1] - size[1]) // 2))
    return np.asarray(canvas)


def _column(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Two tiles in a column, each with a gap below and on its right."""
    frame = ((0, _GAP_PX), (0, _GAP_PX), (0, 0))
    return np.concatenate([np.pad(tile, frame, constant_values=_GAP) for tile in (above, below)])


@dataclass(frozen=True, eq=False)
class _Entry:
    height: float
    case: str
    strip: Strip


@dataclass(eq=False)
class StripKeeper:
    """Choose a limited number of strips among an item's cases, offered one after another.

    By `metric`: the worst of the first method, fewer of each other one, the best, and, from an even sample of
    all, those nearest to the median.
    """

    metric: str
    _worst: dict[str, list[_Entry]] = field(default_factory=dict)  # by method
    _best: list[_Entry] = field(default_factory=list)
    _sample: list[_Entry] = field(default_factory=list)
    _all: list[float] = field(default_factory=list)
    _stride: int = 1

    def offer(self, rows: Sequence[Row], make: Callable[[], Strip]) -> None:
        """Offer a case by its rows, one a method; its strip is drawn only if it is kept."""
        made = cache(make)
        for index, row in enumerate(rows):
            badness = self._badness(row)
            if not math.isfinite(badness):
                continue
            worst = self._worst.setdefault(row.method, [])
            _insert(worst, badness, row.case, made, _WORST if index == 0 else _WORST_OF_OTHERS)
            if index == 0:
                _insert(self._best, -badness, row.case, made, _BEST)
                self._take_sample(badness, row.case, made)

    def kept(self) -> dict[str, Strip]:
        """The strips by case, sorted by the cases' names."""
        entries = [*self._best, *(entry for worst in self._worst.values() for entry in worst)]
        if self._all:
            median = sorted(self._all)[len(self._all) // 2]
            entries += sorted(self._sample, key=lambda entry: abs(entry.height - median))[:_TYPICAL]
        return {entry.case: entry.strip for entry in sorted(entries, key=lambda entry: entry.case)}

    def _take_sample(self, badness: float, case: str, made: Callable[[], Strip]) -> None:
        """Keep every `_stride`-th case, and double the stride when there are too many."""
        if len(self._all) % self._stride == 0:
            self._sample.append(_Entry(badness, case, made()))
        self._all.append(badness)
        if len(self._sample) > _SAMPLE:
            del self._sample[1::2]
            self._stride *= 2

    def _badness(self, row: Row) -> float:
        value = row.values.get(self.metric, math.nan)
        return value if metric_named(self.metric).lower_is_better else -value


def _insert(highest: list[_Entry], height: float, case: str, made: Callable[[], Strip], most: int) -> None:
    """Keep the `most` highest in descending order; of equals the earlier one."""
    if len(highest) < most or height > highest[-1].height:
        highest.append(_Entry(height, case, made()))
        highest.sort(key=lambda entry: -entry.height)
        del highest[most:]
