"""The tables of the report: one for each metric, a line for each method, and a small plot of its values."""

import math
from collections.abc import Iterator
from html import escape

import numpy as np

from facerf_cli.evaluation.measure import Metric
from facerf_cli.evaluation.summary import ALL, Cell, Group, Summary, metric_named, published_for

# Okabe and Ito's colours (2008), which colour-blind readers can tell apart; for methods in their order.
METHOD_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#3a9fd8", "#8a8a8a")
_LEFT = {"spread": ' class="text"'}  # heads of columns that are aligned to the left
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)  # of the plots: line, box, bar, box, line


def colour_of(summary: Summary, method: str) -> str:
    """A method's colour, the same on the whole page."""
    return METHOD_COLOURS[summary.methods.index(method) % len(METHOD_COLOURS)]


def dot(colour: str) -> str:
    """A coloured dot before a method's name."""
    return f'<span class="dot" style="background:{colour}"></span>'


def metric_table(summary: Summary, metric: str, groups: list[Group]) -> Iterator[str]:
    """One metric by groups: figures, plots on one axis, and the published figures."""
    how = metric_named(metric)
    axis = _axis(groups, metric)
    several = len(summary.methods) > 1
    heads = ["images", "spread", "mean", "sd", "median", "95 % interval"]
    heads += [f"difference to {escape(summary.methods[0])} (95 % interval)", "won"] if several else []
    by_fact = bool(groups[0].fact)
    better = "less" if how.lower_is_better else "more"
    yield '<div class="scroll" tabindex="0" role="region" aria-label="' + escape(how.title) + '"><table>'
    title = escape(how.title[:1].upper() + how.title[1:])
    yield f"<caption><b>{title}</b>, {better} is better; {_axis_words(how, axis)}</caption>"
    yield "<thead><tr>" + (f'<th scope="col">{escape(groups[0].fact)}</th>' if by_fact else "")
    yield '<th scope="col" class="text">method</th>'
    yield "".join(f'<th scope="col"{_LEFT.get(head, "")}>{head}</th>' for head in heads)
    yield "</tr></thead>"
    for group in groups:
        yield from _group(summary, group, metric, axis, by_fact, several)
    yield "</table></div>"


def _axis(groups: list[Group], metric: str) -> tuple[float, float]:
    """The lowest and highest value of the plots; an error's axis begins at 0 if no value is negative."""
    cells = [cell for group in groups for cell in group.cells.get(metric, {}).values()]
    lows = [float(np.quantile(cell.values, _QUANTILES[0])) for cell in cells]
    highs = [max(float(np.quantile(cell.values, _QUANTILES[-1])), cell.interval.mean) for cell in cells]
    if not cells:
        return 0.0, 1.0
    low, high = min(lows), max(highs)
    low = 0.0 if low >= 0 and metric_named(metric).lower_is_better else low
    return (low, high) if high > low else (low, low + 1)


def _axis_words(how: Metric, axis: tuple[float, float]) -> str:
    low, high = (f"{value:.{how.digits}f}" for value in axis)
    return f"plotted from {low} to {high}"


def _group(
    summary: Summary, group: Group, metric: str, axis: tuple[float, float], by_fact: bool, several: bool
) -> Iterator[str]:
    """A group's lines: one for each method, then the published figures."""
    digits = metric_named(metric).digits
    cells = group.cells.get(metric, {})
    published = published_for(summary, group, metric) if cells else []
    lines = len(cells) + len(published)
    head = f'<th scope="rowgroup" rowspan="{lines}">{escape(group.value)}</th>' if by_fact else ""
    yield "<tbody>"
    for method, cell in cells.items():
        colour = colour_of(summary, method)
        yield f'<tr>{head}<td class="text">{dot(colour)}{escape(method)}</td>'
        yield _method_cells(cell, digits, colour, axis, several) + "</tr>"
        head = ""
    for figure in published:
        mean, sd = figure.shown(digits)
        name = f"{escape(figure.method)}, published ({escape(figure.source)})"
        yield f'<tr class="published"><td class="text">{name}</td><td></td><td></td>'
        yield f"<td>{mean}</td><td>{sd}</td>"
        yield f'<td class="data" colspan="{4 if several else 2}">{escape(figure.data)}</td></tr>'
    yield "</tbody>"


