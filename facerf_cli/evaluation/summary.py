"""Tables of a run: statistics of each method, over all images and per fact, and differences to the first."""

import math
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from facerf_cli.evaluation.measure import METRICS, NEAR_BLACK, Row
from facerf_cli.evaluation.metrics import Interval, mean_interval
from facerf_cli.run.logs import counted

ALL = "all images"
_MOST_VALUES = 12  # a fact with more values breaks down no table, unless the protocol names it
_PIPED_WIDTH = 100  # columns of text if standard output is not a terminal


@dataclass(frozen=True)
class Layout:
    """Contents of a protocol's tables."""

    title: str
    metrics: tuple[str, ...] = ("si_mse",)  # the first one ranks the images in the report
    by: tuple[str, ...] = ()  # text facts that break down the tables; (): all facts with few values
    notes: tuple[str, ...] = ()  # printed below the tables


@dataclass(frozen=True)
class Cell:
    """Statistics of one metric of one method over a group of images.

    `difference` is this method's value minus the first method's, on the images that both have; `won` is the
    fraction of these images where this method is better, counting ties half. The first method has neither.
    """

    interval: Interval
    left_out: int  # number of non-finite values, which the statistics exclude
    difference: Interval | None = None
    won: float = math.nan


@dataclass(frozen=True)
class CaseGroup:
    """Statistics of the images whose `fact` is `value`; of all images if the fact is ''."""

    fact: str
    value: str
    cells: Mapping[str, Mapping[str, Cell]]  # by metric, then by method


@dataclass(frozen=True)
class Summary:
    """Tables of a run."""

    layout: Layout
    methods: tuple[str, ...]
    metrics: tuple[str, ...]  # the layout's metrics, then all others that were measured
    groups: tuple[CaseGroup, ...]  # all images, then each value of each fact
    images: int
    persons: int  # 0 if they are unknown

    @property
    def size(self) -> str:
        images = counted(self.images, "image")
        return f"{images} of {counted(self.persons, 'person')}" if self.persons else images

    @property
    def shown(self) -> list[str]:
        """Metrics that have a table."""
        return [metric for metric in self.layout.metrics if metric in self.metrics]

    @property
    def columns(self) -> list[str]:
        """Headings of the tables; a single method has no differences."""
        names = ["images", "method", "n", "mean", "sd", "median", "95 % interval", "vs first", "won"]
        return names if len(self.methods) > 1 else names[:7]

    def table(self, metric: str) -> list[list[str]]:
        """Return the rows of a metric, by group and method; only the first metric is broken down by facts."""
        rows = []
        for group in self.groups if metric == self.shown[0] else self.groups[:1]:
            title = f"{group.fact}: {group.value}" if group.fact else ALL
            for method, cell in group.cells.get(metric, {}).items():
                words = cell_words(cell, METRICS[metric].digits)
                rows.append([title, method, str(cell.interval.images), *words][: len(self.columns)])
                title = ""
        return rows

    def as_dict(self) -> dict[str, Any]:
        """Return all tables for JSON."""
        return {
            "title": self.layout.title,
            "notes": self.layout.notes,
            "pictures": self.images,
            "persons": self.persons,
            "methods": self.methods,
            "metrics": self.metrics,
            "groups": [
                {
                    "fact": group.fact or None,
                    "value": group.value or None,
                    "metrics": {
                        metric: {method: _entry(cell) for method, cell in by_method.items()}
                        for metric, by_method in group.cells.items()
                    },
                }
                for group in self.groups
            ],
        }


def _entry(cell: Cell) -> dict[str, Any]:
    entry = cell.interval.as_dict() | {"left_out": cell.left_out}
    if cell.difference is None:
        return entry
    return entry | {"less_the_first": cell.difference.as_dict() | {"won": cell.won}}


def summarise(layout: Layout, rows: Sequence[Row]) -> Summary:
    """Compute the statistics of at least one row. Facts break down only the layout's metrics."""
    assert len({(row.case, row.method) for row in rows}) == len(rows), "an image was measured twice"
    measured = dict.fromkeys(name for row in rows for name in row.values)
    narrow = tuple(name for name in layout.metrics if name in measured)
    metrics = tuple(dict.fromkeys([*narrow, *measured]))
    methods = tuple(dict.fromkeys(row.method for row in rows))
    groups = [CaseGroup("", "", _cells(rows, methods, metrics))]
    text = dict.fromkeys(name for row in rows for name, value in row.facts.items() if isinstance(value, str))
    for fact in layout.by or text:
        by_value: dict[str, list[Row]] = {}
        for row in rows:
            if fact in row.facts:
                by_value.setdefault(str(row.facts[fact]), []).append(row)
        if not layout.by and len(by_value) > _MOST_VALUES:  # such as the names of maps
            continue
        for value in sorted(by_value, key=natural):
            groups.append(CaseGroup(fact, value, _cells(by_value[value], methods, narrow)))
    cases, persons = {row.case for row in rows}, {row.person for row in rows}
    notes = layout.notes
    if dark := {row.case for row in rows if math.isnan(row.values.get("si_mse", 0.0))}:
        notes += (
            f"Si-MSE excludes {counted(len(dark), 'image')} with a near-black ground truth (root mean square "
            f"below {NEAR_BLACK}).",
        )
    layout = replace(layout, notes=notes)
    return Summary(layout, methods, metrics, tuple(groups), len(cases), 0 if "" in persons else len(persons))


