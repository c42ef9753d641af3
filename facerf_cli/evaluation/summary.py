"""The tables of a run from its rows: each method over all images and by every fact, and against the first."""

import csv
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from facerf_cli.evaluation.measure import METRICS, NEAR_BLACK, Metric, Row
from facerf_cli.image.metrics import Interval, mean_interval
from facerf_cli.run.logs import counted


@dataclass(frozen=True)
class PublishedFigure:
    """A published figure: mean and standard deviation over images of one metric of one method.

    `group` is the fact and value of our figures that it is shown with ('pose', 'same pose'); None is all
    images. `source` and `data` name where it was published and what it was measured on.
    """

    method: str
    metric: str
    mean: float
    sd: float | None
    group: tuple[str, str] | None
    source: str
    data: str
    digits: int | None  # after the decimal point, as published; None: as ours

    def words(self, digits: int) -> tuple[str, str]:
        """Format mean and standard deviation, with the published digits if they are known."""
        digits = digits if self.digits is None else self.digits
        return f"{self.mean:.{digits}f}", "" if self.sd is None else f"{self.sd:.{digits}f}"


def published(*protocols: str) -> tuple[PublishedFigure, ...]:
    """Read the figures that are shown with those of protocols, from published.csv."""
    with Path(__file__).with_name("published.csv").open(encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["protocol"] in protocols]
    return tuple(
        PublishedFigure(
            row["method"],
            row["metric"],
            float(row["mean"]),
            float(row["sd"]) if row["sd"] else None,
            (row["fact"], row["value"]) if row["fact"] else None,
            row["source"],
            row["data"],
            int(row["digits"]) if row["digits"] else None,
        )
        for row in rows
    )


ALL = "all images"
_DIGITS = 12  # of a digest
_PIPED_WIDTH = 100  # columns of text where standard output is no terminal


