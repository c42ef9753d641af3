"""`facerf doctor` shows the installation, and fails if a part is missing."""

import json
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from safetensors.numpy import save_file

from facerf_cli._version import __version__
from facerf_cli.files.texts import file_sha256
from facerf_cli.main import main
from facerf_cli.work import doctor_facts as doctor
from facerf_cli.work.installed import EXTRAS, MISSING
from tests.kinds import Patch, Said

ROOT = Path(__file__).parents[2]


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    path = tmp_path / "mine.safetensors"
    facts = {"licence": "MIT", "provenance": {"heads": "240 heads"}, "networks": {"reflectance": {}}}
    save_file({}, path, {"format": "facerf-checkpoint-1", "facerf": json.dumps(facts)})
    return path


def test_one_screen_with_versions_licences_and_configuration(checkpoint: Path, capsys: Said) -> None:
    assert main(["doctor", "--device", "cpu", "--checkpoint", str(checkpoint)]) == 0
    out = capsys.readouterr().out
    assert len(out.splitlines()) <= 31 and max(map(len, out.splitlines())) <= 100
    words = " ".join(out.split())
    assert f"facerf {__version__}, Python" in words and "device cpu" in words and "ocio://default" in words
    assert "Apache-2.0" in words and "mine: MIT; 240 heads" in words
    assert "pytest" not in words and "nbclient" not in words  # developers' tools
    assert "{" not in words and "None" not in words


def test_the_screen_has_what_matters_and_json_all(tmp_path: Path, capsys: Said, checkpoint: Path) -> None:
    path = tmp_path / "trained.safetensors"
    facts = {
        "licence": "MIT",
        "provenance": {"heads": "9 heads", "started_from": {"heads": "7 heads"}},
        "networks": {"reflectance": {}},
    }
    save_file({}, path, {"format": "facerf-checkpoint-1", "facerf": json.dumps(facts)})
    assert main(["doctor", "--checkpoint", str(path)]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "9 heads" in words and "7 heads" not in words and "{" not in words
    assert main(["doctor", "--json", "--checkpoint", str(path)]) == 0
    assert json.loads(capsys.readouterr().out)["assets"]["checkpoint"]["started_from"]["heads"] == "7 heads"
    assert main(["doctor", "--json", "--checkpoint", str(checkpoint)]) == 0
    facts = json.loads(capsys.readouterr().out)
    served = facts["networks"]["reflectance"]
    assert served == {"file": str(checkpoint), "sha256": file_sha256(checkpoint)}
    assert facts["networks"]["parsing"]["file"] == "parsing.safetensors"
    assert facts["assets"]["checkpoint"]["licence"] == "MIT" and "torch" in facts["packages"]


@pytest.fixture
def lacking(monkeypatch: Patch) -> set[str]:
    """Packages that seem not to be installed, in what seems to be this version's metadata."""
    absent: set[str] = set()

    def version(package: str) -> str:
        if package in absent:
            raise metadata.PackageNotFoundError(package)
        return "1.2"

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].items()
    listed = [*project["dependencies"]]
    listed += [f'{line}; extra == "{name}"' for name, lines in extras for line in lines]
    monkeypatch.setattr(metadata, "requires", lambda name: listed)
    monkeypatch.setattr(metadata, "version", version)
    return absent


def test_extras_and_packages_that_lack_are_named_with_their_commands(lacking: set[str], capsys: Said) -> None:
    lacking |= {"mitsuba", "ruff"}
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "synth        not installed; pip install 'facerf[synth]' adds `--renderer" in out
    assert "ray          ray 1.2, for `--ray`, on clusters" in out and "ruff" not in out
    assert len(out.splitlines()) <= 31
    lacking.add("torch")
    assert main(["doctor"]) == 1
    words = " ".join(capsys.readouterr().out.split())
    assert "torch MISSING" in words and "to add what is missing: pip install 'torch>=2.5'" in words
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(EXTRAS) == set(extras) - {"dev", "docs"}


def test_what_is_missing_or_broken_fails(tmp_path: Path, capsys: Said, monkeypatch: Patch) -> None:
    assert main(["doctor", "--checkpoint", str(tmp_path / "gone.safetensors")]) == 1
    assert "MISSING" in capsys.readouterr().out
    save_file({}, tmp_path / "list.safetensors", {"format": "facerf-checkpoint-1", "facerf": "[]"})
    assert main(["doctor", "--checkpoint", str(tmp_path / "list.safetensors")]) == 1
    assert "its metadata is not a JSON object" in " ".join(capsys.readouterr().out.split())
    (tmp_path / "text.safetensors").write_text("no checkpoint")
    assert main(["doctor", "--checkpoint", str(tmp_path / "text.safetensors")]) == 1
    assert "not a facerf checkpoint" in " ".join(capsys.readouterr().out.split())
    assert doctor._face_model(tmp_path / "text.safetensors")["name"].startswith(MISSING)
    monkeypatch.setenv("OCIO", "/nowhere/config.ocio")
    assert main(["doctor"]) == 1
    assert "$OCIO is '/nowhere/config.ocio'" in capsys.readouterr().err
