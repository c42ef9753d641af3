"""The loss of one or several training runs over their steps, drawn from log.jsonl.

    python benchmarks/loss_curve.py RUN [RUN ...] [--term loss] [-o out/loss_curve.png]

Faint: every step; bold: a running mean. Points: the validations, by the axis on the right. Both axes are
logarithmic. A term or metric is a column of the log, or of its `terms` or `validation`.
"""

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import uniform_filter1d

_SIZE_PX = (1100, 620)
_SCALE = 2  # drawn this much larger, then averaged down
_BOX = (90, 20, 1000, 560)  # of the axes: left, top, right, bottom
_COLOURS = [(31, 95, 165), (200, 85, 20), (50, 130, 60), (140, 60, 150)]
_WINDOW = 0.05  # of the running mean, as a share of the run

_TABLES = ("terms", "validation")  # within a row

Curve = np.ndarray  # [N, 2] of step and value
Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+", help="folders of `facerf train`, or their log.jsonl")
    parser.add_argument("--term", default="loss", help="the column of the log")
    parser.add_argument("--metric", default="si_mse", help="that of the validations")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/loss_curve.png"))
    given = parser.parse_args()
    logs = [read_log(run / "log.jsonl" if run.is_dir() else run) for run in given.runs]
    losses = [curve(rows, given.term) for rows in logs]
    if not any(len(loss) for loss in losses):
        known = sorted({key for rows in logs for row in rows for key in (*row, *row.get("terms", {}))})
        raise SystemExit(f"no column {given.term!r} in the log; it has {', '.join(known)}")
    given.output.parent.mkdir(parents=True, exist_ok=True)
    names = [run.name if run.is_dir() else run.parent.name for run in given.runs]
    validations = [curve(rows, given.metric) for rows in logs]
    draw_chart(losses, validations, names, (given.term, given.metric)).save(given.output)
    print(given.output)


def read_log(path: Path) -> list[Row]:
    """The rows of a log; a last line that was cut short is left out."""
    if not path.is_file():
        raise SystemExit(f"{path}: no such log; give a folder that `facerf train` wrote")
    rows = []
    for line in path.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def curve(rows: list[Row], column: str) -> Curve:
    """Steps and positive values of a column [N, 2]."""
    found = [(row["step"], _value(row, column)) for row in rows]
    return np.array([(step, value) for step, value in found if value > 0], float).reshape(-1, 2)


def _value(row: Row, column: str) -> float:
    """A column of a row or of the tables in it; 0 where there is none."""
    tables = [row, *(row.get(name, {}) for name in _TABLES)]
    return next((float(table[column]) for table in tables if column in table), 0.0)


def draw_chart(
    losses: list[Curve], validations: list[Curve], names: list[str], titles: tuple[str, str]
) -> Image.Image:
    """The chart of all runs."""
    image = Image.new("RGB", (_SIZE_PX[0] * _SCALE, _SIZE_PX[1] * _SCALE), "white")
    draw = ImageDraw.Draw(image)
    last = max(loss[-1, 0] for loss in losses if len(loss))
    left, right = _Axis(losses, last), _Axis([*validations, np.zeros((0, 2))], last)
    _draw_axes(draw, left, right, last, titles)
    colours = [_COLOURS[number % len(_COLOURS)] for number in range(len(losses))]
    for loss, colour in zip(losses, colours, strict=True):
        draw.line(left.places(loss), fill=tuple(255 - (255 - part) // 4 for part in colour), width=1)
    for number, (loss, colour) in enumerate(zip(losses, colours, strict=True)):
        draw.line(left.places(_smoothed(loss)), fill=colour, width=2 * _SCALE)
        for x, y in right.places(validations[number]):
            draw.ellipse([x - 7, y - 7, x + 7, y + 7], outline="black", fill=colour)
        _text(draw, (_BOX[2] - 180, _BOX[1] + 8 + 18 * number), names[number], colour)
    return image.resize(_SIZE_PX, Image.Resampling.LANCZOS)


def _smoothed(loss: Curve) -> Curve:
    """The running geometric mean."""
    if not len(loss):
        return loss
    window = min(max(3, round(_WINDOW * len(loss))), len(loss))
    return np.column_stack([loss[:, 0], np.exp(uniform_filter1d(np.log(loss[:, 1]), window, mode="mirror"))])


class _Axis:
    """A logarithmic axis over values of curves, and steps from 0 to `last`."""

    def __init__(self, curves: list[Curve], last: float) -> None:
        values = np.concatenate([each[:, 1] for each in curves])
        self.empty = not len(values)
        low, high = (0.1, 1.0) if self.empty else np.percentile(values, [0.1, 99.5])
        self.low, self.high, self.last = math.log(low / 1.1), math.log(high * 1.1), last

    def places(self, points: Curve) -> list[tuple[float, float]]:
        """Points [N, 2] in the large picture's pixels."""
        x0, y0, x1, y1 = (_SCALE * edge for edge in _BOX)
        x = x0 + points[:, 0] / self.last * (x1 - x0)
        share = (np.log(points[:, 1]) - self.low) / (self.high - self.low)
        return list(zip(x.tolist(), (y1 - share.clip(0, 1) * (y1 - y0)).tolist(), strict=True))

    def ticks(self) -> list[float]:
        """Round values within the axis: 1, 2 and 5 times powers of ten."""
        if self.empty:
            return []
        powers = range(math.floor(self.low / math.log(10)), math.ceil(self.high / math.log(10)) + 1)
        values = [part * 10.0**power for power in powers for part in (1, 1.5, 2, 3, 5, 7)]
        return [value for value in values if self.low <= math.log(value) <= self.high]


def _draw_axes(
    draw: ImageDraw.ImageDraw, left: _Axis, right: _Axis, last: float, titles: tuple[str, str]
) -> None:
    draw.rectangle([_SCALE * edge for edge in _BOX], outline="black", width=_SCALE)
    for axis, x in ((left, _BOX[0] - 62), (right, _BOX[2] + 8)):
        for value in axis.ticks():
            ((_, y),) = axis.places(np.array([[0.0, value]]))
            _text(draw, (x, y / _SCALE - 7), f"{value:.4g}", (0, 0, 0))
    width = 10 ** math.floor(math.log10(max(last, 1)))
    width = next(width * part for part in (0.1, 0.2, 0.5, 1.0) if last / (width * part) <= 11)
    for step in np.arange(0, last + 1, max(width, 1)):
        x = _BOX[0] + step / last * (_BOX[2] - _BOX[0])
        _text(draw, (x - 15, _BOX[3] + 8), f"{step:.0f}", (0, 0, 0))
    _text(draw, (_BOX[0] + 320, _BOX[1] + 8), f"{titles[0]} (lines, left)", (0, 0, 0))
    if not right.empty:
        _text(draw, (_BOX[0] + 320, _BOX[1] + 26), f"validation {titles[1]} (points, right)", (0, 0, 0))
    _text(draw, ((_BOX[0] + _BOX[2]) / 2 - 15, _BOX[3] + 30), "step", (0, 0, 0))


def _text(draw: ImageDraw.ImageDraw, place: tuple[float, float], words: str, colour: tuple[int, ...]) -> None:
    draw.text((place[0] * _SCALE, place[1] * _SCALE), words, fill=colour, font_size=13 * _SCALE)


if __name__ == "__main__":
    main()
