"""The report's pictures: the worst cases first, then some that are typical and the best."""

import base64
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from facerf_cli.evaluation.case_files import KeptStrip
from facerf_cli.evaluation.measure import Row
from facerf_cli.evaluation.page_tables import colour_of, dot
from facerf_cli.evaluation.summary import Summary, shown_as

WORST, TYPICAL, BEST = 40, 4, 4  # strips on the page


@dataclass(frozen=True)
class CasePicture:
    """A case whose strip is at hand, and its rows, a method each."""

    strip: KeptStrip
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Chosen:
    """The cases that the page shows, none of them twice; where they are few, all are among `worst`."""

    worst: tuple[CasePicture, ...]
    typical: tuple[CasePicture, ...]
    best: tuple[CasePicture, ...]

    def all(self) -> tuple[CasePicture, ...]:
        """Every case that is shown."""
        return self.worst + self.typical + self.best


def choose(summary: Summary, rows: Sequence[Row], strips: Iterable[KeptStrip], worst: int = WORST) -> Chosen:
    """Choose by the layout's first metric of the first method, among the cases whose strips were kept."""
    metric, first = summary.metrics[0], summary.methods[0]
    sign = 1 if shown_as(metric).lower_is_better else -1
    of_case: dict[str, list[Row]] = {}
    for row in rows:
        of_case.setdefault(row.case, []).append(row)

    def badness(case: CasePicture) -> float:
        value = next((row.values.get(metric, math.nan) for row in case.rows if row.method == first), math.nan)
        return sign * value if math.isfinite(value) else -math.inf

    cases = [CasePicture(strip, tuple(of_case[strip.case])) for strip in strips if strip.case in of_case]
    cases = sorted(cases, key=lambda case: (-badness(case), case.strip.case))
    if len(cases) == summary.pictures <= worst:
        return Chosen(tuple(cases), (), ())
    rest, best = cases[:-BEST], cases[-BEST:][::-1]
    cell = summary.groups[0].cells[metric].get(first)
    median = sign * cell.interval.median if cell else 0.0
    typical = sorted(rest, key=lambda case: abs(badness(case) - median))[:TYPICAL]
    shown = [case for case in rest if case not in typical and badness(case) > median][:worst]
    return Chosen(tuple(shown), tuple(typical), tuple(best))


def case_article(summary: Summary, case: CasePicture, jpeg: bytes) -> Iterator[str]:
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
    yield from _figures(summary, case.rows)
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


def _figures(summary: Summary, rows: Sequence[Row]) -> Iterator[str]:
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
