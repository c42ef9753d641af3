"""The report: one file, nothing of a name or a command becomes markup, worst cases first."""

import base64
import io
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from facerf_cli.evaluation.measure import Row, measure
from facerf_cli.evaluation.options import Measures
from facerf_cli.evaluation.report import (
    BEST,
    ERROR_COLOURS,
    ERROR_HIGHEST,
    TYPICAL,
    WORST,
    About,
    Chosen,
    Strip,
    cases_to_keep,
    choose,
    draw_strip,
    page,
)
from facerf_cli.evaluation.summary import Summary, summarise
from tests.evaluation.toy_protocol import LAYOUT, NOISE, comparison, evaluate

NASTY = '"><script>alert(1)</script>&'
KNOWN = (
    "id lang charset name content class style tabindex role aria-label aria-hidden focusable scope href "
    "rowspan colspan src alt width height x y x1 x2 y1 y2 cx cy r fill fill-opacity stroke stroke-width"
)
VOID = {"meta", "img", "line", "rect", "circle"}
TILE, GAP = 192, 4


class Reader(HTMLParser):
    """Checks that tags nest, and collects them and their texts."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def read(text: str) -> Reader:
    reader = Reader()
    reader.feed(text)
    assert not reader.open
    return reader


def rows(errors: list[float], method: str = "ours") -> list[Row]:
    return [
        Row(f"case{n:03d}", f"p{n % 3}", method, {"pose": "same pose"}, {"si_mse": error})
        for n, error in enumerate(errors)
    ]


def strips(found: list[Row]) -> list[Strip]:
    return [
        Strip(row.case, f"strips/{row.case}.jpg", ("ours",), 0.0, (1.0,), True, (392, 392)) for row in found
    ]


def write(summary: Summary, chosen: Chosen, command: str = "facerf evaluate") -> str:
    jpegs = {case.strip.case: f"jpeg of {case.strip.case}".encode() for case in chosen.all()}
    return page(
        summary,
        About(command, "1.2.3", {"Network <x>": {"file": "x", "sha256": "abc"}}, {"face model": "builtin"}),
        chosen,
        jpegs,
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    assert evaluate(folder) == 0
    return folder / "report.html"


def test_one_file_that_needs_nothing_else(report: Path) -> None:
    text = report.read_text()
    reader = read(text)
    tags = [tag for tag, _ in reader.tags]
    assert not {"script", "link", "iframe", "object"} & set(tags)
    assert not re.search(r"(?:src|href)=\"(?!data:image/jpeg;base64,|#)", text) and "url(" not in text
    found = [attributes for tag, attributes in reader.tags if tag == "img"]
    assert len(found) == 12
    for tag in found:
        image = Image.open(io.BytesIO(base64.b64decode(tag["src"].split(",")[1])))
        assert (image.width, image.height) == (int(tag["width"]), int(tag["height"]))
        assert "above the truth" in tag["alt"] and "good, bad <i>" in tag["alt"]
    ids = {attributes["id"] for _, attributes in reader.tags if "id" in attributes}
    assert {attributes["href"][1:] for tag, attributes in reader.tags if tag == "a"} == ids


def test_nothing_becomes_markup() -> None:
    found = [
        replace(row, case=row.case + NASTY, person=NASTY, method=NASTY, facts={NASTY: NASTY})
        for row in rows([1, 2])
    ]
    layout = replace(LAYOUT, title=NASTY, notes=(NASTY,), by=(NASTY,))
    summary = summarise(layout, found)
    kept = [replace(strip, methods=(NASTY,)) for strip in strips(found)]
    reader = read(write(summary, choose(summary, found, kept), NASTY))
    assert "script" not in {tag for tag, _ in reader.tags}
    assert {name for _, attributes in reader.tags for name in attributes} <= set(KNOWN.split())


def test_the_worst_come_first_and_the_page_is_bounded() -> None:
    errors = list(np.random.default_rng(0).permutation(100) / 100)
    found = rows(errors)
    chosen = choose(summarise(LAYOUT, found), found, strips(found))
    shown = [case.rows[0].values["si_mse"] for case in chosen.all()]
    assert shown[:WORST] == sorted(errors)[::-1][:WORST]
    assert shown[-BEST:] == sorted(errors)[:BEST]
    assert [round(abs(x - 0.495), 3) for x in shown[WORST:-BEST]] == [0.005, 0.005, 0.015, 0.015]
    assert len(shown) == WORST + TYPICAL + BEST
    few = choose(summarise(LAYOUT, found[:9]), found[:9], strips(found[:9]))
    assert len(few.worst) == 9 and not few.best
    some = choose(summarise(LAYOUT, found), found, strips(found[:20]))  # not all strips are kept
    assert (len(some.typical), len(some.best)) == (4, 4)
    assert some.worst and all(case.rows[0].values["si_mse"] > np.median(errors) for case in some.worst)
    assert "Worst cases" in write(summarise(LAYOUT, found), some)
    assert "All cases, the worst first" in write(summarise(LAYOUT, found[:9]), few)


def test_an_item_keeps_the_strips_of_few_cases() -> None:
    errors = [float(n) for n in range(30)]
    found = [*rows(errors), *rows(errors[::-1], "theirs")]
    kept = [int(case[-3:]) for case in cases_to_keep(found, "si_mse")]
    assert kept == [0, 1, 14, 15, *range(22, 30)]  # theirs are worst where ours are best
    assert cases_to_keep(rows([math.nan, 1.0]), "si_mse") == ["case001"]


def test_for_a_similarity_the_worst_are_the_lowest() -> None:
    found = [replace(row, values={"ssim": row.values["si_mse"]}) for row in rows([0.3, 0.1, 0.2])]
    summary = summarise(replace(LAYOUT, metrics=("ssim",)), found)
    chosen = choose(summary, found, strips(found))
    assert [case.rows[0].values["ssim"] for case in chosen.worst] == [0.1, 0.2, 0.3]


def test_a_strip_shows_what_was_compared() -> None:
    own = comparison("bea", 0)
    own = replace(own, predictions={"half": 0.5 * own.truth, "none": 0 * own.truth})
    strip, pixels = draw_strip(own, scaled=True)
    height = round(TILE * own.truth.shape[0] / own.truth.shape[1])
    assert pixels.shape == (2 * (height + GAP) - GAP, 3 * (TILE + GAP) - GAP, 3)
    assert strip.scales[0] == pytest.approx(2) and strip.scales[1] == 0
    middle = (height + GAP + height // 2, 3 * (TILE + GAP) - GAP - TILE // 2)  # of the last error map
    half = pixels[middle[0], middle[1] - TILE - GAP]
    np.testing.assert_array_equal(half, ERROR_COLOURS[0])  # at its scale, nothing is wrong
    np.testing.assert_array_equal(pixels[middle], ERROR_COLOURS[-1])  # black is wrong by more than the most
    truth = pixels[height + GAP + height // 2, TILE // 2]
    shown = pixels[height // 2, TILE + GAP + TILE // 2]
    np.testing.assert_allclose(shown, truth, atol=1)
    unscaled, plain = draw_strip(own, scaled=False)
    assert unscaled.scales == (1, 1)
    assert not np.array_equal(plain[middle[0], middle[1] - TILE - GAP], ERROR_COLOURS[0])


def test_error_colours_rise_in_lightness_and_reach_their_end() -> None:
    lightness = np.array(ERROR_COLOURS) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > 20).all() and ERROR_HIGHEST == 0.2


def test_strips_agree_with_the_figures_about_the_scale() -> None:
    own = comparison("anna", 1)
    (good, _) = measure(own, Measures())
    strip, _ = draw_strip(own, scaled=True)
    inside = own.mask > 0
    apart = strip.scales[0] * own.predictions["good"] - own.truth
    assert good.values["si_mse"] == pytest.approx(float((apart[inside] ** 2).mean()), rel=1e-4)
    assert strip.methods == tuple(NOISE)
