"""Figures of finished items as files, and the report of a run: a page without scripts, worst cases first."""

import base64
import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, ConfigDict

from facerf_cli.errors import InputError
from facerf_cli.evaluation.measure import Row
from facerf_cli.evaluation.strips import ERROR_COLOURS, ERROR_HIGHEST
from facerf_cli.evaluation.summary import ALL, Cell, Group, Summary, metric_named, published_for
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import Document, read_document
from facerf_cli.files.sheets import filled_page
from facerf_cli.run.logs import json_line

Format = Literal["facerf-evaluation-3"]
FORMAT: Format = "facerf-evaluation-3"


@dataclass(frozen=True)
class KeptStrip:
    """A strip (`strips.Strip`) as a JPEG; `file` is relative to the evaluation's folder."""

    case: str
    file: str
    methods: tuple[str, ...]
    ev: float
    scales: tuple[float, ...]
    has_source: bool
    size_px: tuple[int, int]  # width, height


@dataclass(frozen=True)
class ItemFigures:
    """The figures of a finished item: its rows and its strips.

    `pictures` are images kept for other methods. Paths are relative to the evaluation's folder.
    """

    rows: tuple[Row, ...]
    strips: tuple[KeptStrip, ...]
    pictures: tuple[str, ...]

    @property
    def files(self) -> tuple[str, ...]:
        """All other files that the item wrote."""
        return (*(strip.file for strip in self.strips), *self.pictures)


def write_figures(path: Path, figures: ItemFigures) -> None:
    """Write an item's figures as one line of JSON, atomically; NaN and infinity become null."""
    content = {"format": FORMAT, **asdict(figures)}
    with atomic_path(path) as temporary:
        temporary.write_text(json_line(content) + "\n", encoding="utf-8", errors="backslashreplace")


def _with_nan(row: Any) -> Any:
    """A row whose figures are null where they are NaN."""
    if isinstance(row, dict) and isinstance(values := row.get("values"), dict):
        return row | {"values": {name: math.nan if v is None else v for name, v in values.items()}}
    return row


class _FiguresDocument(Document):
    model_config = ConfigDict(strict=False)  # lists become tuples

    format: Format
    rows: tuple[Annotated[Row, BeforeValidator(_with_nan)], ...]
    strips: tuple[KeptStrip, ...]
    pictures: tuple[str, ...]


def read_figures(path: Path) -> ItemFigures:
    """Read an item's figures; null becomes NaN. Raises InputError for any other file."""
    advice = "no figures of an evaluation; remove it, or give --overwrite always"
    try:
        content = read_document(path, _FiguresDocument, advice)
    except InputError as error:
        raise InputError(str(error) if advice in str(error) else f"{error}; {advice}") from None
    return ItemFigures(content.rows, content.strips, content.pictures)


def images_csv(rows: Sequence[Row]) -> str:
    """Format a line for each image and method: its names, facts and figures; a missing figure is empty."""
    facts = dict.fromkeys(name for row in rows for name in row.facts)
    values = dict.fromkeys(name for row in rows for name in row.values)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["case", "person", "method", *facts, *values])
    for row in rows:
        figures = [f"{row.values[name]:.9g}" if name in row.values else "" for name in values]
        writer.writerow([row.case, row.person, row.method, *(row.facts.get(n, "") for n in facts), *figures])
    return stream.getvalue()


# Okabe and Ito's colours (2008), which colour-blind readers can tell apart; for methods in their order.
METHOD_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#3a9fd8", "#8a8a8a")
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)  # of the plots: line, box, bar, box, line


def colour_of(summary: Summary, method: str) -> str:
    """A method's colour, the same on the whole page."""
    return METHOD_COLOURS[summary.methods.index(method) % len(METHOD_COLOURS)]


def axis_of(groups: list[Group], metric: str) -> tuple[float, float]:
    """The lowest and highest value of the plots; an error's axis begins at 0 if no value is negative."""
    cells = [cell for group in groups for cell in group.cells.get(metric, {}).values()]
    lows = [float(np.quantile(cell.values, _QUANTILES[0])) for cell in cells]
    highs = [max(float(np.quantile(cell.values, _QUANTILES[-1])), cell.interval.mean) for cell in cells]
    if not cells:
        return 0.0, 1.0
    low, high = min(lows), max(highs)
    low = 0.0 if low >= 0 and metric_named(metric).lower_is_better else low
    return (low, high) if high > low else (low, low + 1)


