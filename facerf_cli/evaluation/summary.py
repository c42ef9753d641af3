"""The figures of the paper's Tables 1 to 4 (paper, 'Results'): shown beside ours, measured on other data.

From a run's rows to its tables: each method overall and by every fact, and against the first method.

An evaluation's tables on the terminal: plain text when piped.
"""

import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from facerf_cli.evaluation.measure import METRICS, Metric, Row
from facerf_cli.logs import counted
from facerf_cli.metrics import Interval, mean_interval


@dataclass(frozen=True)
class Published:
    """A published figure: mean and standard deviation over pictures of one metric of one method.

    `group` names the fact and value of ours that it stands beside ('pose', 'same pose'); None is all
    pictures. `source` and `data` say where it stands and what it was measured on.
    """

    method: str
    metric: str
    mean: float
    sd: float | None = None
    group: tuple[str, str] | None = None
    source: str = "the paper"
    data: str = "other data than ours"
    digits: int | None = None  # after the point, as published; None: as ours are shown

    def shown(self, digits: int) -> tuple[str, str]:
        """Mean and standard deviation as text, with no more digits than were published."""
        digits = digits if self.digits is None else self.digits
        return f"{self.mean:.{digits}f}", "" if self.sd is None else f"{self.sd:.{digits}f}"


_LIGHT_STAGE = "people in a light stage; other data than ours"
_CELEBA = "130 pictures of CelebA-HQ; other data than ours"
_TEST_SET = "86 light-stage pictures in natural light; other data than ours"
_METHODS = ("the paper's", "Smith et al.", "Schneider et al.", "Tewari et al.")

TABLE_1 = (
    Published("the paper's", "si_mse", 0.00070, 0.00059, ("pose", "same pose"), "Table 1", _LIGHT_STAGE),
    Published("the paper's", "si_mse", 0.00084, 0.00088, ("pose", "different pose"), "Table 1", _LIGHT_STAGE),
)


def _table_2(metric: str, data: str, figures: tuple[tuple[float, float], ...]) -> tuple[Published, ...]:
    """A row of Table 2, in the order of `_METHODS`."""
    return tuple(
        Published(method, metric, mean, sd, None, "Table 2", data, 3)
        for method, (mean, sd) in zip(_METHODS, figures, strict=True)
    )


TABLE_2_RECONSTRUCTION = (
    *_table_2("si_mse", _CELEBA, ((0.004, 0.002), (0.017, 0.015), (0.010, 0.008), (0.007, 0.003))),
    *_table_2("face_distance", _CELEBA, ((0.550, 0.080), (0.650, 0.076), (0.685, 0.067), (0.762, 0.075))),
)
TABLE_2_TRANSFER = (
    *_table_2("si_mse", _TEST_SET, ((0.002, 0.001), (0.018, 0.011), (0.007, 0.005), (0.003, 0.001))),
    *_table_2("face_distance", _TEST_SET, ((0.482, 0.084), (0.605, 0.092), (0.644, 0.077), (0.689, 0.076))),
)
TABLE_3 = (
    Published("without normals", "si_mse", 0.00113, 0.00093, ("pose", "same pose"), "Table 3", _LIGHT_STAGE),
    Published(
        "without normals", "si_mse", 0.00126, 0.00116, ("pose", "different pose"), "Table 3", _LIGHT_STAGE
    ),
)
TABLE_4 = (
    Published("all components", "si_mse", 0.004, 0.002, None, "Table 4", _CELEBA, 3),
    Published("mean face", "si_mse", 0.011, 0.005, None, "Table 4", _CELEBA, 3),
    Published("all components", "face_distance", 0.550, 0.080, None, "Table 4", _CELEBA, 3),
    Published("mean face", "face_distance", 0.550, 0.073, None, "Table 4", _CELEBA, 3),
)

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
    images: int
    persons: int

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "protocol": self.layout.name,
            "title": self.layout.title,
            "notes": self.layout.notes,
            "pictures": self.images,
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


_PIPED_WIDTH = 100


def print_tables(summary: "Summary") -> None:
    """Print the tables of the layout's metrics to standard output."""
    terminal = sys.stdout.isatty()
    console = Console(file=sys.stdout, width=None if terminal else _PIPED_WIDTH, highlight=False)
    layout = summary.layout
    images, persons = counted(summary.images, "picture"), counted(summary.persons, "person")
    console.print(Text(f"{layout.title}: {images} of {persons}", style="bold"))
    first, *others = [metric for metric in layout.metrics if metric in summary.metrics]
    console.print(_table(summary, first, summary.groups, plain=not terminal))
    for metric in others:
        console.print(_table(summary, metric, summary.groups[:1], plain=not terminal))
    measured_on = dict.fromkeys(f"{figure.source}: {figure.data}" for figure in layout.published)
    if measured_on:
        console.print(Text("Published figures. " + ". ".join(measured_on) + "."))
    for note in layout.notes:
        console.print(Text(note))


def _table(summary: "Summary", metric: str, groups: "Sequence[Group]", plain: bool) -> Table:

    how = shown_as(metric)
    better = "less" if how.lower_is_better else "more"
    table = Table(
        title=Text(f"\n{how.title} ({better} is better)"),
        title_justify="left",
        box=None if plain else box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
        expand=False,
    )
    table.add_column("pictures", overflow="fold", min_width=20, max_width=26)
    table.add_column("method", overflow="fold", max_width=20)
    for name in ("n", "mean", "sd", "median", "95 % interval", "vs first", "won"):
        table.add_column(name, justify="right", no_wrap=True)
    several = len(summary.methods) > 1
    for group in groups:
        for row in _rows(summary, group, metric):
            table.add_row(*(Text(entry) for entry in row))
    if not several:
        for _ in range(2):
            table.columns.pop()
    return table


def _rows(summary: "Summary", group: "Group", metric: str) -> Iterator[list[str]]:
    """The group's rows: a method each, then what others published beside it."""
    digits = shown_as(metric).digits
    cells = group.cells.get(metric, {})
    title = group.title
    for method, cell in cells.items():
        yield [title, method, *_figures(cell, digits)]
        title = ""
    for figure in published_beside(summary, group, metric):
        yield [f"published, {figure.source}", figure.method, "", *figure.shown(digits), *[""] * 4]


def _figures(cell: "Cell", digits: int) -> list[str]:
    interval, paired = cell.interval, cell.paired
    known = interval.low == interval.low  # NaN with one person
    figures = [str(interval.images), *(f"{value:.{digits}f}" for value in _middle(cell))]
    figures.append(f"{interval.low:.{digits}f} to {interval.high:.{digits}f}" if known else "one person")
    if paired is None:
        return [*figures, "", ""]
    return [*figures, f"{paired.difference.mean:+.{digits}f}", f"{100 * paired.won:.0f} %"]


def _middle(cell: "Cell") -> tuple[float, float, float]:
    return cell.interval.mean, cell.interval.sd, cell.interval.median
