"""Defaults of options from a TOML file."""

from pathlib import Path

import pytest

from facerf_cli.main import main
from tests.kinds import Said

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
