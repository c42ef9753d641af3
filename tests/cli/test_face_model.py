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
from tests.kinds import Patch, Said


@pytest.fixture
def imported(monkeypatch: Patch) -> MorphableModel:
    """The built-in model, which the importer returns here for any source."""
    model = load_face_model("builtin")
    monkeypatch.setattr(face_model, "import_face_model", lambda *_: model)
    return model


def test_an_imported_model_can_be_loaded_and_replaces_nothing_unasked(
    imported: MorphableModel, tmp_path: Path, capsys: Said
) -> None:
    line, target = ["face-model", "import", "ict-facekit", "anything", "-o"], tmp_path / "new" / "model.npz"
    assert main([*line, str(target)]) == 0
    out, err = capsys.readouterr()
    assert out == f"{target}\n" and imported.licence in err
    assert load_face_model(target).expression_names == imported.expression_names
    target.write_text("mine")
    assert main([*line, str(target)]) == 2
    assert "--overwrite" in capsys.readouterr().err and target.read_text() == "mine"
    assert main([*line, str(target), "--overwrite"]) == 0 and load_face_model(target).name == imported.name
    capsys.readouterr()
    assert main([*line, str(target / "model.npz")]) == 1  # below a file
    assert capsys.readouterr().err.count("\n") == 1


def test_list_names_what_is_here(
    imported: MorphableModel, tmp_path: Path, monkeypatch: Patch, capsys: Said
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


def test_show_says_what_a_model_is_and_draws_it_with_its_licence(capsys: Said, tmp_path: Path) -> None:
    assert main(["face-model", "show"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert list(lines) == ["name", "licence", "unit", "face", "head", "identity", "expression", "landmarks"]
    assert "16641 vertices" in lines["face"] and "metres" in lines["unit"] and lines["head"] == "none"
    assert lines["expression"].startswith("29 shapes: smile_left") and "17 more" in lines["expression"]
    image = tmp_path / "new" / "builtin.png"
    assert main(["face-model", "show", "builtin", "-o", str(image)]) == 0
    read = read_image(image)
    assert read.pixels.shape == (512, 1024, 3)
    assert read.metadata["facerf:face_model"] == "builtin" and read.metadata["facerf:face_model_licence"]
    assert main(["face-model", "show", "builtin", "-o", str(image)]) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_a_licence_of_many_lines_is_stamped_as_one(tmp_path: Path, capsys: Said) -> None:
    """It goes into a mesh's first line, into XML and onto the terminal."""
    path = tmp_path / "odd.npz"
    odd = replace(load_face_model(), licence="mine,\nall of it \x1b[31m\x00" + "x" * 10_000)
    save_face_model(path, odd)
    licence = load_face_model(path).licence
    assert licence.startswith("mine, all of it [31m") and len(licence) <= 2000
    assert main(["face-model", "show", str(path)]) == 0
    assert f"licence     {licence}\n" in capsys.readouterr().out


def test_fetch_prints_where_it_is(tmp_path: Path, monkeypatch: Patch, capsys: Said) -> None:
    monkeypatch.setattr(published, "fetch_face_model", lambda kind: tmp_path / f"{kind}.tar.gz")
    assert main(["face-model", "fetch", "ict-facekit"]) == 0
    out, err = capsys.readouterr()
    assert out == f"{tmp_path / 'ict-facekit.tar.gz'}\n" and "face-model import ict-facekit" in err
