"""From a run's rows to its tables: each method overall and by every fact, and against the first method."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from facerf_cli.evaluation.measure import METRICS, Metric, Row
from facerf_cli.evaluation.paper import Published
from facerf_cli.intervals import Interval, mean_interval

ALL = "all pictures"


@dataclass(frozen=True)
class Layout:
    """What a protocol's tables hold.

    `name` is the protocol's on the command line, `title` what it is called in print. Of `metrics` the first
    decides what is best and worst; `by` are the facts, text, that break the tables down. `notes` are said
    beside the figures.
    """

    name: str
    title: str
    metrics: tuple[str, ...] = ("si_mse",)
    by: tuple[str, ...] = ()
    published: tuple[Published, ...] = ()
    notes: tuple[str, ...] = ()


def shown_as(metric: str) -> Metric:
    """How a metric is shown; one that a protocol made up is shown by its name."""
    return METRICS.get(metric) or Metric(metric.replace("_", " "), digits=4)


@dataclass(frozen=True)
class Paired:
    """A method against the first one, on the pictures that both have."""

    difference: Interval  # this method's value less the first one's
    won: float  # share of pictures on which this method is the better one; a tie counts half


@dataclass(frozen=True)
class Cell:
    """One metric of one method over a group of pictures."""

    values: tuple[float, ...]  # sorted
    interval: Interval
    left_out: int  # pictures whose value is no finite number
    paired: Paired | None  # None for the first method, and where no picture has both


@dataclass(frozen=True)
class Group:
    """The pictures whose `fact` is `value`; all of them where the fact is ''."""

    fact: str
    value: str
    cells: Mapping[str, Mapping[str, Cell]]  # by metric, then by method

    @property
    def title(self) -> str:
        """The group's name in a table."""
        return f"{self.fact}: {self.value}" if self.fact else ALL


@dataclass(frozen=True)
class Summary:
    """All tables of a run."""

    layout: Layout
    methods: tuple[str, ...]
    metrics: tuple[str, ...]  # the layout's first, then what else was measured
    groups: tuple[Group, ...]  # the first is of all pictures
    pictures: int
    persons: int

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "protocol": self.layout.name,
            "title": self.layout.title,
            "notes": self.layout.notes,
            "pictures": self.pictures,
            "persons": self.persons,
            "methods": self.methods,
            "metrics": self.metrics,
            "groups": [_group_as_dict(group) for group in self.groups],
            "published": [vars(figure) for figure in self.layout.published],
        }


def _group_as_dict(group: Group) -> dict[str, Any]:
    cells = {
        metric: {method: _cell_as_dict(cell) for method, cell in by_method.items()}
        for metric, by_method in group.cells.items()
    }
    return {"fact": group.fact or None, "value": group.value or None, "metrics": cells}


def _cell_as_dict(cell: Cell) -> dict[str, Any]:
    entry: dict[str, Any] = cell.interval.as_dict() | {"left_out": cell.left_out}
    if cell.paired is not None:
        entry["less_the_first"] = cell.paired.difference.as_dict() | {"won": cell.paired.won}
    return entry


def summarise(layout: Layout, rows: Sequence[Row]) -> Summary:
    """The tables of a run's rows, at least one. Facts break down the layout's metrics only.

    Raises `ValueError` where a picture and a method stand in two rows.
    """
    keys = {(row.case, row.method) for row in rows}
    if len(keys) < len(rows):
        raise ValueError(f"{len(rows) - len(keys)} pictures were measured twice")
    measured = _in_order(name for row in rows for name in row.values)
    metrics = tuple(_in_order([*(name for name in layout.metrics if name in measured), *measured]))
    methods = tuple(_in_order(row.method for row in rows))
    groups = [Group("", "", _cells(rows, methods, metrics))]
    narrow = tuple(name for name in layout.metrics if name in measured)
    for fact in layout.by:
        for value in sorted({str(row.facts[fact]) for row in rows if fact in row.facts}, key=natural):
            inside = [row for row in rows if fact in row.facts and str(row.facts[fact]) == value]
            groups.append(Group(fact, value, _cells(inside, methods, narrow)))
    cases, persons = {row.case for row in rows}, {row.person for row in rows}
    return Summary(layout, methods, metrics, tuple(groups), len(cases), len(persons))


def published_beside(summary: Summary, group: Group, metric: str) -> list[Published]:
    """The published figures that stand beside ours of a group."""
    return [
        figure
        for figure in summary.layout.published
        if figure.metric == metric and (figure.group or ("", "")) == (group.fact, group.value)
    ]


def natural(text: str) -> list[tuple[int, float, str]]:
    """A key that sorts '5°' before '10°'."""
    parts = re.split(r"(\d+(?:\.\d+)?)", text)
    return [(0, float(part), "") if index % 2 else (1, 0.0, part) for index, part in enumerate(parts)]


def _in_order(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


def _cells(rows: Sequence[Row], methods: Sequence[str], metrics: Sequence[str]) -> dict[str, dict[str, Cell]]:
    """The cells that have values, by metric and method."""
    found: dict[str, dict[str, Cell]] = {}
    for metric in metrics:
        by_method = {
            method: {row.case: row for row in rows if row.method == method and metric in row.values}
            for method in methods
        }
        cells = {method: _cell(metric, by_method[method], by_method[methods[0]]) for method in methods}
        found[metric] = {method: cell for method, cell in cells.items() if cell is not None}
    return found


def _cell(metric: str, ours: Mapping[str, Row], firsts: Mapping[str, Row]) -> Cell | None:
    """The figures of one method's rows by case; None where none is a number."""
    values = {case: row.values[metric] for case, row in ours.items()}
    finite = {case: value for case, value in values.items() if math.isfinite(value)}
    interval = mean_interval((ours[case].person, value) for case, value in finite.items())
    if interval is None:
        return None
    paired = None if ours is firsts else _paired(metric, finite, firsts)
    return Cell(tuple(sorted(finite.values())), interval, len(values) - len(finite), paired)


def _paired(metric: str, ours: Mapping[str, float], firsts: Mapping[str, Row]) -> Paired | None:
    better = -1.0 if shown_as(metric).lower_is_better else 1.0
    differences = {
        case: (firsts[case].person, value - firsts[case].values[metric])
        for case, value in ours.items()
        if case in firsts and math.isfinite(firsts[case].values[metric])
    }
    interval = mean_interval(differences.values())
    if interval is None:
        return None
    won = [0.5 if apart == 0 else float(better * apart > 0) for _, apart in differences.values()]
    return Paired(interval, sum(won) / len(won))
