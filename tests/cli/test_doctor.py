"""`facerf doctor` shows the installation, and fails if a part is missing."""

import json
from pathlib import Path

import pytest
from safetensors.numpy import save_file

from facerf_cli import __version__
from facerf_cli.cli.doctor import MISSING
from facerf_cli.cli.items import doctor_facts as doctor
from facerf_cli.main import main


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    path = tmp_path / "mine.safetensors"
    facts = {"licence": "MIT", "provenance": {"heads": "240 heads"}}
    save_file({}, path, {"format": "facerf-checkpoint-1", "facerf": json.dumps(facts)})
    return path


def test_one_screen_with_versions_licences_and_configuration(
    checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "--device", "cpu", "--checkpoint", str(checkpoint)]) == 0
    out = capsys.readouterr().out
    assert len(out.splitlines()) <= 30 and max(map(len, out.splitlines())) <= 100
    words = " ".join(out.split())
    assert f"version {__version__}" in words and "torch uses cpu" in words and "ocio://default" in words
    assert "excludes commercial use" in words and "mine, MIT" in words and "240 heads" in words
    assert "pytest" not in words  # developers' tools


def test_the_screen_leaves_nested_provenance_to_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "trained.safetensors"
    facts = {"licence": "MIT", "provenance": {"heads": "9 heads", "started_from": {"heads": "7 heads"}}}
    save_file({}, path, {"format": "facerf-checkpoint-1", "facerf": json.dumps(facts)})
    assert main(["doctor", "--checkpoint", str(path)]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "9 heads" in words and "7 heads" not in words and "{" not in words
    assert main(["doctor", "--json", "--checkpoint", str(path)]) == 0
    assert json.loads(capsys.readouterr().out)["assets"]["checkpoint"]["started_from"]["heads"] == "7 heads"


def test_the_same_as_json(checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json", "--checkpoint", str(checkpoint)]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["assets"]["checkpoint"]["licence"] == "MIT" and "torch" in facts["packages"]


def test_what_is_missing_or_broken_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--checkpoint", str(tmp_path / "gone.safetensors")]) == 1
    assert "MISSING" in capsys.readouterr().out
    save_file({}, tmp_path / "list.safetensors", {"format": "facerf-checkpoint-1", "facerf": "[]"})
    assert main(["doctor", "--checkpoint", str(tmp_path / "list.safetensors")]) == 1
    assert "its metadata is not a JSON object" in " ".join(capsys.readouterr().out.split())
    (tmp_path / "text.safetensors").write_text("no checkpoint")
    assert main(["doctor", "--checkpoint", str(tmp_path / "text.safetensors")]) == 1
    assert "not a facerf checkpoint" in " ".join(capsys.readouterr().out.split())
    assert doctor._face_model(tmp_path / "text.safetensors")["name"].startswith(MISSING)


def test_an_ocio_configuration_that_is_not_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("OCIO", "/nowhere/config.ocio")
    assert main(["doctor"]) == 1
    assert "$OCIO is '/nowhere/config.ocio'" in capsys.readouterr().err
