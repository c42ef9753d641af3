"""A case as one small picture to look at: what was seen and the truth, and each method over its error.

Which of an item's strips are kept: the worst, the best and some that are neither, never all.

How the report looks: on a desk, on a telephone, at night and on paper; no scripts, nothing fetched.

The report's tables: a metric each, a line a method, a small drawing of how its pictures lie.

The report's pictures: the worst cases first, then some that are typical and the best.

The report of an evaluation: one HTML file that needs nothing else, no network and no script.
"""

import base64
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from html import escape

import numpy as np
from PIL import Image

from facerf_cli.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.evaluation.case import Comparison
from facerf_cli.evaluation.case_files import KeptStrip
from facerf_cli.evaluation.measure import Metric, Row
from facerf_cli.evaluation.summary import ALL, Cell, Group, Summary, published_beside, shown_as
from facerf_cli.files.drawings import html_page
from facerf_cli.metrics import best_scale

ERROR_HIGHEST = 0.2  # of display values 0..1: where the false colours end
# Dark to bright through violet and orange, in lightness that only rises, so that it also reads in grey.
ERROR_COLOURS = ((8, 6, 20), (87, 22, 110), (187, 55, 84), (249, 142, 9), (252, 250, 176))
_TILE_PX = 192
_GAP_PX = 4
_GAP = 128  # between tiles: neither a light page nor a dark one makes it glare
_PAPER = 0.16  # display value of what is left out of the comparison


@dataclass(frozen=True, eq=False)
class Strip:
    """Tiles [2 h, (1 + methods) w, 3], bytes for display: a column of source over truth, then the methods'.

    A method's column is its picture over its error, at the truth's exposure `ev`; `scales` is what each
    picture was multiplied by before, 1 where no scale was sought. A source has an exposure of its own; where
    there is none, the mask stands in its place.
    """

    pixels: np.ndarray
    methods: tuple[str, ...]
    ev: float
    scales: tuple[float, ...]
    has_source: bool


def strip_of(comparison: Comparison, scaled: bool) -> Strip:
    """The strip of a case; `scaled` shows a prediction at the scale that linear Si-MSE compares it at."""
    truth, mask = comparison.truth, comparison.mask
    ev = auto_exposure_ev(truth, mask)
    tile = _tile_size(truth.shape)
    true = _display(truth, ev)
    seen = mask if comparison.source is None else _seen(comparison.source)
    columns, scales = [_column(_fitted(seen, tile), _fitted(true, tile))], []
    for prediction in comparison.predictions.values():
        scale = best_scale(prediction, truth, mask) if scaled else 1.0
        ours = _display(scale * prediction, ev)
        columns.append(_column(_fitted(_inside(ours, mask), tile), _fitted(_error(ours, true, mask), tile)))
        scales.append(scale)
    methods = tuple(comparison.predictions)
    pixels = np.concatenate(columns, 1)[:-_GAP_PX, :-_GAP_PX]
    return Strip(pixels, methods, ev, tuple(scales), comparison.source is not None)


def _tile_size(shape: tuple[int, ...]) -> tuple[int, int]:
    """Width and height of a tile for pictures [H, W, ...]: the longer side is `_TILE_PX`."""
    longer = max(shape[:2])
    return round(_TILE_PX * shape[1] / longer) or 1, round(_TILE_PX * shape[0] / longer) or 1


def _display(linear: np.ndarray, ev: float) -> np.ndarray:
    """Linear light of any shape as display values 0..1."""
    return linear_to_srgb(np.clip(linear * np.float32(2.0**ev), 0, 1))


def _seen(source: np.ndarray) -> np.ndarray:
    """The source as display values, at its own exposure."""
    return _display(source, auto_exposure_ev(source))


