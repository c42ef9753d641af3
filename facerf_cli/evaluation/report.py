"""Figures of finished items as files, strips of images, and the report of a run: a page without scripts."""

import base64
import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from PIL import Image
from pydantic import BeforeValidator

from facerf_cli.errors import InputError
from facerf_cli.evaluation.measure import Comparison, Row
from facerf_cli.evaluation.summary import ALL, Cell, Group, Summary, cell_words, metric_named, published_for
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import read_document
from facerf_cli.files.sheets import filled_page
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.image.metrics import best_scale
from facerf_cli.run.logs import json_line

Format = Literal["facerf-evaluation-3"]
FORMAT: Format = "facerf-evaluation-3"

# Strips.
ERROR_HIGHEST = 0.2  # of display values 0..1: the end of the false colours
# Dark to bright by violet and orange; the lightness only rises, so that the error also reads in grey.
ERROR_COLOURS = ((8, 6, 20), (87, 22, 110), (187, 55, 84), (249, 142, 9), (252, 250, 176))
_TILE_PX = 192  # the longer side
_GAP_PX = 4  # between tiles
_GAP = 128  # grey of the gap, that glares neither on a light page nor on a dark one
_OUTSIDE = 0.16  # display value of what is not compared
_KEPT_WORST, _KEPT_WORST_OF_OTHERS, _KEPT_BEST, _KEPT_TYPICAL = 8, 2, 2, 2  # of an item
# The page.
WORST, TYPICAL, BEST = 40, 4, 4
# Okabe and Ito's colours (2008), which colour-blind readers can tell apart; for methods in their order.
METHOD_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#3a9fd8", "#8a8a8a")
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)  # of the plots: line, box, bar, box, line


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


def draw_strip(comparison: Comparison, scaled: bool) -> tuple[Strip, np.ndarray]:
    """Draw a case's strip; `scaled` multiplies predictions by the scale that Si-MSE finds.

    The image is [2 h, (1 + methods) w, 3], bytes for display.
    """
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
    size_px = (pixels.shape[1], pixels.shape[0])
    methods = tuple(comparison.predictions)
    return Strip(comparison.case.name, "", methods, ev, tuple(scales), source is not None, size_px), pixels


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


def cases_to_keep(rows: Sequence[Row], metric: str) -> list[str]:
    """Choose the cases of an item whose strips are kept, by name.

    They are the worst of the first method, fewer of each other one, the first one's best, and those in the
    middle.
    """
    chosen: set[str] = set()
    for number, method in enumerate(dict.fromkeys(row.method for row in rows)):
        ranked = _worst_first([row for row in rows if row.method == method], metric)
        chosen.update(ranked[: _KEPT_WORST_OF_OTHERS if number else _KEPT_WORST])
        if number == 0:
            middle = max(len(ranked) - _KEPT_TYPICAL, 0) // 2
            chosen.update(ranked[middle : middle + _KEPT_TYPICAL] + ranked[-_KEPT_BEST:])
    return sorted(chosen)


def _badness(row: Row, metric: str) -> float:
    """A row's figure, larger for a worse image; minus infinity if there is none."""
    value = row.values.get(metric, math.nan)
    sign = 1 if metric_named(metric).lower_is_better else -1
    return sign * value if math.isfinite(value) else -math.inf


def _worst_first(rows: Iterable[Row], metric: str) -> list[str]:
    """Cases of one method's rows whose figure is finite, the worst first; of equals by name."""
    figures = sorted((-_badness(row, metric), row.case) for row in rows)
    return [case for figure, case in figures if math.isfinite(figure)]


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
class CaseImage:
    """A case with its strip and its rows, one a method."""

    strip: Strip
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Chosen:
    """The cases on the page, each once; if they are few, all are in `worst`."""

    worst: tuple[CaseImage, ...]
    typical: tuple[CaseImage, ...]
    best: tuple[CaseImage, ...]

    def all(self) -> tuple[CaseImage, ...]:
        """All cases on the page."""
        return self.worst + self.typical + self.best


