"""Defaults of options from a TOML file."""

import re
from pathlib import Path

import pytest

from facerf_cli.main import main

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
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "a.png").touch()
    line = ["relight", str(tmp_path / "a.png"), "-o", str(tmp_path / "out")]
    assert main(["--config", str(config), *line]) == 0
    assert "a_light_40_10.png" in capsys.readouterr().out
    assert main([*line, "--light", "5,5", "--config", str(config)]) == 0
    said = capsys.readouterr().out
    assert "a_light_5_5.png" in said and "40_10" not in said
    assert not (tmp_path / "out").exists()


def test_config_shows_what_is_in_force_and_from_where(
    config: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FACERF_CONFIG", str(config))
    assert main(["config"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"--seed = 3  ({config})" in lines and f"evaluate yale-b --overwrite = always  ({config})" in lines
    assert main(["config", "relight"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"--exposure = face  ({config})" in lines and "# --lights = 150" in lines
    assert lines.index(f"--exposure = face  ({config})") < lines.index("# not set, and so by default:")
    assert all(line[0] == "#" for line in lines[lines.index("# not set, and so by default:") :])
    assert main(["config", "relight", "--seed", "5"]) == 0
    monkeypatch.delenv("FACERF_CONFIG")
    assert main(["config"]) == 0
    assert "no configuration file" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[relight]\nexpo = 1", r"\[relight\] expo: no such option; see `facerf relight --help`"),
        ("[global]\nversion = true", r"\[global\] version: no such option; see `facerf --help`"),
        ("[relighting]\n", r"\[relighting\] is no verb"),
        ("[evaluate.olat]\nx = 1", "see `facerf evaluate olat --help`"),
        ("relight = 5", "relight is no table"),
        ("[relight", "not TOML"),
        ("a = " + "[" * 5000, "not TOML"),
        ("#" * (1 << 20), "larger than 1 MiB"),
        ("[global]\nseed = -1", "--seed"),
        ("[relight]\noverwrite = 'x'", "--overwrite"),
    ],
)
def test_a_wrong_file_is_one_line(
    text: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "c.toml").write_text(text + "\n")
    line = ["relight", "a.png", "-o", str(tmp_path / "out"), "--config", str(tmp_path / "c.toml")]
    assert main(line) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "Traceback" not in error
    assert re.search(says, error), error


def test_no_file(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["config", "--config", str(tmp_path / "none.toml")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert main(["config", "relighting"]) == 2
