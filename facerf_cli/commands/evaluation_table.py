"""An evaluation's tables on the terminal: plain text when piped."""

import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from facerf_cli.records import counted

if TYPE_CHECKING:
    from facerf_cli.evaluation.summary import Cell, Group, Summary

_PIPED_WIDTH = 100


def print_tables(summary: "Summary") -> None:
    """Print the tables of the layout's metrics to standard output."""
    terminal = sys.stdout.isatty()
    console = Console(file=sys.stdout, width=None if terminal else _PIPED_WIDTH, highlight=False)
    layout = summary.layout
    pictures, persons = counted(summary.pictures, "picture"), counted(summary.persons, "person")
    console.print(Text(f"{layout.title}: {pictures} of {persons}", style="bold"))
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
    from facerf_cli.evaluation.summary import shown_as

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
    from facerf_cli.evaluation.summary import published_beside, shown_as

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
    figures = [str(interval.pictures), *(f"{value:.{digits}f}" for value in _middle(cell))]
    figures.append(f"{interval.low:.{digits}f} to {interval.high:.{digits}f}" if known else "one person")
    if paired is None:
        return [*figures, "", ""]
    return [*figures, f"{paired.difference.mean:+.{digits}f}", f"{100 * paired.won:.0f} %"]


def _middle(cell: "Cell") -> tuple[float, float, float]:
    return cell.interval.mean, cell.interval.sd, cell.interval.median
