"""The report's tables: a metric each, a line a method, a small drawing of how its pictures lie."""

from collections.abc import Iterator
from html import escape

import numpy as np

from facerf_cli.evaluation.measure import Metric
from facerf_cli.evaluation.page_style import METHOD_COLOURS
from facerf_cli.evaluation.summary import ALL, Cell, Group, Summary, published_beside, shown_as

_LEFT = {"spread": ' class="text"'}
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def colour_of(summary: Summary, method: str) -> str:
    """The colour that a method has on the whole page."""
    return METHOD_COLOURS[summary.methods.index(method) % len(METHOD_COLOURS)]


def dot(colour: str) -> str:
    """A coloured dot before a method's name."""
    return f'<span class="dot" style="background:{colour}"></span>'


def metric_table(summary: Summary, metric: str, groups: list[Group]) -> Iterator[str]:
    """One metric in the groups: figures, drawings on one axis, and the published figures beside them."""
    how = shown_as(metric)
    axis = _axis(groups, metric)
    several = len(summary.methods) > 1
    heads = ["pictures", "spread", "mean", "sd", "median", "95 % interval"]
    heads += [f"difference to {escape(summary.methods[0])} (95 % interval)", "won"] if several else []
    by_fact = bool(groups[0].fact)
    better = "less is better" if how.lower_is_better else "more is better"
    yield '<div class="scroll" tabindex="0" role="region" aria-label="' + escape(how.title) + '"><table>'
    title = escape(how.title[:1].upper() + how.title[1:])
    yield f"<caption><b>{title}</b>, {better}; {_axis_words(how, axis)}</caption>"
    yield "<thead><tr>" + (f'<th scope="col">{escape(groups[0].fact)}</th>' if by_fact else "")
    yield '<th scope="col" class="text">method</th>'
    yield "".join(f'<th scope="col"{_LEFT.get(head, "")}>{head}</th>' for head in heads)
    yield "</tr></thead>"
    for group in groups:
        yield from _group(summary, group, metric, axis, by_fact, several)
    yield "</table></div>"


def _axis(groups: list[Group], metric: str) -> tuple[float, float]:
    """The lowest and highest value that drawings show; from 0 where values are not negative."""
    cells = [cell for group in groups for cell in group.cells.get(metric, {}).values()]
    lows = [float(np.quantile(cell.values, _QUANTILES[0])) for cell in cells]
    highs = [max(float(np.quantile(cell.values, _QUANTILES[-1])), cell.interval.mean) for cell in cells]
    if not cells:
        return 0.0, 1.0
    low, high = min(lows), max(highs)
    # An error's axis begins at 0; that of a similarity or a signed drift where its values do.
    low = 0.0 if low >= 0 and shown_as(metric).lower_is_better else low
    return (low, high) if high > low else (low, low + 1)


def _axis_words(how: Metric, axis: tuple[float, float]) -> str:
    low, high = (f"{value:.{how.digits}f}" for value in axis)
    return f"drawn from {low} to {high}"


def _group(
    summary: Summary, group: Group, metric: str, axis: tuple[float, float], by_fact: bool, several: bool
) -> Iterator[str]:
    """A group's lines: a method each, then what was published."""
    digits = shown_as(metric).digits
    cells = group.cells.get(metric, {})
    published = published_beside(summary, group, metric) if cells else []
    lines = len(cells) + len(published)
    head = f'<th scope="rowgroup" rowspan="{lines}">{escape(group.value)}</th>' if by_fact else ""
    yield "<tbody>"
    for method, cell in cells.items():
        colour = colour_of(summary, method)
        yield f'<tr>{head}<td class="text">{dot(colour)}{escape(method)}</td>'
        yield _figures(cell, digits, colour, axis, several) + "</tr>"
        head = ""
    for figure in published:
        mean, sd = figure.shown(digits)
        name = f"{escape(figure.method)}, published ({escape(figure.source)})"
        yield f'<tr class="published"><td class="text">{name}</td><td></td><td></td>'
        yield f"<td>{mean}</td><td>{sd}</td>"
        yield f'<td class="data" colspan="{4 if several else 2}">{escape(figure.data)}</td></tr>'
    yield "</tbody>"


def _figures(cell: Cell, digits: int, colour: str, axis: tuple[float, float], several: bool) -> str:
    """A method's cells after its name."""
    interval, paired = cell.interval, cell.paired
    left_out = f" ({cell.left_out} without a value)" if cell.left_out else ""
    known = interval.low == interval.low  # NaN where there is one person
    between = f"{interval.low:.{digits}f} to {interval.high:.{digits}f}" if known else "one person: unknown"
    entries = [f"{value:.{digits}f}" for value in (interval.mean, interval.sd, interval.median)] + [between]
    if several and paired is None:
        entries += ["", ""]
    elif paired is not None:
        apart = paired.difference
        interval_words = f" ({apart.low:+.{digits}f} to {apart.high:+.{digits}f})" if known else ""
        entries += [f"{apart.mean:+.{digits}f}{interval_words}", f"{100 * paired.won:.0f} %"]
    drawn = f'<td class="chart">{spread(cell, colour, axis)}</td>'
    return f"<td>{interval.pictures}{left_out}</td>{drawn}" + "".join(f"<td>{e}</td>" for e in entries)


def spread(cell: Cell, colour: str, axis: tuple[float, float]) -> str:
    """How a method's pictures lie on the axis, as inline SVG; its figures stand beside it in words."""
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


def other_metrics(summary: Summary) -> Iterator[str]:
    """All metrics of all pictures in one table: mean and standard deviation."""
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
        how, cells = shown_as(metric), overall.cells.get(metric, {})
        better = "less" if how.lower_is_better else "more"
        yield f'<tr><th scope="row">{escape(how.title)}</th><td class="text">{better}</td>'
        yield "".join(_mean_cell(cells.get(method), how.digits) for method in summary.methods) + "</tr>"
    yield "</tbody></table></div>"


def _mean_cell(cell: Cell | None, digits: int) -> str:
    if cell is None:
        return "<td>none</td>"
    return f"<td>{cell.interval.mean:.{digits}f} ({cell.interval.sd:.{digits}f})</td>"
