"""The driver of every protocol, driven by a toy one: skips, goes on, refuses to sum up what is not whole."""

import csv
import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.options import Measures
from facerf_cli.face.morphable import load_face_model
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.run.logs import COMPOSITE_SOURCE_TYPE, configure_logging
from tests.evaluation.toy_protocol import (
    HEIGHT,
    NOISE,
    PEOPLE,
    WIDTH,
    Toy,
    comparison,
    evaluate,
    evaluation,
    items,
)

Said = pytest.CaptureFixture[str]
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


@pytest.fixture
def theirs(tmp_path: Path) -> Path:
    """The predictions of a method that knows the truth."""
    for person in PEOPLE:
        for number in range(4):
            write_exr(tmp_path / f"theirs/{person}/{number:02d}.exr", comparison(person, number).truth)
    return tmp_path / "theirs"


def taken(notes: Path) -> list[str]:
    """The items that were measured since this was asked before."""
    found = sorted(note.stem for note in notes.iterdir())
    for note in notes.iterdir():
        note.unlink()
    return found


def test_tables_csv_and_page(tmp_path: Path, capsys: Said) -> None:
    assert evaluate(tmp_path) == 0
    out = capsys.readouterr().out
    assert "12 images of 3 people" in out and "published, Table 1" in out and "\x1b" not in out
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
    for changed in ({"measures": Measures(space="display")}, {"toy": Toy(cases=3)}, {"keep_eyes": True}):
        with pytest.raises(UsageError, match="leave out --overwrite never, or give another folder"):
            evaluate(out, overwrite="never", **changed)  # type: ignore[arg-type]
    assert evaluate(out, jobs=1, dry_run=True) == 0 and (out / "summary.json").exists()
    assert evaluate(out, Toy(cases=3, notes=notes)) == 0
    assert "made from other options: --cases" in capsys.readouterr().err and taken(notes) == list(PEOPLE)
    assert json.loads((out / "summary.json").read_text())["pictures"] == 9


def test_an_item_whose_input_changed_is_measured_again(tmp_path: Path, notes: Path, theirs: Path) -> None:
    inputs = items(tmp_path / "out")
    run = evaluation(tmp_path / "out", Toy(notes=notes), inputs, compare=(theirs,))
    assert run.run() == 0 and taken(notes) == list(PEOPLE)
    assert run.run() == 0 and taken(notes) == []
    inputs[0].input_path.write_text("another anna")
    assert run.run() == 0 and taken(notes) == ["anna"]
    write_exr(theirs / "bea/01.exr", 2 * comparison("bea", 1).truth)
    assert run.run() == 0 and taken(notes) == list(PEOPLE)


def test_a_missing_prediction_is_an_error_that_names_every_case(
    tmp_path: Path, theirs: Path, capsys: Said
) -> None:
    options = {"compare": (theirs,)}
    assert evaluate(tmp_path / "out", **options) == 0
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert summary["methods"] == [*NOISE, "theirs"]
    assert summary["groups"][0]["metrics"]["si_mse"]["theirs"]["mean"] < 1e-6
    (theirs / "anna/01.exr").unlink()
    (theirs / "carl/00.exr").unlink()
    write_exr(theirs / "carl/03.exr", np.zeros((WIDTH, HEIGHT, 3), np.float32))
    capsys.readouterr()
    assert evaluate(tmp_path / "out", overwrite="always", **options) == 1
    said = capsys.readouterr().err
    assert all(part in said for part in ("case anna/01", "case carl/00", "carl/03.exr: 36 x 48 pixels"))
    assert not any((tmp_path / "out" / name).exists() for name in OUTPUTS)


def test_damaged_figures_are_named(tmp_path: Path) -> None:
    assert evaluate(tmp_path) == 0
    (tmp_path / "cases/bea.json").write_text("{}")
    with pytest.raises(InputError, match="no figures of an evaluation"):
        evaluate(tmp_path)
    assert not (tmp_path / "summary.json").exists()


def test_images_are_kept_for_other_methods_and_ours_are_marked(tmp_path: Path) -> None:
    run = replace(evaluation(tmp_path, pictures=True), face_model=load_face_model)
    assert run.run() == 0
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {"source", "truth", "mask", *NOISE}
    own = comparison("bea", 2)
    truth = read_image(tmp_path / "pictures/truth/bea/02.exr")
    np.testing.assert_allclose(truth.pixels, own.truth, rtol=1e-3, atol=1e-6)
    assert read_image(tmp_path / "pictures/source/bea/02.exr").pixels.shape == own.source.shape
    guess = read_image(tmp_path / "pictures/good/bea/02.exr").metadata
    licence = load_face_model().licence
    assert guess["facerf:synthetic"] == 1 and not any("facerf:" in name for name in truth.metadata)
    assert (guess["facerf:face_model"], guess["facerf:face_model_licence"]) == ("builtin", licence)
    assert json.loads((tmp_path / "summary.json").read_text())["face model"] == f"builtin ({licence})"
    strip = json.loads((tmp_path / "cases/bea.json").read_text())["strips"][0]["file"]
    assert b'facerf:face_model="builtin"' in (tmp_path / strip).read_bytes()
    # What was kept can be compared with itself.
    assert evaluate(tmp_path / "again", compare=(tmp_path / "pictures/truth",)) == 0


def test_strips_are_few_and_whole_and_the_work_goes_to_other_processes(tmp_path: Path) -> None:
    assert evaluate(tmp_path, Toy(cases=20)) == 0
    for person in PEOPLE:
        strips = json.loads((tmp_path / f"cases/{person}.json").read_text())["strips"]
        assert len(strips) <= 14 and {f"{person}/19", f"{person}/00"} <= {strip["case"] for strip in strips}
        assert all((tmp_path / strip["file"]).read_bytes()[:2] == b"\xff\xd8" for strip in strips)
    assert COMPOSITE_SOURCE_TYPE.encode() in (tmp_path / strips[0]["file"]).read_bytes()
    work = evaluation(tmp_path / "out")
    assert pickle.loads(pickle.dumps(work)) == work
    with pytest.raises(UsageError, match="nothing to evaluate"):
        evaluation(tmp_path, inputs=[]).run()


def test_what_was_kept_and_is_gone_is_made_again(tmp_path: Path, notes: Path) -> None:
    run = evaluation(tmp_path / "out", Toy(notes=notes), pictures=True)
    assert run.run() == 0 and taken(notes) == list(PEOPLE)
    for lost in ("strips/bea/000.jpg", "pictures/good/bea/01.exr", "cases/bea.json"):
        path = tmp_path / "out" / lost
        before = path.read_bytes()
        path.unlink()
        assert run.run() == 0 and taken(notes) == ["bea"]
        assert len(path.read_bytes()) == len(before)
