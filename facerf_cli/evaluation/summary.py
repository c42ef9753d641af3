"""The tables of a run from its rows: each method over all images and by every fact, and against the first."""

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
_MOST_VALUES = 12  # of a fact that breaks tables down, where the protocol names none
_PIPED_WIDTH = 100  # columns of text where standard output is no terminal


@dataclass(frozen=True)
class Layout:
    """The contents of a protocol's tables.

    `title` is the heading. The first of `metrics` decides which images are the best and the worst. `by` names
    the facts, as text, that break the tables down; empty: all of few values. `notes` are
    printed below.
    """

    title: str
    metrics: tuple[str, ...] = ("si_mse",)
    by: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Cell:
    """One metric of one method over a group of images, and against the first method.

    Values that are not finite are counted in `left_out`. `difference` is this method's value less the first
    one's, on the images that both have, and `won` the share of these on which this method is better; a tie
    counts half. The first method has none, nor one without such images.
    """

    interval: Interval
    left_out: int
    difference: Interval | None = None
    won: float = math.nan


@dataclass(frozen=True)
class CaseGroup:
    """The images whose `fact` is `value`; all images if the fact is ''."""

    fact: str
    value: str
    cells: Mapping[str, Mapping[str, Cell]]  # by metric, then by method


@dataclass(frozen=True)
class Summary:
    """All tables of a run: of each metric the rows of every group of images."""

    layout: Layout
    methods: tuple[str, ...]
    metrics: tuple[str, ...]  # the layout's first, then all others that were measured
    groups: tuple[CaseGroup, ...]  # the first is of all images
    images: int
    persons: int

    @property
    def size(self) -> str:
        """Its images and people in words; of unknown people the images alone."""
        images = counted(self.images, "image")
        return f"{images} of {counted(self.persons, 'person')}" if self.persons else images

    @property
    def shown(self) -> list[str]:
        """The metrics that have a table."""
        return [metric for metric in self.layout.metrics if metric in self.metrics]

    @property
    def columns(self) -> list[str]:
        """The headings of the tables; those of differences only where there are several methods."""
        names = ["images", "method", "n", "mean", "sd", "median", "95 % interval", "vs first", "won"]
        return names if len(self.methods) > 1 else names[:7]

    def table(self, metric: str) -> list[list[str]]:
        """The rows of a metric: the methods of each group; only the first metric is broken down by facts."""
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
    """The figures of a cell for JSON."""
    entry = cell.interval.as_dict() | {"left_out": cell.left_out}
    if cell.difference is None:
        return entry
    return entry | {"less_the_first": cell.difference.as_dict() | {"won": cell.won}}


def summarise(layout: Layout, rows: Sequence[Row]) -> Summary:
    """Sum up a run's rows, at least one. Only the layout's metrics are broken down by facts.

    Raises ValueError where an image and a method have two rows.
    """
    keys = {(row.case, row.method) for row in rows}
    if len(keys) < len(rows):
        raise ValueError(f"{len(rows) - len(keys)} images were measured twice")
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
        if not layout.by and len(by_value) > _MOST_VALUES:  # such as the files of maps
            continue
        for value in sorted(by_value, key=natural):
            groups.append(CaseGroup(fact, value, _cells(by_value[value], methods, narrow)))
    cases, persons = {row.case for row in rows}, {row.person for row in rows}
    notes = layout.notes
    if dark := {row.case for row in rows if math.isnan(row.values.get("si_mse", 0.0))}:
        notes += (
            f"Of {counted(len(dark), 'image')} the truth is near black (root mean square below "
            f"{NEAR_BLACK}): left out of Si-MSE.",
        )
    layout = replace(layout, notes=notes)
    return Summary(layout, methods, metrics, tuple(groups), len(cases), 0 if "" in persons else len(persons))


def natural(text: str) -> list[tuple[int, float, str]]:
    """A sort key that puts '5°' before '10°'."""
    parts = re.split(r"(\d+(?:\.\d+)?)", text)
    return [(0, float(part), "") if index % 2 else (1, 0.0, part) for index, part in enumerate(parts)]


def _cells(rows: Sequence[Row], methods: Sequence[str], metrics: Sequence[str]) -> dict[str, dict[str, Cell]]:
    """The cells that have finite values, by metric and method."""
    found: dict[str, dict[str, Cell]] = {metric: {} for metric in metrics}
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
                cell = replace(
                    cell, difference=_interval(both), won=_won(metric, [apart for _, apart in both])
                )
            found[metric][method] = cell
    return found


def _interval(values: Sequence[tuple[str, float]]) -> Interval | None:
    """The mean of (person, value) pairs and its interval, NaN where somebody is not known."""
    known = all(person for person, _ in values)
    return mean_interval(values if known else [("", value) for _, value in values])


def _won(metric: str, differences: Sequence[float]) -> float:
    better = -1.0 if METRICS[metric].lower_is_better else 1.0
    won = [0.5 if apart == 0 else float(better * apart > 0) for apart in differences]
    return sum(won) / len(won) if won else math.nan


def print_tables(summary: Summary) -> None:
    """Print a table for each of the layout's metrics to standard output; plain text if it is piped."""
    terminal = sys.stdout.isatty()
    console = Console(file=sys.stdout, width=None if terminal else _PIPED_WIDTH, highlight=False)
    plain = not terminal or console.width <= _PIPED_WIDTH  # rules take columns that a narrow terminal lacks
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
    """Mean, sd, median and interval of a cell, its difference to the first method, and the share won.

    The difference is followed by its interval. Both have as many digits after the point as show two of their
    uncertainty, and at most `digits`. The last two are empty for the first method.
    """
    interval, apart = cell.interval, cell.difference
    most = _decimals(interval, digits)
    words = [f"{value:.{most}f}" for value in (interval.mean, interval.sd, interval.median)]
    known = not math.isnan(interval.low)  # NaN with one person, or where nobody is named
    words.append(f"{interval.low:.{most}f} to {interval.high:.{most}f}" if known else "one person?")
    if apart is None:
        return [*words, "", ""]
    most = _decimals(apart, digits)
    between = f" ({apart.low:+.{most}f} to {apart.high:+.{most}f})" if known else ""
    return [*words, f"{apart.mean:+.{most}f}{between}", f"{100 * cell.won:.0f} %"]


def _decimals(interval: Interval, most: int) -> int:
    """Digits after the point that show two significant ones of the interval's half width; at most `most`."""
    half = (interval.high - interval.low) / 2
    return min(most, max(0, 1 - math.floor(math.log10(half)))) if half > 0 else most
