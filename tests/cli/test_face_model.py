"""`facerf face-model` from the command line."""

from dataclasses import replace
from pathlib import Path

import pytest

from facerf_cli.face.importers import resample
from facerf_cli.face.morphable import MorphableModel, load_face_model, save_face_model
from facerf_cli.main import main
from tests.kinds import Patch, Said


@pytest.fixture
def imported(monkeypatch: Patch) -> MorphableModel:
    """The built-in model, which the importer returns here for any source."""
    model = load_face_model("builtin")
    monkeypatch.setattr(resample, "import_face_model", lambda *_: model)
    return model


def test_an_imported_model_can_be_loaded_and_replaces_nothing_unasked(
    imported: MorphableModel, tmp_path: Path, capsys: Said
) -> None:
    line, target = ["face-model", "import", "anything", "-o"], tmp_path / "new" / "model.npz"
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


def test_a_licence_of_many_lines_is_stamped_as_one(tmp_path: Path) -> None:
    """It goes into a mesh's first line, into XML and onto the terminal."""
    path = tmp_path / "odd.npz"
    odd = replace(load_face_model(), licence="mine,\nall of it \x1b[31m\x00" + "x" * 10_000)
    save_face_model(path, odd)
    licence = load_face_model(path).licence
    assert licence.startswith("mine, all of it [31m") and len(licence) <= 2000
