"""Figures of finished items as files, and the report of a run: a CSV, and a page without scripts.

A strip of a case's images has the source over the truth, then each method's image over its error.
"""

import base64
import csv
import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import cycle
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from PIL import Image, ImageOps
from pydantic import BeforeValidator

from facerf_cli.errors import InputError
from facerf_cli.evaluation.measure import METRICS, Comparison, Row
from facerf_cli.evaluation.summary import ALL, CaseGroup, Cell, Summary, cell_words, published_for
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import read_document
from facerf_cli.files.sheets import filled_page
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.image.metrics import best_scale
from facerf_cli.run.logs import json_line

Format = Literal["facerf-evaluation-3"]
FORMAT: Format = "facerf-evaluation-3"

WORST, FEW = 40, 4  # cases on the page; `few` are typical ones, and as many the best
# Okabe and Ito's colours (2008), which colour-blind readers can tell apart; for methods in their order.
METHOD_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#3a9fd8", "#8a8a8a")
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)  # of the plots: line, box, bar, box, line
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


def _with_nan(row: Any) -> Any:
    """A row whose figures are null where they are NaN."""
    if isinstance(row, dict) and isinstance(values := row.get("values"), dict):
        return row | {"values": {name: math.nan if v is None else v for name, v in values.items()}}
    return row


@dataclass(frozen=True)
class ItemFigures:
    """The document of a finished item: its rows and its strips.

    `pictures` are images kept for other methods. Paths are relative to the evaluation's folder.
    """

    format: Format
    rows: tuple[Annotated[Row, BeforeValidator(_with_nan)], ...]
    strips: tuple[Strip, ...]
    pictures: tuple[str, ...]

    @property
    def files(self) -> tuple[str, ...]:
        """All other files that the item wrote."""
        return (*(strip.file for strip in self.strips), *self.pictures)


def write_figures(path: Path, figures: ItemFigures) -> None:
    """Write an item's figures as one line of JSON, atomically; NaN and infinity become null."""
    with atomic_path(path) as temporary:
        temporary.write_text(json_line(asdict(figures)) + "\n", encoding="utf-8", errors="backslashreplace")


def read_figures(path: Path) -> ItemFigures:
    """Read an item's figures; null becomes NaN. Raises InputError for any other file."""
    advice = "no figures of an evaluation; remove it, or give --overwrite always"
    try:
        return read_document(path, ItemFigures, advice)
    except InputError as error:
        raise InputError(str(error) if advice in str(error) else f"{error}; {advice}") from None


def images_csv(rows: Sequence[Row]) -> str:
    """Format a line for each image and method: its names, facts and figures; a missing figure is empty."""
    facts = dict.fromkeys(name for row in rows for name in row.facts)
    values = dict.fromkeys(name for row in rows for name in row.values)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["case", "person", "method", *facts, *values])
    for row in rows:
        known = {name for name, value in row.values.items() if math.isfinite(value)}
        figures = [f"{row.values[name]:.9g}" if name in known else "" for name in values]
        writer.writerow([row.case, row.person, row.method, *(row.facts.get(n, "") for n in facts), *figures])
    return stream.getvalue()


@dataclass(frozen=True)
class ChosenCases:
    """Names of cases to look at, each once; where there are few, all are in `worst`."""

    worst: list[str]
    typical: list[str]
    best: list[str]

    def all(self) -> list[str]:
        """All of them."""
        return self.worst + self.typical + self.best


