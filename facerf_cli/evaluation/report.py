"""Files of a run: the results of each item, images.csv, and an HTML report without scripts."""

import base64
import csv
import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image, ImageOps

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

CASES_ON_PAGE = 48
ERROR_HIGHEST = 0.2  # difference of display values 0..1 at the end of the false colours
# From dark violet through orange to bright; the lightness increases, so the error also reads in grey.
ERROR_COLOURS = ((8, 6, 20), (87, 22, 110), (187, 55, 84), (249, 142, 9), (252, 250, 176))
_TILE_PX = 192  # longer side of a tile
_GAP_PX = 4  # between tiles
_GAP_COLOUR = (128,) * 3
_JPEG_QUALITY = 88
_OUTSIDE = 0.16  # display value of pixels that are not compared


@dataclass(frozen=True)
class Strip:
    """Images of a case side by side: source above truth, then each method's image above its error.

    The source has its own exposure; the mask replaces a missing source. All other images have the truth's
    exposure; the methods' images are also multiplied by `scales`, which are 1 if the metric fits no scale.
    """

    case: str
    methods: tuple[str, ...]
    scales: tuple[float, ...]
    has_source: bool
    size_px: tuple[int, int]  # width, height
    jpeg: str  # base64


@dataclass(frozen=True)
class ItemFigures:
    """Contents of the JSON file of a finished item."""

    format: Format
    rows: tuple[Row, ...]
    strips: tuple[Strip, ...]
    pictures: tuple[str, ...]  # paths of the stored images, relative to the output folder


def write_figures(path: Path, figures: ItemFigures) -> None:
    """Write an item's results atomically as one line of JSON; NaN and infinity become null."""
    with atomic_path(path) as temporary:
        temporary.write_text(json_line(asdict(figures)) + "\n", encoding="utf-8", errors="backslashreplace")


def read_figures(path: Path) -> ItemFigures:
    """Read an item's results; null becomes NaN. Raises InputError for any other file."""
    try:
        return read_document(path, ItemFigures, "evaluate again")
    except InputError as error:
        raise InputError(f"{error}; remove the file, or use --overwrite always") from None


def images_csv(rows: Sequence[Row]) -> str:
    """Format one line per image and method: names, facts and metrics; non-finite metrics are empty."""
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


def cases_to_show(
    rows: Sequence[Row], metric: str, among: Collection[str], most: int = CASES_ON_PAGE
) -> list[str]:
    """Rank cases by a metric of the first method, worst first; ignore cases without a finite value.

    If there are more than `most`, return the worst half, and as many spread over the rest, down to the best.
    """
    sign = 1 if METRICS[metric].lower_is_better else -1
    errors = {
        row.case: sign * row.values.get(metric, math.nan)
        for row in rows
        if row.method == rows[0].method and row.case in among
    }
    finite = [case for case, error in errors.items() if math.isfinite(error)]
    ranked = sorted(finite, key=lambda case: (-errors[case], case))
    if len(ranked) <= most:
        return ranked
    worst = most // 2
    ranks = np.linspace(worst, len(ranked) - 1, most - worst).round().astype(int)
    return ranked[:worst] + [ranked[rank] for rank in ranks]


def page(summary: Summary, run: Mapping[str, Any], rows: Sequence[Row], strips: Sequence[Strip]) -> str:
    """Render the HTML report with the tables and strips; equal results give equal bytes.

    `run` contains the version `facerf`, the `command` and other entries for the header.
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
        figure=_format,
        metric_named=METRICS.__getitem__,
    )


def _format(values: Mapping[str, float], metric: str) -> str:
    if metric not in values:
        return ""
    return f"{values[metric]:.{METRICS[metric].digits}f}" if math.isfinite(values[metric]) else "none"


def draw_strip(comparison: Comparison, scaled: bool, marks: Attributes) -> Strip:
    """Draw a case's strip; `scaled` multiplies predictions by the scale of Si-MSE.

    `marks` are the metadata that declare the image synthetic.
    """
    truth, mask, source = comparison.truth, comparison.mask, comparison.source
    ev = auto_exposure_ev(truth, mask)
    true = _encode(truth, ev)
    first = mask if source is None else _encode(source, auto_exposure_ev(source))
    columns, scales = [(first, true)], []
    weight = mask[..., None].astype(np.float32)
    for prediction in comparison.predictions.values():
        scales.append(best_scale(prediction, truth, mask) if scaled else 1.0)
        ours = _encode(scales[-1] * prediction, ev)
        inside = weight * ours + (1 - weight) * np.float32(_OUTSIDE)
        columns.append((inside, _error_colours(ours, true, mask)))
    longer = max(truth.shape[:2])
    height, width = (round(_TILE_PX * side / longer) or 1 for side in truth.shape[:2])
    size_px = len(columns) * (width + _GAP_PX) - _GAP_PX, 2 * (height + _GAP_PX) - _GAP_PX
    image = Image.new("RGB", size_px, _GAP_COLOUR)
    for column, tiles in enumerate(columns):
        for row, tile in enumerate(tiles):
            corner_px = column * (width + _GAP_PX), row * (height + _GAP_PX)
            image.paste(_fitted(tile, (width, height)), corner_px)
    jpeg = io.BytesIO()
    image.save(jpeg, "JPEG", quality=_JPEG_QUALITY, subsampling=0, xmp=xmp_packet(marks))
    return Strip(
        comparison.case.name,
        tuple(comparison.predictions),
        tuple(scales),
        source is not None,
        size_px,
        base64.b64encode(jpeg.getvalue()).decode(),
    )


def _encode(linear: np.ndarray, ev: float) -> np.ndarray:
    return linear_to_srgb(np.clip(linear * np.float32(2.0**ev), 0, 1))


def _error_colours(ours: np.ndarray, true: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Map the mean absolute difference of display values [H, W, 3] to false colours [H, W, 3]."""
    error = np.abs(ours - true).mean(-1) * (mask > 0) / ERROR_HIGHEST
    stops = np.linspace(0, 1, len(ERROR_COLOURS))
    return np.stack([np.interp(error, stops, channel) for channel in np.array(ERROR_COLOURS).T / 255], -1)


def _fitted(display: np.ndarray, size_px: tuple[int, int]) -> Image.Image:
    """Resize an image [h, w, 3] or [h, w] in 0..1 to fit into a tile, centred."""
    data = (np.clip(np.nan_to_num(display), 0, 1) * 255 + 0.5).astype(np.uint8)
    image, grey = Image.fromarray(data).convert("RGB"), (round(255 * _OUTSIDE),) * 3
    method = Image.Resampling.LANCZOS if image.width > size_px[0] else Image.Resampling.BICUBIC
    return ImageOps.pad(image, size_px, method, grey)
