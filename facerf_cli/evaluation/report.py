"""Figures of finished items as files, and the report of a run: a CSV, and a page without scripts.

A strip of a case's images has the source over the truth, then each method's image over its error.
"""

import base64
import csv
import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from PIL import Image, ImageOps
from pydantic import BeforeValidator

from facerf_cli.errors import InputError
from facerf_cli.evaluation.measure import METRICS, Comparison, Row
from facerf_cli.evaluation.metrics import best_scale
from facerf_cli.evaluation.summary import Summary
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import read_document
from facerf_cli.files.image_metadata import Attributes, xmp_packet
from facerf_cli.files.sheets import filled_page
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.run.logs import json_line

Format = Literal["facerf-evaluation-4"]
FORMAT: Format = "facerf-evaluation-4"

SHOWN = 48  # cases on the page
ERROR_HIGHEST = 0.2  # of display values 0..1: the end of the false colours
# Dark to bright by violet and orange; the lightness only rises, so that the error also reads in grey.
ERROR_COLOURS = ((8, 6, 20), (87, 22, 110), (187, 55, 84), (249, 142, 9), (252, 250, 176))
_TILE_PX = 192  # the longer side
_GAP_PX = 4  # between tiles
_GAP = (128,) * 3  # grey of the gap, that glares neither on a light page nor on a dark one
_QUALITY = 88  # of JPEG
_OUTSIDE = 0.16  # display value of what is not compared


@dataclass(frozen=True)
class Strip:
    """The images of a case side by side: source over truth, then the methods' images over their errors.

    Images are at the truth's exposure, the methods' multiplied by `scales`, which are 1 if no scale was
    sought. A source has its own exposure; without a source, the mask is there. `jpeg` is in base64.
    """

    case: str
    methods: tuple[str, ...]
    scales: tuple[float, ...]
    has_source: bool
    size_px: tuple[int, int]  # width, height
    jpeg: str


def _with_nan(row: Any) -> Any:
    """A row whose figures are null where they are NaN."""
    if isinstance(row, dict) and isinstance(values := row.get("values"), dict):
        return row | {"values": {name: math.nan if v is None else v for name, v in values.items()}}
    return row


@dataclass(frozen=True)
class ItemFigures:
    """The document of a finished item: its rows, its strips, and the paths of `pictures` that were kept.

    Paths are relative to the evaluation's folder.
    """

    format: Format
    rows: tuple[Annotated[Row, BeforeValidator(_with_nan)], ...]
    strips: tuple[Strip, ...]
    pictures: tuple[str, ...]


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


def cases_to_show(rows: Sequence[Row], metric: str, among: Collection[str], most: int = SHOWN) -> list[str]:
    """Choose cases by a metric of the first method, the worst first; none without a finite figure.

    Of more than `most` half are the worst, and half are spread over the others, down to the best.
    """
    sign = 1 if METRICS[metric].lower_is_better else -1
    figures = {
        row.case: sign * row.values.get(metric, math.nan) for row in rows if row.method == rows[0].method
    }
    bad = {case: figure for case, figure in figures.items() if case in among and math.isfinite(figure)}
    ranked = sorted(bad, key=lambda case: (-bad[case], case))
    if len(ranked) <= most:
        return ranked
    worst = most // 2
    places = np.linspace(worst, len(ranked) - 1, most - worst).round().astype(int)
    return ranked[:worst] + [ranked[place] for place in places]


def page(summary: Summary, run: Mapping[str, Any], rows: Sequence[Row], strips: Sequence[Strip]) -> str:
    """Write the report: the tables, and the strips that were kept. Equal figures give equal bytes.

    `run` has `facerf`, the version; `command`; other facts.
    """
    strip_of = {strip.case: strip for strip in strips}
    shown = cases_to_show(rows, summary.metrics[0], strip_of)
    rows_of: dict[str, list[Row]] = {case: [] for case in shown}
    for row in rows:
        if row.case in rows_of:
            rows_of[row.case].append(row)
    return filled_page(
        Path(__file__).with_name("report.html"),
        summary=summary,
        run=run,
        shown=shown,
        strip_of=strip_of,
        rows_of=rows_of,
        gradient=", ".join(f"rgb({r} {g} {b})" for r, g, b in ERROR_COLOURS),
        highest=ERROR_HIGHEST,
        figure=_figure,
        metric_named=METRICS.__getitem__,
    )


def _figure(values: Mapping[str, float], metric: str) -> str:
    """A figure with its metric's digits; empty where it is missing."""
    if metric not in values:
        return ""
    return f"{values[metric]:.{METRICS[metric].digits}f}" if math.isfinite(values[metric]) else "none"


def draw_strip(comparison: Comparison, scaled: bool, marks: Attributes) -> Strip:
    """Draw a case's strip; `scaled` multiplies predictions by the scale that Si-MSE finds.

    `marks` are the metadata that say that it is synthetic.
    """
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
    jpeg = io.BytesIO()
    image.save(jpeg, "JPEG", quality=_QUALITY, subsampling=0, xmp=xmp_packet(marks))
    return Strip(
        comparison.case.name,
        tuple(comparison.predictions),
        tuple(scales),
        source is not None,
        size_px,
        base64.b64encode(jpeg.getvalue()).decode(),
    )


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
