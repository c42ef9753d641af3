"""Figures of finished items as files, and the report of a run: a CSV, and a page without scripts."""

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
from pydantic import BeforeValidator

from facerf_cli.errors import InputError
from facerf_cli.evaluation.measure import METRICS, Row
from facerf_cli.evaluation.strips import ERROR_COLOURS, ERROR_HIGHEST, Strip
from facerf_cli.evaluation.summary import ALL, Cell, Group, Summary, cell_words, published_for
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import read_document
from facerf_cli.files.sheets import filled_page
from facerf_cli.run.logs import json_line

Format = Literal["facerf-evaluation-3"]
FORMAT: Format = "facerf-evaluation-3"

WORST, FEW = 40, 4  # cases on the page; `few` are typical ones, and as many the best
# Okabe and Ito's colours (2008), which colour-blind readers can tell apart; for methods in their order.
METHOD_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#3a9fd8", "#8a8a8a")
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)  # of the plots: line, box, bar, box, line


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


def _axis(groups: Sequence[Group], metric: str) -> tuple[float, float]:
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
