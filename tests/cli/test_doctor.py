"""`facerf doctor` shows the installation, and fails if a part is missing."""

import json
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from safetensors.numpy import save_file

from facerf_cli._version import __version__
from facerf_cli.cli.doctor import EXTRAS
from facerf_cli.files.texts import file_sha256
from facerf_cli.main import main
from tests.kinds import Patch, Said

ROOT = Path(__file__).parents[2]


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    path = tmp_path / "mine.safetensors"
    facts = {"licence": "MIT", "networks": {"reflectance": {}}}
    save_file({}, path, {"format": "facerf-checkpoint-1", "facerf": json.dumps(facts)})
    return path


def test_text_and_json_have_versions_licences_and_the_cache(checkpoint: Path, capsys: Said) -> None:
    line = ["doctor", "--device", "cpu", "--checkpoint", str(checkpoint)]
    assert main(line) == 0
    out = capsys.readouterr().out
    assert f"  version: {__version__}\n" in out and "  name: cpu (" in out and "cache\n  folder: " in out
    assert "  mediapipe: " in out and "Apache-2.0" in out
    assert "  pytest: " not in out and "  dev: " not in out  # developers' tools
    assert "{" not in out and "None" not in out
    assert main([*line, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    served = {"file": str(checkpoint), "sha256": file_sha256(checkpoint), "licence": "MIT"}
    assert (
        facts["networks"]["reflectance"] == served and f"  reflectance: {', '.join(served.values())}" in out
    )
    assert facts["networks"]["parsing"]["file"] == "parsing.safetensors" and "torch" in facts["packages"]


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
    lacking |= {"tensorboard", "ruff"}
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "  tensorboard: not installed; pip install 'facerf[tensorboard]' adds " in out
    assert "  ray: ray 1.2, for `--ray`, on clusters" in out and "ruff" not in out
    lacking.add("torch")
    assert main(["doctor"]) == 1
    assert "  torch: MISSING; pip install 'torch>=2.5'\n" in capsys.readouterr().out
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
    with monkeypatch.context() as without:
        without.setattr("facerf_cli.network.stored_graph.ASSET", tmp_path / "gone.onnx")
        assert main(["doctor"]) == 1 and "gone.onnx" in capsys.readouterr().out