def _inside(display: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A prediction [H, W, 3] where it is compared; what lies outside means nothing."""
    weight = mask[..., None].astype(np.float32)
    return weight * display + (1 - weight) * np.float32(_PAPER)


def _error(ours: np.ndarray, true: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The channels' mean absolute difference of display values [H, W, 3], in false colours [H, W, 3]."""
    apart = np.abs(ours - true).mean(-1) * (mask > 0) / ERROR_HIGHEST
    stops = np.linspace(0, 1, len(ERROR_COLOURS))
    channels = [np.interp(apart, stops, np.array(ERROR_COLOURS)[:, channel] / 255) for channel in range(3)]
    return np.stack(channels, -1)


def _fitted(display: np.ndarray, tile: tuple[int, int]) -> np.ndarray:
    """A picture [h, w, 3] or [h, w] in 0..1, made to fit a tile and centred on it, as bytes."""
    data = (np.clip(np.nan_to_num(display), 0, 1) * 255 + 0.5).astype(np.uint8)
    image = Image.fromarray(data).convert("RGB")
    ratio = min(tile[0] / image.width, tile[1] / image.height)
    size = max(1, round(image.width * ratio)), max(1, round(image.height * ratio))
    paper = Image.new("RGB", tile, (round(255 * _PAPER),) * 3)
    resized = image.resize(size, Image.Resampling.LANCZOS if ratio < 1 else Image.Resampling.BICUBIC)
    paper.paste(resized, ((tile[0] - size[0]) // 2, (tile[1] - size[1]) // 2))
    return np.asarray(paper)


def _column(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Two tiles in a column, each with a gap below and on its right."""
    frame = ((0, _GAP_PX), (0, _GAP_PX), (0, 0))
    return np.concatenate([np.pad(tile, frame, constant_values=_GAP) for tile in (above, below)])


_WORST, _WORST_OF_OTHERS, _BEST, _TYPICAL = 8, 2, 2, 2
_SAMPLE = 16  # of which the most typical ones are taken


@dataclass(frozen=True, eq=False)
class _Entry:
    height: float
    case: str
    strip: Strip


@dataclass(eq=False)
class StripKeeper:
    """Fed an item's pictures one after another, it holds a bounded number of strips.

    By `metric`: the worst of the first method, fewer of each other one, the best, and, from an even sample of
    all, those nearest to the median.
    """

    metric: str
    _worst: dict[str, list[_Entry]] = field(default_factory=dict)  # by method
    _best: list[_Entry] = field(default_factory=list)
    _sample: list[_Entry] = field(default_factory=list)
    _all: list[float] = field(default_factory=list)
    _stride: int = 1

    def offer(self, rows: Sequence[Row], make: Callable[[], Strip]) -> None:
        """A picture's rows, one a method; its strip is made only where it is kept."""
        made = cache(make)
        for index, row in enumerate(rows):
            badness = self._badness(row)
            if not math.isfinite(badness):
                continue
            worst = self._worst.setdefault(row.method, [])
            _insert(worst, badness, row.case, made, _WORST if index == 0 else _WORST_OF_OTHERS)
            if index == 0:
                _insert(self._best, -badness, row.case, made, _BEST)
                self._take_sample(badness, row.case, made)

    def kept(self) -> dict[str, Strip]:
        """The strips by case, in the order of the cases' names."""
        entries = [*self._best, *(entry for worst in self._worst.values() for entry in worst)]
        if self._all:
            median = sorted(self._all)[len(self._all) // 2]
            entries += sorted(self._sample, key=lambda entry: abs(entry.height - median))[:_TYPICAL]
        return {entry.case: entry.strip for entry in sorted(entries, key=lambda entry: entry.case)}

    def _take_sample(self, badness: float, case: str, made: Callable[[], Strip]) -> None:
        """Keep every `_stride`-th picture, and twice that stride when they are too many."""
        if len(self._all) % self._stride == 0:
            self._sample.append(_Entry(badness, case, made()))
        self._all.append(badness)
        if len(self._sample) > _SAMPLE:
            del self._sample[1::2]
            self._stride *= 2

    def _badness(self, row: Row) -> float:
        value = row.values.get(self.metric, math.nan)
        return value if shown_as(self.metric).lower_is_better else -value


def _insert(highest: list[_Entry], height: float, case: str, made: Callable[[], Strip], most: int) -> None:
    """Keep the `most` highest, the highest first; of equals the earlier one."""
    if len(highest) < most or height > highest[-1].height:
        highest.append(_Entry(height, case, made()))
        highest.sort(key=lambda entry: -entry.height)
        del highest[most:]


# Okabe and Ito's colours (2008), told apart by colour-blind readers; the methods' in their order.
METHOD_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#3a9fd8", "#8a8a8a")
_GRADIENT = ", ".join(f"rgb({r} {g} {b})" for r, g, b in ERROR_COLOURS)

STYLE = (
    """
:root { color-scheme: light dark; --paper: #fff; --ink: #1b1e23; --soft: #5a626d; --line: #d9dde3;
  --band: #f4f6f8; --link: #0a5ea8; --mark: #7a4b00; --marked: #fff6e3 }
@media (prefers-color-scheme: dark) { :root { --paper: #15181c; --ink: #e6e8eb; --soft: #a3abb6;
  --line: #363c45; --band: #1e2228; --link: #7dbdf5; --mark: #f0c674; --marked: #2c2616 } }
* { box-sizing: border-box }
body { margin: 0 auto; padding: 2rem 1.25rem 4rem; max-width: 80rem; background: var(--paper);
  color: var(--ink); font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .25rem }
h2 { font-size: 1.25rem; margin: 2.75rem 0 .5rem; padding-top: .75rem; border-top: 1px solid var(--line) }
h3 { font-size: 1rem; margin: 1.75rem 0 .4rem }
p { margin: .4rem 0; max-width: 46rem } a { color: var(--link) }
.lead { color: var(--soft); font-size: 1.05rem }
.soft, caption, figcaption { color: var(--soft); font-size: .875rem }
pre { background: var(--band); border: 1px solid var(--line); border-radius: 6px; padding: .6rem .8rem;
  overflow-x: auto; white-space: pre-wrap; overflow-wrap: anywhere; font-size: .85rem; margin: .75rem 0 }
nav ul { list-style: none; display: flex; flex-wrap: wrap; gap: .25rem 1.25rem; padding: 0; margin: 1rem 0 0 }
.scroll { overflow-x: auto; margin: .5rem 0 1rem }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; width: 100% }
caption { text-align: left; padding: 0 0 .4rem }
th, td { padding: .3rem .55rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line) }
thead th { color: var(--soft); font-weight: 600; border-bottom: 2px solid var(--line) }
th:first-child, td:first-child, th.text, td.text { text-align: left }
tbody th { font-weight: 600 } tbody.group th { border-bottom-color: transparent }
tr.published td, tr.published th { background: var(--marked); color: var(--mark); font-weight: 400 }
td.data { text-align: left; white-space: normal }
td.chart { width: 22%; min-width: 8.5rem; padding: 0 .7rem }
td.chart svg { display: block; width: 100%; height: 1.6rem; overflow: visible }
.dot { display: inline-block; width: .7em; height: .7em; border-radius: 50%; margin-right: .5em }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1rem; margin: .75rem 0;
  font-size: .9rem }
dt { color: var(--soft) } dd { margin: 0; overflow-wrap: anywhere }
article { margin: 1.5rem 0 2.25rem; break-inside: avoid }
article h3 { margin: 0 0 .1rem; overflow-wrap: anywhere }
figure { margin: .5rem 0 }
.columns { display: grid; gap: 0; font-size: .8rem; line-height: 1.3; margin-bottom: .3rem }
.columns > div { padding-right: .5rem; overflow-wrap: anywhere } .columns b { display: block }
.strip img { display: block; width: 100%; height: auto }
.scale { display: flex; align-items: center; gap: .6rem; font-size: .875rem; color: var(--soft) }
.scale i { width: 10rem; height: .8rem; border-radius: 2px; background: linear-gradient(to right, """
    + _GRADIENT
    + """) }
summary { cursor: pointer; font-weight: 600; padding: .3rem 0 }
a:focus-visible, summary:focus-visible, .scroll:focus-visible { outline: 3px solid var(--link) }
@media (max-width: 40rem) { body { padding: 1.25rem .9rem 3rem } h1 { font-size: 1.4rem }
  dl { grid-template-columns: 1fr; gap: 0 } dd { margin-bottom: .4rem } }
@media print { :root { --paper: #fff; --ink: #000; --soft: #444; --line: #bbb; --band: #fff; --marked: #fff }
  body { max-width: none; padding: 0; font-size: 10pt } nav { display: none } .scroll { overflow: visible }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact } }
"""
)

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
    return f"<td>{interval.images}{left_out}</td>{drawn}" + "".join(f"<td>{e}</td>" for e in entries)


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


WORST, TYPICAL, BEST = 40, 4, 4  # strips on the page


@dataclass(frozen=True)
class CaseImage:
    """A case whose strip is at hand, and its rows, a method each."""

    strip: KeptStrip
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Chosen:
    """The cases that the page shows, none of them twice; where they are few, all are among `worst`."""

    worst: tuple[CaseImage, ...]
    typical: tuple[CaseImage, ...]
    best: tuple[CaseImage, ...]

    def all(self) -> tuple[CaseImage, ...]:
        """Every case that is shown."""
        return self.worst + self.typical + self.best


def choose(summary: Summary, rows: Sequence[Row], strips: Iterable[KeptStrip], worst: int = WORST) -> Chosen:
    """Choose by the layout's first metric of the first method, among the cases whose strips were kept."""
    metric, first = summary.metrics[0], summary.methods[0]
    sign = 1 if shown_as(metric).lower_is_better else -1
    of_case: dict[str, list[Row]] = {}
    for row in rows:
        of_case.setdefault(row.case, []).append(row)

    def badness(case: CaseImage) -> float:
        value = next((row.values.get(metric, math.nan) for row in case.rows if row.method == first), math.nan)
        return sign * value if math.isfinite(value) else -math.inf

    cases = [CaseImage(strip, tuple(of_case[strip.case])) for strip in strips if strip.case in of_case]
    cases = sorted(cases, key=lambda case: (-badness(case), case.strip.case))
    if len(cases) == summary.images <= worst:
        return Chosen(tuple(cases), (), ())
    rest, best = cases[:-BEST], cases[-BEST:][::-1]
    cell = summary.groups[0].cells[metric].get(first)
    median = sign * cell.interval.median if cell else 0.0
    typical = sorted(rest, key=lambda case: abs(badness(case) - median))[:TYPICAL]
    shown = [case for case in rest if case not in typical and badness(case) > median][:worst]
    return Chosen(tuple(shown), tuple(typical), tuple(best))


def case_article(summary: Summary, case: CaseImage, jpeg: bytes) -> Iterator[str]:
    """A case: its name, facts, strip and figures."""
    strip = case.strip
    facts = ", ".join(f"{name} {_fact(value)}" for name, value in case.rows[0].facts.items())
    person = case.rows[0].person
    yield f"<article>\n<h3>{escape(strip.case)}</h3>"
    yield f'<p class="soft">{escape(f"person {person}")}{escape("; " + facts) if facts else ""}</p>'
    yield '<div class="scroll" tabindex="0" role="region" aria-label="' + escape(strip.case) + '">'
    width = strip.size_px[0]
    yield f'<figure class="strip" style="min-width:{min(width, 560)}px;max-width:{width}px">'
    count = 1 + len(strip.methods)
    yield f'<div class="columns" style="grid-template-columns:repeat({count},1fr)">'
    above = "what was seen" if strip.has_source else "the mask"
    yield f"<div><b>{above}</b>above the truth</div>"
    by_method = {row.method: row for row in case.rows}
    for method, scale in zip(strip.methods, strip.scales, strict=True):
        yield _column_head(summary, method, scale, by_method.get(method))
    yield "</div>"
    data = base64.b64encode(jpeg).decode("ascii")
    size = f'width="{strip.size_px[0]}" height="{strip.size_px[1]}"'
    yield f'<img {size} alt="{escape(_alt(strip))}" src="data:image/jpeg;base64,{data}">'
    yield "</figure></div>"
    yield from _case_figures(summary, case.rows)
    yield "</article>"


def _fact(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def _column_head(summary: Summary, method: str, scale: float, row: Row | None) -> str:
    metric = summary.metrics[0]
    how = shown_as(metric)
    value = row.values.get(metric) if row else None
    figure = "" if value is None else f"{how.title} {value:.{how.digits}f}"
    scaled = "" if scale == 1 else f", shown times {scale:.3g}"
    return (
        f"<div><b>{dot(colour_of(summary, method))}{escape(method)}</b>"
        f"{escape(figure + scaled)}; error below</div>"
    )


def _alt(strip: KeptStrip) -> str:
    """What a strip shows, for those who do not see it."""
    first = "The picture that was seen" if strip.has_source else "The mask"
    return (
        f"{strip.case}. {first} above the truth; then, each above its error map: {', '.join(strip.methods)}."
    )


def _case_figures(summary: Summary, rows: Sequence[Row]) -> Iterator[str]:
    """Every figure of the case, folded away."""
    metrics = [name for name in summary.metrics if any(name in row.values for row in rows)]
    yield '<details><summary>All figures</summary><div class="scroll" tabindex="0" role="region" '
    yield 'aria-label="All figures"><table><thead><tr><th scope="col">method</th>'
    yield "".join(f'<th scope="col">{escape(shown_as(name).title)}</th>' for name in metrics)
    yield "</tr></thead><tbody>"
    for row in rows:
        cells = "".join(f"<td>{_value(row.values, name)}</td>" for name in metrics)
        yield f'<tr><th scope="row">{escape(row.method)}</th>{cells}</tr>'
    yield "</tbody></table></div></details>"


def _value(values: Mapping[str, float], metric: str) -> str:
    if metric not in values:
        return ""
    return f"{values[metric]:.{shown_as(metric).digits}f}" if math.isfinite(values[metric]) else "none"


@dataclass(frozen=True)
class About:
    """What was run: the command line, facerf's version, and facts such as the checkpoints' digests."""

    command: str
    version: str
    facts: Mapping[str, str]


def page(summary: Summary, about: About, chosen: Chosen, jpegs: Mapping[str, bytes]) -> str:
    """The report; `jpegs` are the chosen cases' strips by case. Equal figures give equal bytes."""
    title = f"{summary.layout.title} · facerf"
    return html_page(title, STYLE, _lines(summary, about, chosen, jpegs))


def _lines(summary: Summary, about: About, chosen: Chosen, jpegs: Mapping[str, bytes]) -> Iterator[str]:
    yield from _head(summary, about, escape(summary.layout.title))
    yield '<main>\n<h2 id="result">Result</h2>'
    yield from _results(summary)
    yield from _groups(summary)
    yield '<h2 id="metrics">All metrics</h2>'
    yield from other_metrics(summary)
    yield from _images(summary, chosen, jpegs)
    yield "</main>"


def _head(summary: Summary, about: About, title: str) -> Iterator[str]:
    people = "person" if summary.persons == 1 else "people"
    images = "picture" if summary.images == 1 else "pictures"
    methods = ", ".join(map(escape, summary.methods))
    yield f"<header>\n<h1>{title}</h1>"
    yield (
        f'<p class="lead">{summary.images} {images} of {summary.persons} {people}; '
        f"{'methods' if len(summary.methods) > 1 else 'method'}: {methods}.</p>"
    )
    yield f"<pre>{escape(about.command)}</pre>\n<dl>"
    for name, value in {"facerf": about.version, **about.facts}.items():
        yield f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>"
    yield "</dl>"
    for note in summary.layout.notes:
        yield f"<p>{escape(note)}</p>"
    links = {"result": "Result", **{f"by-{i}": f"By {f}" for i, f in enumerate(_facts(summary))}}
    links |= {"metrics": "All metrics", "worst": "Worst cases"}
    entries = "".join(f'<li><a href="#{at}">{escape(words)}</a></li>' for at, words in links.items())
    yield f'<nav aria-label="Contents"><ul>{entries}</ul></nav>\n</header>'


def _results(summary: Summary) -> Iterator[str]:
    """Every metric of the layout over all pictures."""
    against = ""
    if len(summary.methods) > 1:
        first = escape(summary.methods[0])
        against = f" Differences to {first} are on the same pictures; “won” is the share that is better."
    yield (
        '<p class="soft">Intervals are of the mean, by drawing people anew with all of their pictures '
        "(bootstrap). In the drawings the line spans 5 to 95 % of the pictures, the box their middle half; "
        f"the bar is the median, the dot the mean.{against}</p>"
    )
    for metric in summary.layout.metrics:
        if metric in summary.metrics:
            yield from metric_table(summary, metric, [summary.groups[0]])


def _facts(summary: Summary) -> list[str]:
    return [fact for fact in summary.layout.by if any(group.fact == fact for group in summary.groups)]


def _groups(summary: Summary) -> Iterator[str]:
    """The tables by each fact: the first metric open, others folded."""
    first, *others = [name for name in summary.layout.metrics if name in summary.metrics]
    for index, fact in enumerate(_facts(summary)):
        groups: list[Group] = [group for group in summary.groups if group.fact == fact]
        yield f'<h2 id="by-{index}">By {escape(fact)}</h2>'
        yield from metric_table(summary, first, groups)
        for metric in others:
            yield f"<details><summary>{escape(shown_as(metric).title)} by {escape(fact)}</summary>"
            yield from metric_table(summary, metric, groups)
            yield "</details>"


def _images(summary: Summary, chosen: Chosen, jpegs: Mapping[str, bytes]) -> Iterator[str]:
    how, first = shown_as(summary.metrics[0]), escape(summary.methods[0])
    everything = len(chosen.worst) == summary.images
    yield f'<h2 id="worst">{"All cases, the worst first" if everything else "Worst cases"}</h2>'
    if not chosen.worst:
        yield "<p>No pictures were kept.</p>"
        return
    yield (
        f"<p>By {escape(how.title)} of {first}. Pictures of a case are at the truth's exposure, the seen one "
        "at its own; a method's is times the scale that Si-MSE of linear values compares it at, where that "
        "is the metric. Grey is left out. Predictions are synthetic. images.csv has every picture's "
        "figures.</p>"
    )
    yield (
        '<p class="scale"><span>Error</span> 0 <i></i> '
        f"{ERROR_HIGHEST} or more, of display values 0 to 1, mean of the channels</p>"
    )
    yield from _articles(summary, chosen.worst, jpegs)
    for cases, title in ((chosen.typical, "Typical cases"), (chosen.best, "Best cases")):
        if cases:
            yield f"<h2>{title}</h2>"
            yield from _articles(summary, cases, jpegs)


def _articles(summary: Summary, cases: tuple[CaseImage, ...], jpegs: Mapping[str, bytes]) -> Iterator[str]:
    for case in cases:
        yield from case_article(summary, case, jpegs[case.strip.case])