def _method_cells(cell: Cell, digits: int, colour: str, axis: tuple[float, float], several: bool) -> str:
    """The cells of a method's line after its name."""
    interval, paired = cell.interval, cell.paired
    left_out = f" ({cell.left_out} without a value)" if cell.left_out else ""
    known = not math.isnan(interval.low)  # NaN with one person
    between = f"{interval.low:.{digits}f} to {interval.high:.{digits}f}" if known else "one person: unknown"
    entries = [f"{value:.{digits}f}" for value in (interval.mean, interval.sd, interval.median)] + [between]
    if several and paired is None:
        entries += ["", ""]
    elif paired is not None:
        apart = paired.difference
        interval_words = f" ({apart.low:+.{digits}f} to {apart.high:+.{digits}f})" if known else ""
        entries += [f"{apart.mean:+.{digits}f}{interval_words}", f"{100 * paired.won:.0f} %"]
    drawn = f'<td class="plot">{spread(cell, colour, axis)}</td>'
    return f"<td>{interval.images}{left_out}</td>{drawn}" + "".join(f"<td>{e}</td>" for e in entries)


def spread(cell: Cell, colour: str, axis: tuple[float, float]) -> str:
    """Plot the spread of a method's values as inline SVG; the same figures are in the table as text."""
    low, high = axis

    def x(value: float) -> str:
        return f"{100 * min(max((value - low) / (high - low), 0), 1):.2f}%"

    def wide(start: float, end: float) -> str:
        return f"{max(100 * (min(end, high) - max(start, low)) / (high - low), 0.4):.2f}%"

    least, lower, middle, upper, most = (float(v) for v in np.quantile(cell.values, _QUANTILES))
    return (
        '<svg aria-hidden="true" focusable="false">'
        f'<line x1="{x(least)}" x2="{x(most)}" y1="50%" y2="50%" stroke="{colour}" stroke-width="1.5"/>'
        f'<rect x="{x(lower)}" y="25%" width="{wide(lower, upper)}" height="50%" fill="{colour}" '
        'fill-opacity="0.3"/>'
        f'<line x1="{x(middle)}" x2="{x(middle)}" y1="25%" y2="75%" stroke="{colour}" stroke-width="2"/>'
        f'<circle cx="{x(cell.interval.mean)}" cy="50%" r="4" fill="{colour}"/></svg>'
    )


def all_metrics_table(summary: Summary) -> Iterator[str]:
    """All metrics over all images in one table: mean and standard deviation."""
    overall = summary.groups[0]
    yield '<div class="scroll" tabindex="0" role="region" aria-label="All metrics"><table>'
    yield f"<caption>Mean (standard deviation) over {ALL}.</caption><thead><tr>"
    yield '<th scope="col">metric</th><th scope="col" class="text">better</th>'
    yield "".join(
        f'<th scope="col">{dot(colour_of(summary, method))}{escape(method)}</th>'
        for method in summary.methods
    )
    yield "</tr></thead><tbody>"
    for metric in summary.metrics:
        how, cells = metric_named(metric), overall.cells.get(metric, {})
        better = "less" if how.lower_is_better else "more"
        yield f'<tr><th scope="row">{escape(how.title)}</th><td class="text">{better}</td>'
        yield "".join(_mean_cell(cells.get(method), how.digits) for method in summary.methods) + "</tr>"
    yield "</tbody></table></div>"


def _mean_cell(cell: Cell | None, digits: int) -> str:
    if cell is None:
        return "<td>none</td>"
    return f"<td>{cell.interval.mean:.{digits}f} ({cell.interval.sd:.{digits}f})</td>"