def choose_cases(
    rows: Sequence[Row], metric: str, among: Collection[str], worst: int = WORST, few: int = FEW
) -> ChosenCases:
    """Choose cases by a metric of the first method, the worst first; none without a finite figure.

    Args:
        rows: Of all methods and cases.
        metric: The name of the metric.
        among: Names of the cases to choose from.
        worst: Number of cases, of those beyond the median.
        few: Number near the median of all rows, and of the best.
    """
    sign = 1 if METRICS[metric].lower_is_better else -1
    figures = {
        row.case: sign * row.values.get(metric, math.nan) for row in rows if row.method == rows[0].method
    }
    badness = {case: figure for case, figure in figures.items() if math.isfinite(figure)}
    ranked = sorted(badness.keys() & set(among), key=lambda case: (-badness[case], case))
    if len(ranked) == len(badness) <= worst:
        return ChosenCases(ranked, [], [])
    median = float(np.median(list(badness.values())))
    rest, best = ranked[:-few], ranked[-few:][::-1]
    typical = sorted(rest, key=lambda case: abs(badness[case] - median))[:few]
    bad = [case for case in rest if case not in typical and badness[case] > median]
    return ChosenCases(bad[:worst], typical, best)


def page(
    summary: Summary, run: Mapping[str, Any], rows: Sequence[Row], strips: Sequence[Strip], folder: Path
) -> str:
    """Write the report. Equal figures give equal bytes.

    Args:
        summary: The tables.
        run: `facerf`, the version; `command`; `networks`, file and SHA-256 of each by title; and other facts.
        rows: The figures of every image and method.
        strips: Those that were kept, whose files lie below the folder.
        folder: The evaluation's folder.
    """
    chosen = choose_cases(rows, summary.metrics[0], [strip.case for strip in strips])
    strip_of = {strip.case: strip for strip in strips}
    rows_of: dict[str, list[Row]] = {case: [] for case in chosen.all()}
    for row in rows:
        if row.case in rows_of:
            rows_of[row.case].append(row)
    worst = "All cases, the worst first" if len(chosen.worst) == summary.images else "Worst cases"
    sections = {"Typical cases": chosen.typical, "Best cases": chosen.best}
    return filled_page(
        Path(__file__).with_name("report.html"),
        summary=summary,
        run=run,
        sections={worst: chosen.worst} | {title: cases for title, cases in sections.items() if cases},
        strip_of=strip_of,
        rows_of=rows_of,
        jpegs={
            case: base64.b64encode((folder / strip_of[case].file).read_bytes()).decode() for case in rows_of
        },
        facts=list(dict.fromkeys(group.fact for group in summary.groups if group.fact)),
        metrics=[name for name in summary.layout.metrics if name in summary.metrics],
        colours=dict(zip(summary.methods, cycle(METHOD_COLOURS))),
        gradient=", ".join(f"rgb({r} {g} {b})" for r, g, b in ERROR_COLOURS),
        highest=ERROR_HIGHEST,
        everywhere=ALL,
        figure=_figure,
        metric_named=METRICS.__getitem__,
        axis_of=_axis,
        cell_words=cell_words,
        spread_of=_spread,
        published_for=published_for,
    )


def _axis(groups: Sequence[CaseGroup], metric: str) -> tuple[float, float]:
    """The lowest and highest value of the plots; an error's axis begins at 0 if no value is negative."""
    cells = [cell for group in groups for cell in group.cells.get(metric, {}).values()]
    ends = [end for cell in cells for end in (*np.quantile(cell.values, _QUANTILES), cell.interval.mean)]
    low, high = float(min(ends, default=0)), float(max(ends, default=1))
    low = 0.0 if low >= 0 and METRICS[metric].lower_is_better else low
    return (low, high) if high > low else (low, low + 1)


def _spread(cell: Cell, axis: tuple[float, float]) -> dict[str, str]:
    """Places of a method's values on the axis, in percent: a line, a box and its width, a bar and a dot."""
    low, high = axis
    at = 100 * (np.array([*np.quantile(cell.values, _QUANTILES), cell.interval.mean]) - low) / (high - low)
    names = ("least", "lower", "middle", "upper", "most", "mean")
    width = max(at[3] - at[1], 0.4)
    return {name: f"{place:.2f}%" for name, place in zip(names, at, strict=True)} | {"box": f"{width:.2f}%"}


def _figure(values: Mapping[str, float], metric: str) -> str:
    """A figure with its metric's digits; empty where it is missing."""
    if metric not in values:
        return ""
    return f"{values[metric]:.{METRICS[metric].digits}f}" if math.isfinite(values[metric]) else "none"


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
