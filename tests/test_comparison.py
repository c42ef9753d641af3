"""The comparison in the docs: no empty cell, no source that is not listed, own cells that are true."""

import re
from pathlib import Path

import pytest
import typer.main

from facerf_cli.batch.inputs import PHOTO_SUFFIXES
from facerf_cli.files.read import PHOTO_LIMIT_PX
from facerf_cli.main import app

PAGE = (Path(__file__).parents[1] / "docs/comparison.md").read_text()
TABLE, _, SOURCES = PAGE.partition("## Sources")


def rows(text: str) -> list[list[str]]:
    """The cells of a table's rows, without its head."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


@pytest.mark.parametrize("row", rows(TABLE), ids=lambda row: row[0])
def test_no_cell_is_empty_and_each_absence_has_its_reason(row: list[str]) -> None:
    assert len(row) == 7 and all(row)
    for cell in row:
        assert not re.search(r"does not apply(?!:)", cell, re.I)
        assert not re.search(r"not documented(?! \(|; )", cell)


def test_every_source_is_listed_and_used() -> None:
    inside = [
        word
        for words in re.findall(r"[\[(]((?:[A-Z][a-h](?:, )?)+)[\])]", TABLE)
        for word in words.split(", ")
    ]
    assert set(inside) == {row[0] for row in rows(SOURCES)}


def test_the_options_and_limits_of_facerf_are_those_of_the_code() -> None:
    verbs = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    options = {name for verb in verbs.values() for option in verb.params for name in option.opts} | {
        "--log-json"
    }
    own = " ".join(row[1] for row in rows(TABLE))
    assert set(re.findall(r"--[a-z-]+", own)) <= options
    read = next(row[1] for row in rows(TABLE) if row[0] == "formats read")
    short = {".jpg", ".jpeg", ".jpe", ".jfif", ".tif"}  # other spellings of JPEG and TIFF
    assert {f".{name.lower()}" for name in read.split(", ")} == (PHOTO_SUFFIXES - short) | {".jpeg"}
    assert f"{PHOTO_LIMIT_PX // 10**6} megapixels" in own
