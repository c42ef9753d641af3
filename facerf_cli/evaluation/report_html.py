"""The report of an evaluation: one HTML file that loads nothing, without scripts; worst cases first."""

import base64
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from facerf_cli.evaluation.case_files import KeptStrip
from facerf_cli.evaluation.measure import Row
from facerf_cli.evaluation.report_tables import all_metrics_table, colour_of, dot, metric_table
from facerf_cli.evaluation.strips import ERROR_COLOURS, ERROR_HIGHEST
from facerf_cli.evaluation.summary import Group, Summary, metric_named
from facerf_cli.files.drawings import html_page

WORST, TYPICAL, BEST = 40, 4, 4  # strips on the page
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
td.plot { width: 22%; min-width: 8.5rem; padding: 0 .7rem }
td.plot svg { display: block; width: 100%; height: 1.6rem; overflow: visible }
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


@dataclass(frozen=True)
class CaseImage:
    """A case with its strip and its rows, one a method."""

    strip: KeptStrip
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Chosen:
    """The cases on the page, each once; if they are few, all are in `worst`."""

    worst: tuple[CaseImage, ...]
    typical: tuple[CaseImage, ...]
    best: tuple[CaseImage, ...]

    def all(self) -> tuple[CaseImage, ...]:
        """All cases on the page."""
        return self.worst + self.typical + self.best


def choose(summary: Summary, rows: Sequence[Row], strips: Iterable[KeptStrip], worst: int = WORST) -> Chosen:
    """Choose among the cases whose strips were kept, by the layout's first metric of the first method."""
    metric, first = summary.metrics[0], summary.methods[0]
    sign = 1 if metric_named(metric).lower_is_better else -1
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
    """A case: its name, facts, strip (the bytes of a JPEG) and figures."""
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
    above = "source" if strip.has_source else "mask"
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
    how = metric_named(metric)
    value = row.values.get(metric) if row else None
    figure = "" if value is None else f"{how.title} {value:.{how.digits}f}"
    scaled = "" if scale == 1 else f", shown times {scale:.3g}"
    return (
        f"<div><b>{dot(colour_of(summary, method))}{escape(method)}</b>"
        f"{escape(figure + scaled)}; error below</div>"
    )


def _alt(strip: KeptStrip) -> str:
    """The text in place of a strip's image."""
    first = "The source" if strip.has_source else "The mask"
    return f"{strip.case}. {first} above the truth; then, above their errors: {', '.join(strip.methods)}."


def _case_figures(summary: Summary, rows: Sequence[Row]) -> Iterator[str]:
    """All figures of the case, folded."""
    metrics = [name for name in summary.metrics if any(name in row.values for row in rows)]
    yield '<details><summary>All figures</summary><div class="scroll" tabindex="0" role="region" '
    yield 'aria-label="All figures"><table><thead><tr><th scope="col">method</th>'
    yield "".join(f'<th scope="col">{escape(metric_named(name).title)}</th>' for name in metrics)
    yield "</tr></thead><tbody>"
    for row in rows:
        cells = "".join(f"<td>{_value(row.values, name)}</td>" for name in metrics)
        yield f'<tr><th scope="row">{escape(row.method)}</th>{cells}</tr>'
    yield "</tbody></table></div></details>"


def _value(values: Mapping[str, float], metric: str) -> str:
    if metric not in values:
        return ""
    return f"{values[metric]:.{metric_named(metric).digits}f}" if math.isfinite(values[metric]) else "none"


@dataclass(frozen=True)
class About:
    """The run: its command line, facerf's version, and facts such as the checkpoints' digests."""

    command: str
    version: str
    facts: Mapping[str, str]


def page(summary: Summary, about: About, chosen: Chosen, jpegs: Mapping[str, bytes]) -> str:
    """Write the report; `jpegs` are the chosen cases' strips by case. Equal figures give equal bytes."""
    title = f"{summary.layout.title} · facerf"
    return html_page(title, STYLE, _lines(summary, about, chosen, jpegs))


def _lines(summary: Summary, about: About, chosen: Chosen, jpegs: Mapping[str, bytes]) -> Iterator[str]:
    yield from _head(summary, about, escape(summary.layout.title))
    yield '<main>\n<h2 id="result">Result</h2>'
    yield from _results(summary)
    yield from _groups(summary)
    yield '<h2 id="metrics">All metrics</h2>'
    yield from all_metrics_table(summary)
    yield from _images(summary, chosen, jpegs)
    yield "</main>"


def _head(summary: Summary, about: About, title: str) -> Iterator[str]:
    people = "person" if summary.persons == 1 else "people"
    images = "image" if summary.images == 1 else "images"
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
    """Every metric of the layout over all images."""
    against = ""
    if len(summary.methods) > 1:
        first = escape(summary.methods[0])
        against = (
            f" Differences to {first} are over the same images; “won” is the share of images on which the "
            "method is better."
        )
    yield (
        '<p class="soft">Intervals are of the mean, by resampling people with all of their images '
        "(bootstrap). In the plots the line spans 5 to 95 % of the images, the box the middle half; the bar "
        f"is the median, the dot the mean.{against}</p>"
    )
    for metric in summary.layout.metrics:
        if metric in summary.metrics:
            yield from metric_table(summary, metric, [summary.groups[0]])


def _facts(summary: Summary) -> list[str]:
    return [fact for fact in summary.layout.by if any(group.fact == fact for group in summary.groups)]


def _groups(summary: Summary) -> Iterator[str]:
    """The tables by each fact: the first metric unfolded, the others folded."""
    first, *others = [name for name in summary.layout.metrics if name in summary.metrics]
    for index, fact in enumerate(_facts(summary)):
        groups: list[Group] = [group for group in summary.groups if group.fact == fact]
        yield f'<h2 id="by-{index}">By {escape(fact)}</h2>'
        yield from metric_table(summary, first, groups)
        for metric in others:
            yield f"<details><summary>{escape(metric_named(metric).title)} by {escape(fact)}</summary>"
            yield from metric_table(summary, metric, groups)
            yield "</details>"


def _images(summary: Summary, chosen: Chosen, jpegs: Mapping[str, bytes]) -> Iterator[str]:
    how, first = metric_named(summary.metrics[0]), escape(summary.methods[0])
    everything = len(chosen.worst) == summary.images
    yield f'<h2 id="worst">{"All cases, the worst first" if everything else "Worst cases"}</h2>'
    if not chosen.worst:
        yield "<p>No images were kept.</p>"
        return
    yield (
        f"<p>Sorted by {escape(how.title)} of {first}. Truth and methods are at the truth's exposure, the "
        "source at its own. If the metric is Si-MSE of linear values, a method's image is multiplied by the "
        "scale that Si-MSE finds. Grey is outside the mask. Predictions are synthetic. images.csv has the "
        "figures of every image.</p>"
    )
    yield (
        '<p class="scale"><span>Error</span> 0 <i></i> '
        f"{ERROR_HIGHEST} or more, in display values 0 to 1, mean of the channels</p>"
    )
    yield from _articles(summary, chosen.worst, jpegs)
    for cases, title in ((chosen.typical, "Typical cases"), (chosen.best, "Best cases")):
        if cases:
            yield f"<h2>{title}</h2>"
            yield from _articles(summary, cases, jpegs)


def _articles(summary: Summary, cases: tuple[CaseImage, ...], jpegs: Mapping[str, bytes]) -> Iterator[str]:
    for case in cases:
        yield from case_article(summary, case, jpegs[case.strip.case])
