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
from facerf_cli.evaluation.report import ERROR_COLOURS, Strip, cases_to_show, draw_strip, page
from facerf_cli.evaluation.summary import summarise
from tests.evaluation.toy_protocol import LAYOUT, NOISE, comparison, evaluate

NASTY = '"><script>alert(1)</script>&'
KNOWN = (
    "id lang charset name content class style tabindex role aria-label aria-hidden focusable scope href "
    "rowspan colspan src alt width height x y x1 x2 y1 y2 cx cy r fill fill-opacity stroke stroke-width"
)
VOID = {"meta", "img", "line", "rect", "circle"}
TILE, GAP = 192, 4


class Reader(HTMLParser):
    """Checks that tags nest, and collects them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag


def rows(errors: list[float], method: str = "ours", metric: str = "si_mse") -> list[Row]:
    return [
        Row(f"case{n:03d}", f"p{n % 3}", method, {"pose": "same pose"}, {metric: error})
        for n, error in enumerate(errors)
    ]


def written(found: list[Row], kept: int | None = None, text: str = "ours") -> str:
    """The page of rows whose first cases have strips; `text` is a name and a note."""
    strips = [Strip(row.case, (text,), (1.0,), True, (392, 392), "anBlZw==") for row in found[:kept]]
    summary = summarise(replace(LAYOUT, title=text, notes=(text,), by=("pose", text)), found)
    run = {"facerf": "1.2.3", "command": text, text: text}
    return page(summary, run, found, strips)


def test_one_file_that_needs_nothing_else(tmp_path: Path) -> None:
    assert evaluate(tmp_path) == 0
    text = (tmp_path / "report.html").read_text()
    reader = Reader(text)
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


def test_nothing_becomes_markup_and_the_page_is_bounded() -> None:
    found = [
        replace(row, case=row.case + NASTY, person=NASTY, method=NASTY, facts={NASTY: NASTY})
        for row in rows([1, 2])
    ]
    reader = Reader(written(found, text=NASTY))
    assert "script" not in {tag for tag, _ in reader.tags}
    assert {name for _, attributes in reader.tags for name in attributes} <= set(KNOWN.split())
    errors = list(np.random.default_rng(0).permutation(100) / 100)
    found = rows(errors)
    shown = cases_to_show(found, "si_mse", {row.case for row in found}, most=40)
    figures = [errors[int(case.removeprefix("case"))] for case in shown]
    ranked = sorted(errors)[::-1]
    assert figures[:20] == ranked[:20] and figures == sorted(figures)[::-1] and figures[-1] == ranked[-1]
    assert max(np.diff([ranked.index(figure) for figure in figures])) <= 5  # spread over the others
    assert len(cases_to_show(found, "si_mse", ["case003", "case001"])) == 2  # not all strips are kept
    assert "Cases, the worst first" in written(found, 20)
    assert "All cases, the worst first" in written(found[:9])


def test_for_a_similarity_the_worst_are_the_lowest_and_others_do_not_count() -> None:
    found = rows([0.3, 0.1, math.nan, 0.2], metric="ssim") + rows([0, 0, 0, 0], "theirs", "ssim")
    assert cases_to_show(found, "ssim", {row.case for row in found}) == ["case001", "case003", "case000"]


def opened(strip: Strip) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(strip.jpeg))))


def test_a_strip_shows_what_was_compared() -> None:
    own = comparison("bea", 0)
    own = replace(own, predictions={"half": 0.5 * own.truth, "none": 0 * own.truth})
    strip = draw_strip(own, True, {})
    pixels = opened(strip)
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
    unscaled = draw_strip(own, False, {})
    assert unscaled.scales == (1, 1)
    assert not np.array_equal(opened(unscaled)[middle[0], middle[1] - TILE - GAP], ERROR_COLOURS[0])
    lightness = np.array(ERROR_COLOURS) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > 20).all()


def test_strips_agree_with_the_figures_about_the_scale() -> None:
    own = comparison("anna", 1)
    (good, _) = measure(own, Measures())
    strip = draw_strip(own, True, {})
    inside = own.mask > 0
    apart = strip.scales[0] * own.predictions["good"] - own.truth
    assert good.values["si_mse"] == pytest.approx(float((apart[inside] ** 2).mean()), rel=1e-4)
    assert strip.methods == tuple(NOISE)
