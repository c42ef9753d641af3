"""Defaults of options from a TOML file."""

from pathlib import Path

import pytest

from facerf_cli.main import main
from tests.kinds import Patch, Said

CONFIG = """
[global]
seed = 3
[relight]
exposure = "face"
light = ["0,20", "40,10"]
dry-run = true
format = "png"
[evaluate.yale-b]
overwrite = "always"
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    (tmp_path / "facerf.toml").write_text(CONFIG)
    return tmp_path / "facerf.toml"


def test_the_file_gives_defaults_and_the_command_line_comes_first(
    config: Path, tmp_path: Path, capsys: Said
) -> None:
    (tmp_path / "a.png").touch()
    line = ["relight", str(tmp_path / "a.png"), "-o", str(tmp_path / "out")]
    assert main(["--config", str(config), *line]) == 0
    assert "a_light_40_10.png" in capsys.readouterr().out
    assert main([*line, "--light", "5,5", "--config", str(config)]) == 0
    said = capsys.readouterr().out
    assert "a_light_5_5.png" in said and "40_10" not in said
    assert not (tmp_path / "out").exists()


def test_a_file_on_the_command_line_replaces_that_of_the_environment(
    config: Path, tmp_path: Path, capsys: Said, monkeypatch: Patch
) -> None:
    (tmp_path / "a.png").touch()
    other = tmp_path / "other.toml"
    other.write_text('[relight]\nlight = ["5,5"]\ndry-run = true\n')
    line = ["relight", str(tmp_path / "a.png"), "-o", str(tmp_path / "out")]
    monkeypatch.setenv("FACERF_CONFIG", str(config))
    for ordered in (["--config", str(other), *line], [*line, "--config", str(other)]):
        assert main(ordered) == 0
        said = capsys.readouterr().out
        assert "a_light_5_5.png" in said and "40_10" not in said
    assert main(line) == 0 and "40_10" in capsys.readouterr().out


def test_a_removed_option_names_its_replacement(config: Path, capsys: Said) -> None:
    config.write_text("[relight]\nroom = '0.1'\n")
    assert main(["--config", str(config), "relight", "a.png", "--light", "5,5", "-o", "out"]) == 2
    assert "room: no such command or option; use --ambient" in capsys.readouterr().err
