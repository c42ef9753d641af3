"""Which file serves each network."""

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from facerf_cli.errors import InputError, UsageError
from facerf_cli.main import main
from facerf_cli.network.files import FORMAT, SHIPPED, checkpoint_file, serving_files
from tests.kinds import Said
from tests.refusals import refused


def checkpoint(path: Path, *networks: str, trained: tuple[str, ...] = ()) -> Path:
    """A checkpoint whose header says which networks it holds, and which of them its last training trained."""
    facts = {"networks": {name: {} for name in networks}, "training": [{"networks": ["geometry"]}]}
    facts["training"] = [*facts["training"], {"networks": trained}] if trained else []
    save_file({"x": np.zeros(1, np.float32)}, path, {"format": FORMAT, "facerf": json.dumps(facts)})
    return path


def test_each_file_counts_for_what_its_last_training_trained(tmp_path: Path) -> None:
    first = checkpoint(tmp_path / "a.st", "reflectance", "geometry", trained=("reflectance",))
    second = checkpoint(tmp_path / "b.st", "reflectance", "portrait", trained=("portrait",))
    found = serving_files([second, first])
    assert found == SHIPPED | {"reflectance": first, "geometry": first, "portrait": second}
    third = checkpoint(tmp_path / "c.st", "geometry", trained=("geometry",))
    assert serving_files([first, second, third])["geometry"] == third  # before the copy of the first
    silent = checkpoint(tmp_path / "d.st", "reflectance", "geometry")  # counts for all it holds
    assert serving_files([silent]) == SHIPPED | {"reflectance": silent, "geometry": silent}
    again = checkpoint(tmp_path / "e.st", "geometry", trained=("geometry",))
    refused(UsageError, "e.st: ... Geometry Network ... c.st", serving_files, [third, again])
    refused(UsageError, "b.st: ... Portrait Network", serving_files, [second], ("parsing",), "facerf segment")


def test_a_runs_folder_stands_for_its_best_checkpoint(tmp_path: Path) -> None:
    refused(InputError, "no best.safetensors in this folder", serving_files, [checkpoint_file(tmp_path)])
    best = checkpoint(tmp_path / "best.safetensors", "portrait")
    assert serving_files([checkpoint_file(tmp_path)])["portrait"] == best


@pytest.mark.parametrize("line", ["segment x", "train"])
def test_a_command_refuses_a_file_without_use(tmp_path: Path, line: str, capsys: Said) -> None:
    command = [*line.split(), "-o", str(tmp_path / "out"), "--checkpoint"]
    path = checkpoint(tmp_path / "a.st", "appearance_features")
    assert main([*command, str(path)]) == 2
    assert "a.st: contains network appearance_features" in capsys.readouterr().err
    assert main([*command, str(tmp_path / "none.st")]) == 1
    assert "none.st: no such checkpoint" in capsys.readouterr().err
    (tmp_path / "empty.st").touch()
    assert main([*command, str(tmp_path / "empty.st")]) == 1
    assert "empty.st: not a facerf checkpoint (the file is empty)" in capsys.readouterr().err


def test_a_file_of_the_configuration_may_serve_other_verbs(tmp_path: Path) -> None:
    path = checkpoint(tmp_path / "a.st", "portrait")
    config = tmp_path / "facerf.toml"
    config.write_text(f'[global]\ncheckpoint = ["{path}"]\n')
    line = ["envmap", "--count", "1", "--size", "64", "-o", str(tmp_path / "out")]
    assert main(["--config", str(config), *line]) == 0
