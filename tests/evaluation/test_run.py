"""The driver of every protocol, driven by a toy one: skips, goes on, refuses to sum up what is not whole."""

import base64
import csv
import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation import run
from facerf_cli.evaluation.options import Measures, NamedPath
from facerf_cli.face.morphable import load_face_model
from facerf_cli.files.image_metadata import COMPOSITE_SOURCE_TYPE
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.main import main
from facerf_cli.run.logs import configure_logging
from tests.evaluation.toy_protocol import (
    NOISE,
    PEOPLE,
    Toy,
    comparison,
    evaluate,
    evaluation,
    items,
)
from tests.kinds import Patch, Said
from tests.refusals import refused

OUTPUTS = ("summary.json", "images.csv", "report.html")


@pytest.fixture(autouse=True)
def _log() -> None:
    configure_logging()


@pytest.fixture
def notes(tmp_path: Path) -> Path:
    """A folder in which each item leaves a note that it was measured."""
    folder = tmp_path / "notes"
    folder.mkdir()
    return folder


def taken(notes: Path) -> list[str]:
    """The items that were measured since this was asked before."""
    found = sorted(note.stem for note in notes.iterdir())
    for note in notes.iterdir():
        note.unlink()
    return found


def test_tables_csv_and_page(tmp_path: Path, capsys: Said) -> None:
    assert evaluate(tmp_path) == 0
    out = capsys.readouterr().out
    assert "12 images of 3 people" in out and "\x1b" not in out
    assert all(len(line) <= 100 for line in out.splitlines())
    summary = json.loads((tmp_path / "summary.json").read_text())
    table = list(csv.DictReader((tmp_path / "images.csv").read_text().splitlines()))
    assert len(table) == 24 and {row["method"] for row in table} == set(NOISE)
    means = {m: np.mean([float(r["si_mse"]) for r in table if r["method"] == m]) for m in NOISE}
    whole = summary["groups"][0]["metrics"]["si_mse"]
    assert {m: whole[m]["mean"] for m in NOISE} == pytest.approx(means)
    assert f"{means['good']:.5f}" in out and f"{means['good']:.5f}" in (tmp_path / "report.html").read_text()
    assert table[0]["light_deg"] == "0.0" and table[0]["light_error_deg"] == "3"


def test_an_evaluation_goes_on_where_it_was_cut_off(tmp_path: Path, notes: Path, capsys: Said) -> None:
    out = tmp_path / "out"
    (notes / "bea.broken").touch()
    assert evaluate(out, Toy(notes=notes)) == 1
    said = capsys.readouterr()
    assert "bea: is broken" in said.err and "no summary is written" in said.err and not said.out
    assert not any((out / name).exists() for name in OUTPUTS)
    taken(notes)
    assert evaluate(out, Toy(notes=notes)) == 0 and taken(notes) == ["bea"]
    assert evaluate(tmp_path / "whole") == 0
    for name in OUTPUTS:
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_items_evaluated_otherwise_are_measured_again(tmp_path: Path, notes: Path, capsys: Said) -> None:
    out = tmp_path / "out"
    assert evaluate(out) == 0
    for changed in ({"measures": Measures(space="display")}, {"keep_eyes": True}):
        refused(UsageError, "remove --overwrite never", evaluate, out, overwrite="never", **changed)
    assert evaluate(out, jobs=1, dry_run=True) == 0 and (out / "summary.json").exists()
    assert evaluate(out, Toy(cases=3, notes=notes), keep_eyes=True) == 0
    assert "options changed" in capsys.readouterr().err and taken(notes) == list(PEOPLE)
    assert json.loads((out / "summary.json").read_text())["pictures"] == 9


