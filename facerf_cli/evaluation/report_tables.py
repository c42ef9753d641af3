"""Figures of the report's tables: the cells of a method's line, and the places of its small plot."""

import math
from dataclasses import dataclass

import numpy as np

from facerf_cli.evaluation.summary import Cell, Group, Summary, metric_named

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