@dataclass(frozen=True)
class Layout:
    """The contents of a protocol's tables.

    `name` is the protocol's on the command line, `title` the heading. The first of `metrics` decides which
    images are the best and the worst. `by` names the facts, as text, that break the tables down. `notes` are
    printed below the figures.
    """

    name: str
    title: str
    metrics: tuple[str, ...] = ("si_mse",)
    by: tuple[str, ...] = ()
    published: tuple[PublishedFigure, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Paired:
    """A method against the first one, on the images that both have."""

    difference: Interval  # this method's value less the first one's
    won: float  # share of images on which this method is better; a tie counts half


@dataclass(frozen=True)
class Cell:
    """One metric of one method over a group of images."""

    values: tuple[float, ...]  # sorted
    interval: Interval
    left_out: int  # images whose value is not finite
    paired: Paired | None  # None for the first method, and where no image has both

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        entry: dict[str, Any] = self.interval.as_dict() | {"left_out": self.left_out}
        if self.paired is not None:
            entry["less_the_first"] = self.paired.difference.as_dict() | {"won": self.paired.won}
        return entry


@dataclass(frozen=True)
class Group:
    """The images whose `fact` is `value`; all images if the fact is ''."""

    fact: str
    value: str
    cells: Mapping[str, Mapping[str, Cell]]  # by metric, then by method

    @property
    def title(self) -> str:
        """The group's name in a table."""
        return f"{self.fact}: {self.value}" if self.fact else ALL

    def as_dict(self) -> dict[str, Any]:
        """Return the group's tables for JSON."""
        metrics = {
            metric: {method: cell.as_dict() for method, cell in by_method.items()}
            for metric, by_method in self.cells.items()
        }
        return {"fact": self.fact or None, "value": self.value or None, "metrics": metrics}


@dataclass(frozen=True)
class Summary:
    """All tables of a run."""

    layout: Layout
    methods: tuple[str, ...]
    metrics: tuple[str, ...]  # the layout's first, then all others that were measured
    groups: tuple[Group, ...]  # the first is of all images
    images: int
    persons: int

    @property
    def size(self) -> str:
        """Its images and people in words; of unknown people the images alone."""
        images = counted(self.images, "image")
        return f"{images} of {counted(self.persons, 'person')}" if self.persons else images

    def as_dict(self) -> dict[str, Any]:
        """Return all tables for JSON."""
        return {
            "protocol": self.layout.name,
            "title": self.layout.title,
            "notes": self.layout.notes,
            "pictures": self.images,
            "persons": self.persons,
            "methods": self.methods,
            "metrics": self.metrics,
            "groups": [group.as_dict() for group in self.groups],
            "published": [vars(figure) for figure in self.layout.published],
        }


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
    groups = [Group("", "", _cells(rows, methods, metrics))]
    for fact in layout.by:
        by_value: dict[str, list[Row]] = {}
        for row in rows:
            if fact in row.facts:
                by_value.setdefault(str(row.facts[fact]), []).append(row)
        for value in sorted(by_value, key=natural):
            groups.append(Group(fact, value, _cells(by_value[value], methods, narrow)))
    cases, persons = {row.case for row in rows}, {row.person for row in rows}
    persons = set() if "" in persons else persons
    if dark := {row.case for row in rows if math.isnan(row.values.get("si_mse", 0.0))}:
        note = (
            f"Of {counted(len(dark), 'image')} the truth is near black (root mean square below "
            f"{NEAR_BLACK}): left out of Si-MSE."
        )
        layout = replace(layout, notes=(*layout.notes, note))
    return Summary(layout, methods, metrics, tuple(groups), len(cases), len(persons))


def metric_named(name: str) -> Metric:
    """A metric's title and digits; a metric of a single protocol has its name as title."""
    return METRICS.get(name) or Metric(name.replace("_", " "), digits=4)


def published_for(summary: Summary, group: Group, metric: str) -> list[PublishedFigure]:
    """The published figures of a group and a metric."""
    return [
        figure
        for figure in summary.layout.published
        if figure.metric == metric and (figure.group or ("", "")) == (group.fact, group.value)
    ]


def natural(text: str) -> list[tuple[int, float, str]]:
    """A sort key that puts '5°' before '10°'."""
    parts = re.split(r"(\d+(?:\.\d+)?)", text)
    return [(0, float(part), "") if index % 2 else (1, 0.0, part) for index, part in enumerate(parts)]


def _cells(rows: Sequence[Row], methods: Sequence[str], metrics: Sequence[str]) -> dict[str, dict[str, Cell]]:
    """The cells that have values, by metric and method."""
    found: dict[str, dict[str, Cell]] = {}
    for metric in metrics:
        by_method: dict[str, dict[str, Row]] = {method: {} for method in methods}
        for row in rows:
            if metric in row.values:
                by_method[row.method][row.case] = row
        cells = {method: _cell(metric, own, by_method[methods[0]]) for method, own in by_method.items()}
        found[metric] = {method: cell for method, cell in cells.items() if cell is not None}
    return found


def _cell(metric: str, ours: Mapping[str, Row], firsts: Mapping[str, Row]) -> Cell | None:
    """The figures of one method's rows by case; None if no value is finite."""
    finite = {case: row.values[metric] for case, row in ours.items() if math.isfinite(row.values[metric])}
    interval = _interval([(ours[case].person, value) for case, value in finite.items()])
    if interval is None:
        return None
    paired = None if ours is firsts else _paired(metric, finite, firsts)
    return Cell(tuple(sorted(finite.values())), interval, len(ours) - len(finite), paired)


def _interval(values: Sequence[tuple[str, float]]) -> Interval | None:
    """The mean of (person, value) pairs and its interval, NaN where somebody is not known."""
    known = all(person for person, _ in values)
    return mean_interval(values if known else [("", value) for _, value in values])


def _paired(metric: str, ours: Mapping[str, float], firsts: Mapping[str, Row]) -> Paired | None:
    better = -1.0 if metric_named(metric).lower_is_better else 1.0
    differences = {
        case: (firsts[case].person, value - firsts[case].values[metric])
        for case, value in ours.items()
        if case in firsts and math.isfinite(firsts[case].values[metric])
    }
    interval = _interval(list(differences.values()))
    if interval is None:
        return None
    won = [0.5 if apart == 0 else float(better * apart > 0) for _, apart in differences.values()]
    return Paired(interval, sum(won) / len(won))


def print_tables(summary: Summary, networks: Mapping[str, Mapping[str, str]]) -> None:
    """Print a table for each of the layout's metrics to standard output; plain text if it is piped.

    `networks` has the file and SHA-256 of each network, by title.
    """
    terminal = sys.stdout.isatty()
    console = Console(file=sys.stdout, width=None if terminal else _PIPED_WIDTH, highlight=False)
    plain = not terminal or console.width <= _PIPED_WIDTH  # rules take columns that a narrow terminal lacks
    layout = summary.layout
    console.print(Text(f"{layout.title}: {summary.size}", style="bold"))
    first, *others = [metric for metric in layout.metrics if metric in summary.metrics]
    console.print(_table(summary, first, summary.groups, plain=plain))
    for metric in others:
        console.print(_table(summary, metric, summary.groups[:1], plain=plain))
    measured_on = dict.fromkeys(f"{figure.source}: {figure.data}" for figure in layout.published)
    if measured_on:
        console.print(Text("Published figures. " + ". ".join(measured_on) + "."))
    for note in layout.notes:
        console.print(Text(note))
    if networks:
        named = [f"{title} {one['file']} {one['sha256'][:_DIGITS]}" for title, one in networks.items()]
        console.print(Text(f"Networks, with the first digits of SHA-256: {'; '.join(named)}."))


def _table(summary: Summary, metric: str, groups: Sequence[Group], plain: bool) -> Table:
    how = metric_named(metric)
    better = "less" if how.lower_is_better else "more"
    table = Table(
        title=Text(f"\n{how.title} ({better} is better)"),
        title_justify="left",
        box=None if plain else box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
        expand=False,
    )
    table.add_column("images", overflow="fold", min_width=10, max_width=26)
    table.add_column("method", overflow="fold", max_width=20)
    for name in ("n", "mean", "sd", "median", "95 % interval", "vs first", "won"):
        table.add_column(name, justify="right", no_wrap=name not in ("95 % interval", "vs first"))
    for group in groups:
        for row in _table_rows(summary, group, metric):
            table.add_row(*(Text(entry) for entry in row))
    if len(summary.methods) == 1:  # nothing to compare with
        for _ in range(2):
            table.columns.pop()
    return table


def _table_rows(summary: Summary, group: Group, metric: str) -> Iterator[list[str]]:
    """A group's rows: one for each method, then the published figures."""
    digits = metric_named(metric).digits
    title = group.title
    for method, cell in group.cells.get(metric, {}).items():
        yield [title, method, str(cell.interval.images), *cell_words(cell, digits)]
        title = ""
    for figure in published_for(summary, group, metric):
        yield [f"published, {figure.source}", figure.method, "", *figure.words(digits), *[""] * 4]


def cell_words(cell: Cell, digits: int) -> list[str]:
    """Mean, sd, median and interval of a cell, its difference to the first method, and the share won.

    The difference is followed by its interval. Both have as many digits after the point as show two of their
    uncertainty, and at most `digits`. The last two are empty for the first method.
    """
    interval, paired = cell.interval, cell.paired
    most = _decimals(interval, digits)
    words = [f"{value:.{most}f}" for value in (interval.mean, interval.sd, interval.median)]
    known = not math.isnan(interval.low)  # NaN with one person, or where nobody is named
    words.append(f"{interval.low:.{most}f} to {interval.high:.{most}f}" if known else "one person?")
    if paired is None:
        return [*words, "", ""]
    apart = paired.difference
    most = _decimals(apart, digits)
    difference = f"{apart.mean:+.{most}f}"
    if known:
        difference += f" ({apart.low:+.{most}f} to {apart.high:+.{most}f})"
    return [*words, difference, f"{100 * paired.won:.0f} %"]


def _decimals(interval: Interval, most: int) -> int:
    """Digits after the point that show two significant ones of the interval's half width; at most `most`."""
    half = (interval.high - interval.low) / 2
    return min(most, max(0, 1 - math.floor(math.log10(half)))) if half > 0 else most
