"""`facerf face-model` from the command line."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.face import model_files as face_model
from facerf_cli.face.importers import ict as published
from facerf_cli.face.morphable import MorphableModel, load_face_model, save_face_model
from facerf_cli.files.read import read_image
from facerf_cli.main import main

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def imported(monkeypatch: pytest.MonkeyPatch) -> MorphableModel:
    """The built-in model, which the importer returns here for any source."""
    model = load_face_model("builtin")
    monkeypatch.setattr(face_model, "import_face_model", lambda *_: model)
    return model


def test_an_imported_model_can_be_loaded(imported: MorphableModel, tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "new" / "model.npz"
    assert main(["face-model", "import", "ict-facekit", "anything", "-o", str(target)]) == 0
    out, err = capsys.readouterr()
    assert out == f"{target}\n" and imported.licence in err
    assert load_face_model(target).expression_names == imported.expression_names


def test_a_file_that_is_there_is_not_replaced_unasked(
    imported: MorphableModel, tmp_path: Path, capsys: Capture
) -> None:
    target = tmp_path / "model.npz"
    target.write_text("mine")
    line = ["face-model", "import", "ict-facekit", "anything", "-o", str(target)]
    assert main(line) == 2
    assert "--overwrite" in capsys.readouterr().err and target.read_text() == "mine"
    assert main([*line, "--overwrite"]) == 0 and load_face_model(target).name == imported.name


@pytest.mark.parametrize(("line", "code", "message"), [
    (["import", "ict-facekit", "nowhere", "-o", "m.npz"], 1, "nowhere: no such file; give the ICT-FaceKit"),
    (["import", "ict-facekit", "nowhere", "-o", "m.zip"], 2, "ends in .npz"),
    (["import", "basel", "nowhere", "-o", "m.npz"], 2, "basel"),
    (["import", "ict-facekit", "nowhere"], 2, "--output"),
    (["import", "flame", "nowhere.pkl", "-o", "m.npz"], 1, "nowhere.pkl: no such file; give FLAME's .pkl"),
    (["import", "basel-2009", "nowhere.mat", "-o", "m.npz"], 1, "01_MorphableModel.mat"),
    (["import", "basel-2009", "a.mat", "-o", "m.npz", "--landmarks", "a.npy"], 1, "a .txt of 68 vertex"),
    (["import"], 2, "KIND"), ([], 2, "Missing command"),
    (["fetch", "flame"], 2, "flame"), (["show", "nowhere.npz"], 1, "nowhere.npz: no such face model"),
    (["show", "-o", "a.exr"], 2, "ends in .png"),
])  # fmt: skip
def test_a_wrong_line_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
    line: list[str],
    code: int,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["face-model", *line]) == code
    out, err = capsys.readouterr()
    assert out == "" and message in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_unwritable_output_is_one_line(imported: MorphableModel, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "file").write_text("")
    target = tmp_path / "file" / "model.npz"
    assert main(["face-model", "import", "ict-facekit", "anything", "-o", str(target)]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_list_names_what_is_here(
    imported: MorphableModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr(published, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.chdir(tmp_path)
    assert main(["face-model", "import", "flame", "anything", "-o", "mine.npz"]) == 0
    np.savez(tmp_path / "other.npz", name="no face model")
    (tmp_path / "damaged.npz").write_bytes((tmp_path / "mine.npz").read_bytes()[:-9000])
    capsys.readouterr()
    assert main(["face-model", "list"]) == 0
    builtin, mine, ict = capsys.readouterr().out.splitlines()
    assert builtin.split()[:2] == ["builtin", "builtin"] and "80 + 29" in builtin
    assert mine.startswith("mine.npz") and mine.endswith(imported.licence)
    assert ict.startswith("-") and ict.endswith("facerf face-model fetch ict-facekit")
    archive = tmp_path / "cache" / "face-models" / published.ICT_FACEKIT.name
    archive.parent.mkdir(parents=True)
    archive.write_bytes(b"")
    assert main(["face-model", "list", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["model"] for row in rows] == ["builtin", "mine.npz", "-"]
    assert rows[0]["shapes"] == "80 + 29" and rows[2]["archive"] == str(archive)


def test_show_says_what_a_model_is(capsys: Capture) -> None:
    assert main(["face-model", "show"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert list(lines) == ["name", "licence", "unit", "face", "head", "identity", "expression", "landmarks"]
    assert "16641 vertices" in lines["face"] and "metres" in lines["unit"] and lines["head"] == "none"
    assert lines["expression"].startswith("29 shapes: smile_left") and "17 more" in lines["expression"]


def test_a_licence_of_many_lines_is_stamped_as_one(tmp_path: Path, capsys: Capture) -> None:
    """It goes into a mesh's first line, into XML and onto the terminal."""
    path = tmp_path / "odd.npz"
    odd = replace(load_face_model(), licence="mine,\nall of it \x1b[31m\x00" + "x" * 10_000)
    save_face_model(path, odd)
    licence = load_face_model(path).licence
    assert licence.startswith("mine, all of it [31m") and len(licence) <= 2000
    assert main(["face-model", "show", str(path)]) == 0
    assert f"licence     {licence}\n" in capsys.readouterr().out


def test_show_draws_it_with_its_licence(tmp_path: Path, capsys: Capture) -> None:
    image = tmp_path / "new" / "builtin.png"
    assert main(["face-model", "show", "builtin", "-o", str(image)]) == 0
    read = read_image(image)
    assert read.pixels.shape == (512, 1024, 3)
    assert read.metadata["facerf:face_model"] == "builtin" and read.metadata["facerf:face_model_licence"]
    assert main(["face-model", "show", "builtin", "-o", str(image)]) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_fetch_prints_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setattr(published, "fetch_face_model", lambda kind: tmp_path / f"{kind}.tar.gz")
    assert main(["face-model", "fetch", "ict-facekit"]) == 0
    out, err = capsys.readouterr()
    assert out == f"{tmp_path / 'ict-facekit.tar.gz'}\n" and "face-model import ict-facekit" in err