def choose(summary: Summary, rows: Sequence[Row], strips: Iterable[Strip], worst: int = WORST) -> Chosen:
    """Choose among the cases whose strips were kept, by the layout's first metric of the first method."""
    metric, first = summary.metrics[0], summary.methods[0]
    of_case: dict[str, list[Row]] = {}
    for row in rows:
        of_case.setdefault(row.case, []).append(row)

    def badness(case: CaseImage) -> float:
        return next((_badness(row, metric) for row in case.rows if row.method == first), -math.inf)

    cases = [CaseImage(strip, tuple(of_case[strip.case])) for strip in strips if strip.case in of_case]
    cases = sorted(cases, key=lambda case: (-badness(case), case.strip.case))
    if len(cases) == summary.images <= worst:
        return Chosen(tuple(cases), (), ())
    rest, best = cases[:-BEST], cases[-BEST:][::-1]
    cell = summary.groups[0].cells[metric].get(first)
    sign = 1 if metric_named(metric).lower_is_better else -1
    median = sign * cell.interval.median if cell else 0.0
    typical = sorted(rest, key=lambda case: abs(badness(case) - median))[:TYPICAL]
    bad = [case for case in rest if case not in typical and badness(case) > median][:worst]
    return Chosen(tuple(bad), tuple(typical), tuple(best))


def _axis(groups: list[Group], metric: str) -> tuple[float, float]:
    """The lowest and highest value of the plots; an error's axis begins at 0 if no value is negative."""
    cells = [cell for group in groups for cell in group.cells.get(metric, {}).values()]
    lows = [float(np.quantile(cell.values, _QUANTILES[0])) for cell in cells]
    highs = [max(float(np.quantile(cell.values, _QUANTILES[-1])), cell.interval.mean) for cell in cells]
    if not cells:
        return 0.0, 1.0
    low, high = min(lows), max(highs)
    low = 0.0 if low >= 0 and metric_named(metric).lower_is_better else low
    return (low, high) if high > low else (low, low + 1)


def _spread(cell: Cell, axis: tuple[float, float]) -> dict[str, str]:
    """Places of a method's values on the axis, in percent: a line, a box and its width, a bar and a dot."""
    low, high = axis

    def place(value: float) -> str:
        return f"{100 * min(max((value - low) / (high - low), 0), 1):.2f}%"

    least, lower, middle, upper, most = (float(v) for v in np.quantile(cell.values, _QUANTILES))
    values = {"least": least, "lower": lower, "middle": middle, "most": most, "mean": cell.interval.mean}
    box = max(100 * (min(upper, high) - max(lower, low)) / (high - low), 0.4)
    return {name: place(value) for name, value in values.items()} | {"box": f"{box:.2f}%"}


def _fact(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def _alt(strip: Strip) -> str:
    """The text in place of a strip's image."""
    first = "The source" if strip.has_source else "The mask"
    return f"{strip.case}. {first} above the truth; then, above their errors: {', '.join(strip.methods)}."


def _figure(values: Mapping[str, float], metric: str) -> str:
    """A figure with its metric's digits; empty where it is missing."""
    if metric not in values:
        return ""
    return f"{values[metric]:.{metric_named(metric).digits}f}" if math.isfinite(values[metric]) else "none"


@dataclass(frozen=True)
class About:
    """The run: its command line, facerf's version, and facts; file and SHA-256 of each network, by title."""

    command: str
    version: str
    networks: Mapping[str, Mapping[str, str]]
    facts: Mapping[str, str]


def page(summary: Summary, about: About, chosen: Chosen, jpegs: Mapping[str, bytes]) -> str:
    """Write the report; `jpegs` are the chosen cases' strips by case. Equal figures give equal bytes."""
    colours = {
        method: METHOD_COLOURS[number % len(METHOD_COLOURS)] for number, method in enumerate(summary.methods)
    }
    return filled_page(
        Path(__file__).with_name("report.html"),
        summary=summary,
        about=about,
        chosen=chosen,
        jpegs={case: base64.b64encode(jpeg).decode("ascii") for case, jpeg in jpegs.items()},
        facts=[fact for fact in summary.layout.by if any(group.fact == fact for group in summary.groups)],
        metrics=[name for name in summary.layout.metrics if name in summary.metrics],
        gradient=", ".join(f"rgb({r} {g} {b})" for r, g, b in ERROR_COLOURS),
        highest=ERROR_HIGHEST,
        everywhere=ALL,
        colours=colours,
        alt=_alt,
        fact_words=_fact,
        figure=_figure,
        metric_named=metric_named,
        axis_of=_axis,
        cell_words=cell_words,
        spread_of=_spread,
        published_for=published_for,
    )
