"""The report of an evaluation: one HTML file that needs nothing else, no network and no script."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import escape

from facerf_cli.evaluation.page_cases import CasePicture, Chosen, case_article
from facerf_cli.evaluation.page_style import STYLE
from facerf_cli.evaluation.page_tables import metric_table, other_metrics
from facerf_cli.evaluation.strips import ERROR_HIGHEST
from facerf_cli.evaluation.summary import Group, Summary, shown_as
from facerf_cli.files.html import html_page


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
    yield from _pictures(summary, chosen, jpegs)
    yield "</main>"


def _head(summary: Summary, about: About, title: str) -> Iterator[str]:
    people = "person" if summary.persons == 1 else "people"
    pictures = "picture" if summary.pictures == 1 else "pictures"
    methods = ", ".join(map(escape, summary.methods))
    yield f"<header>\n<h1>{title}</h1>"
    yield (
        f'<p class="lead">{summary.pictures} {pictures} of {summary.persons} {people}; '
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


def _pictures(summary: Summary, chosen: Chosen, jpegs: Mapping[str, bytes]) -> Iterator[str]:
    how, first = shown_as(summary.metrics[0]), escape(summary.methods[0])
    everything = len(chosen.worst) == summary.pictures
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


def _articles(summary: Summary, cases: tuple[CasePicture, ...], jpegs: Mapping[str, bytes]) -> Iterator[str]:
    for case in cases:
        yield from case_article(summary, case, jpegs[case.strip.case])