def natural(text: str) -> list[tuple[int, float, str]]:
    """Return a sort key that puts '5°' before '10°'."""
    parts = re.split(r"(\d+(?:\.\d+)?)", text)
    return [(0, float(part), "") if index % 2 else (1, 0.0, part) for index, part in enumerate(parts)]


def _cells(rows: Sequence[Row], methods: Sequence[str], metrics: Sequence[str]) -> dict[str, dict[str, Cell]]:
    """Return the cells with at least one finite value, by metric and method."""
    cells: dict[str, dict[str, Cell]] = {metric: {} for metric in metrics}
    for metric in metrics:
        measured = [row for row in rows if metric in row.values]
        finite = [row for row in measured if math.isfinite(row.values[metric])]
        firsts = {row.case: row.values[metric] for row in finite if row.method == methods[0]}
        for method in methods:
            ours = [row for row in finite if row.method == method]
            interval = _interval([(row.person, row.values[metric]) for row in ours])
            if interval is None:
                continue
            cell = Cell(interval, sum(row.method == method for row in measured) - len(ours))
            if method != methods[0]:
                both = [
                    (row.person, row.values[metric] - firsts[row.case]) for row in ours if row.case in firsts
                ]
                sign = -1.0 if METRICS[metric].lower_is_better else 1.0
                won = [0.5 if change == 0 else float(sign * change > 0) for _, change in both]
                cell = replace(cell, difference=_interval(both), won=sum(won) / len(won) if won else math.nan)
            cells[metric][method] = cell
    return cells


def _interval(values: Sequence[tuple[str, float]]) -> Interval | None:
    """Return the mean of (person, value) pairs with its interval, which is NaN if a person is unknown."""
    known = all(person for person, _ in values)
    return mean_interval(values if known else [("", value) for _, value in values])


def print_tables(summary: Summary) -> None:
    """Print one table per metric of the layout to standard output, as plain text if it is piped."""
    terminal = sys.stdout.isatty()
    console = Console(file=sys.stdout, width=None if terminal else _PIPED_WIDTH, highlight=False)
    plain = not terminal or console.width <= _PIPED_WIDTH  # a narrow terminal has no room for rules
    console.print(Text(f"{summary.layout.title}: {summary.size}", style="bold"))
    for metric in summary.shown:
        table = Table(
            title=Text(f"\n{METRICS[metric].title} ({METRICS[metric].better} is better)"),
            title_justify="left",
            box=None if plain else box.SIMPLE_HEAD,
            pad_edge=False,
            padding=(0, 1, 0, 0),
            expand=False,
        )
        table.add_column("images", overflow="fold", min_width=10, max_width=26)
        table.add_column("method", overflow="fold", max_width=20)
        for name in summary.columns[2:]:
            table.add_column(name, justify="right", no_wrap=name not in ("95 % interval", "vs first"))
        for row in summary.table(metric):
            table.add_row(*map(Text, row))
        console.print(table)
    for note in summary.layout.notes:
        console.print(Text(note))


def cell_words(cell: Cell, digits: int) -> list[str]:
    """Format a cell: mean, sd, median, interval, difference to the first method with its interval, and `won`.

    Values have two significant digits of their uncertainty, at most `digits` after the point. The last two
    texts are empty for the first method.
    """
    interval, difference = cell.interval, cell.difference
    most = _decimals(interval, digits)
    words = [f"{value:.{most}f}" for value in (interval.mean, interval.sd, interval.median)]
    known = not math.isnan(interval.low)  # NaN for one person or unknown people
    words.append(f"{interval.low:.{most}f} to {interval.high:.{most}f}" if known else "one person?")
    if difference is None:
        return [*words, "", ""]
    most = _decimals(difference, digits)
    between = f" ({difference.low:+.{most}f} to {difference.high:+.{most}f})" if known else ""
    return [*words, f"{difference.mean:+.{most}f}{between}", f"{100 * cell.won:.0f} %"]


def _decimals(interval: Interval, most: int) -> int:
    """Return the digits after the point that show two significant digits of the interval's half width."""
    half = (interval.high - interval.low) / 2
    return min(most, max(0, 1 - math.floor(math.log10(half)))) if half > 0 else most