def method_cells(cell: Cell, digits: int, several: bool) -> list[str]:
    """The cells of a method's line after its plot; with `several` methods, those of the difference, too."""
    interval, paired = cell.interval, cell.paired
    known = not math.isnan(interval.low)  # NaN with one person
    between = f"{interval.low:.{digits}f} to {interval.high:.{digits}f}" if known else "one person: unknown"
    entries = [f"{value:.{digits}f}" for value in (interval.mean, interval.sd, interval.median)] + [between]
    if several and paired is None:
        entries += ["", ""]
    elif paired is not None:
        apart = paired.difference
        interval_words = f" ({apart.low:+.{digits}f} to {apart.high:+.{digits}f})" if known else ""
        entries += [f"{apart.mean:+.{digits}f}{interval_words}", f"{100 * paired.won:.0f} %"]
    return entries


@dataclass(frozen=True)
class Spread:
    """A plot of values: places along the axis, and the width of its box, in percent."""

    least: str
    lower: str
    middle: str
    most: str
    mean: str
    box: str


def spread_of(cell: Cell, axis: tuple[float, float]) -> Spread:
    """Place a method's values on the axis: a line from `least` to `most`, a box, a bar and a dot."""
    low, high = axis

    def place(value: float) -> str:
        return f"{100 * min(max((value - low) / (high - low), 0), 1):.2f}%"

    least, lower, middle, upper, most = (float(v) for v in np.quantile(cell.values, _QUANTILES))
    box = max(100 * (min(upper, high) - max(lower, low)) / (high - low), 0.4)
    return Spread(
        place(least), place(lower), place(middle), place(most), place(cell.interval.mean), f"{box:.2f}%"
    )


WORST, TYPICAL, BEST = 40, 4, 4  # strips on the page


@dataclass(frozen=True)
class CaseImage:
    """A case with its strip and its rows, one a method."""

    strip: KeptStrip
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


def choose(summary: Summary, rows: Sequence[Row], strips: Iterable[KeptStrip], worst: int = WORST) -> Chosen:
    """Choose among the cases whose strips were kept, by the layout's first metric of the first method."""
    metric, first = summary.metrics[0], summary.methods[0]
    sign = 1 if metric_named(metric).lower_is_better else -1
    of_case: dict[str, list[Row]] = {}
    for row in rows:
        of_case.setdefault(row.case, []).append(row)

    def badness(case: CaseImage) -> float:
        value = next((row.values.get(metric, math.nan) for row in case.rows if row.method == first), math.nan)
        return sign * value if math.isfinite(value) else -math.inf

    cases = [CaseImage(strip, tuple(of_case[strip.case])) for strip in strips if strip.case in of_case]
    cases = sorted(cases, key=lambda case: (-badness(case), case.strip.case))
    if len(cases) == summary.images <= worst:
        return Chosen(tuple(cases), (), ())
    rest, best = cases[:-BEST], cases[-BEST:][::-1]
    cell = summary.groups[0].cells[metric].get(first)
    median = sign * cell.interval.median if cell else 0.0
    typical = sorted(rest, key=lambda case: abs(badness(case) - median))[:TYPICAL]
    shown = [case for case in rest if case not in typical and badness(case) > median][:worst]
    return Chosen(tuple(shown), tuple(typical), tuple(best))


def _fact(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def _alt(strip: KeptStrip) -> str:
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
    """The run: its command line, facerf's version, and facts such as the checkpoints' digests."""

    command: str
    version: str
    facts: Mapping[str, str]


def page(summary: Summary, about: About, chosen: Chosen, jpegs: Mapping[str, bytes]) -> str:
    """Write the report; `jpegs` are the chosen cases' strips by case. Equal figures give equal bytes."""
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
        alt=_alt,
        fact_words=_fact,
        figure=_figure,
        metric_named=metric_named,
        colour_of=colour_of,
        axis_of=axis_of,
        method_cells=method_cells,
        spread_of=spread_of,
        published_for=published_for,
    )
