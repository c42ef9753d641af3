"""The report of an evaluation: one HTML file that loads nothing, without scripts; worst cases first."""

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from facerf_cli.evaluation.case_files import KeptStrip
from facerf_cli.evaluation.measure import Row
from facerf_cli.evaluation.report_tables import axis_of, colour_of, method_cells, spread_of
from facerf_cli.evaluation.strips import ERROR_COLOURS, ERROR_HIGHEST
from facerf_cli.evaluation.summary import ALL, Summary, metric_named, published_for
from facerf_cli.files.pages import filled_page

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