def test_an_item_whose_input_changed_is_measured_again(tmp_path: Path, notes: Path) -> None:
    inputs = items(tmp_path / "out")
    (tmp_path / "theirs").mkdir()
    write_exr(tmp_path / "theirs/01.exr", comparison("bea", 1).truth)
    named = (NamedPath("theirs", tmp_path / "theirs"),)
    own = evaluation(tmp_path / "out", Toy(notes=notes), inputs, methods=named)
    assert own.run() == 0 and taken(notes) == list(PEOPLE)
    assert own.run() == 0 and taken(notes) == []
    inputs[0].input_path.write_text("another anna")
    assert own.run() == 0 and taken(notes) == ["anna"]
    write_exr(tmp_path / "theirs/01.exr", 2 * comparison("bea", 1).truth)
    assert own.run() == 0 and taken(notes) == list(PEOPLE)


def test_damaged_figures_are_named(tmp_path: Path) -> None:
    assert evaluate(tmp_path) == 0
    (tmp_path / "cases/bea.json").write_text("{}")
    refused(InputError, "bea.json", evaluate, tmp_path)
    assert not (tmp_path / "summary.json").exists()


def test_images_are_kept_for_other_methods_and_ours_are_marked(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(run, "networks_used", lambda options: ())
    assert evaluate(tmp_path, pictures=True, reflectance=("field",)) == 0
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {
        "cases.csv",
        "source",
        "truth",
        "mask",
        *NOISE,
    }
    own = comparison("bea", 2)
    truth = read_image(tmp_path / "pictures/truth/bea/02.exr")
    np.testing.assert_allclose(truth.pixels, own.truth, rtol=1e-3, atol=1e-6)
    assert read_image(tmp_path / "pictures/source/bea/02.exr").pixels.shape == own.source.shape
    guess = read_image(tmp_path / "pictures/good/bea/02.exr").metadata
    assert guess["facerf:synthetic"] == 1 and not any("facerf:" in name for name in truth.metadata)
    licence = load_face_model().licence
    assert (guess["facerf:face_model"], guess["facerf:face_model_licence"]) == ("builtin", licence)
    assert json.loads((tmp_path / "summary.json").read_text())["face model"] == f"builtin ({licence})"
    strip = json.loads((tmp_path / "cases/bea.json").read_text())["strips"][0]["jpeg"]
    jpeg = base64.b64decode(strip)
    assert jpeg[:2] == b"\xff\xd8" and COMPOSITE_SOURCE_TYPE.encode() in jpeg
    assert b'facerf:face_model="builtin"' in jpeg
    # What was kept is a folder of cases, with the facts of this run.
    line = ["evaluate", "compare", str(tmp_path / "pictures"), "--method", str(tmp_path / "pictures/good")]
    assert main([*line, "-o", str(tmp_path / "again")]) == 0
    before, again = (json.loads((tmp_path / f"{f}summary.json").read_text()) for f in ("", "again/"))
    old, new = (one["groups"][0]["metrics"]["ssim"]["good"]["mean"] for one in (before, again))
    assert old == pytest.approx(new, abs=1e-4) and {one["fact"] for one in again["groups"]} >= {"pose"}


def test_strips_are_few_and_whole_and_the_work_goes_to_other_processes(tmp_path: Path) -> None:
    assert evaluate(tmp_path, Toy(cases=20)) == 0
    for person in PEOPLE:
        strips = json.loads((tmp_path / f"cases/{person}.json").read_text())["strips"]
        assert len(strips) <= 14 and {f"{person}/19", f"{person}/00"} <= {strip["case"] for strip in strips}
    work = evaluation(tmp_path / "out")
    assert pickle.loads(pickle.dumps(work)) == work
    refused(UsageError, "nothing to evaluate", evaluation(tmp_path, inputs=[]).run)


def test_what_was_kept_and_is_gone_is_made_again(tmp_path: Path, notes: Path) -> None:
    own = evaluation(tmp_path / "out", Toy(notes=notes), pictures=True)
    assert own.run() == 0 and taken(notes) == list(PEOPLE)
    for lost in ("pictures/good/bea/01.exr", "cases/bea.json"):
        path = tmp_path / "out" / lost
        before = path.read_bytes()
        path.unlink()
        assert own.run() == 0 and taken(notes) == ["bea"]
        assert len(path.read_bytes()) == len(before)
