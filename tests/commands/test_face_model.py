"""`facerf face-model import` from the command line."""

from pathlib import Path

import pytest

from facerf_cli.face.importers import importing
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.main import main

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def imported(monkeypatch: pytest.MonkeyPatch) -> MorphableModel:
    """What the importer gives here, whatever it is given: the built-in model."""
    model = load_face_model("builtin")
    monkeypatch.setattr(importing, "import_face_model", lambda *_: model)
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
    (["import", "ict-facekit", "nowhere", "-o", "m.npz"], 1, "nowhere: give the ICT-FaceKit folder"),
    (["import", "ict-facekit", "nowhere", "-o", "m.zip"], 2, "ends in .npz"),
    (["import", "basel", "nowhere", "-o", "m.npz"], 2, "basel"),
    (["import", "ict-facekit", "nowhere"], 2, "--output"),
    (["import"], 2, "KIND"), ([], 2, "Missing command"),
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
