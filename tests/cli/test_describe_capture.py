"""`facerf prepare-dataset --describe`: a draft to fill in, never over a file."""

import json
import shutil
from pathlib import Path

import pytest

from facerf_cli.main import main
from tests.worlds import write_capture

DESCRIBE = ("--describe", "--pattern", "{subject}/{camera}/{light}.exr")
Said = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture whose stage.json is true."""
    folder = tmp_path_factory.mktemp("stage") / "capture"
    write_capture(folder, subjects=2, lights=4)
    return folder


@pytest.fixture
def bare(given: Path, tmp_path: Path) -> Path:
    """Its images without stage.json."""
    shutil.copytree(given, tmp_path / "capture", ignore=shutil.ignore_patterns("stage.json"))
    return tmp_path / "capture"


def test_a_draft_filled_in_is_the_true_description(given: Path, bare: Path, capsys: Said) -> None:
    assert main(["prepare-dataset", str(bare), *DESCRIBE]) == 0
    said = capsys.readouterr()
    assert said.out == f"{bare / 'stage.json'}\n" and "fill in each null" in said.err
    draft, true = (json.loads((folder / "stage.json").read_text()) for folder in (bare, given))
    for key in ("format", "axes", "unit", "pattern"):
        assert draft[key] == true[key]
    for drafted, known in zip(
        draft["lights"] + draft["cameras"], true["lights"] + true["cameras"], strict=True
    ):
        for key, value in drafted.items():
            left_open = value is None and key in ("direction", "world_to_camera", "K")
            assert key == "intensity" or left_open or value == known[key]
    line = ["prepare-dataset", str(bare), "-o", str(bare.parent / "dataset"), "--dry-run"]
    assert main(line) == 2
    assert "colour_space: is null; fill it in (and 10 more)" in capsys.readouterr().err
    (bare / "stage.json").write_text(
        json.dumps(draft | {key: true[key] for key in ("lights", "cameras", "colour_space")})
    )
    assert main(line) == 0
    assert "olat/0001/C2.exr" in capsys.readouterr().out


def test_a_pattern_says_which_part_of_a_path_is_what(bare: Path, capsys: Said) -> None:
    (bare / "raw").mkdir()
    for subject in ("0000", "0001"):
        (bare / subject).rename(bare / "raw" / subject)
    assert main(["prepare-dataset", str(bare), "--describe"]) == 2
    pattern = "raw/{subject}/{camera}/{light}.exr"
    said = capsys.readouterr().err
    assert "--pattern: missing" in said
    assert main(["prepare-dataset", str(bare), "--describe", "--pattern", pattern]) == 0
    assert f"{pattern}: 2 subjects, 3 cameras, 4 lights" in capsys.readouterr().err
    assert json.loads((bare / "stage.json").read_text())["pattern"] == pattern


def test_nothing_is_overwritten_or_written_in_a_dry_run(bare: Path, capsys: Said) -> None:
    for there in (False, True):  # it refuses nothing, either
        assert main(["prepare-dataset", str(bare), *DESCRIBE, "--dry-run"]) == 0
        said = capsys.readouterr()
        assert said.out == f"{bare} -> {bare / 'stage.json'}\n" and "fill in each null" in said.err
        assert (bare / "stage.json").exists() == there
        (bare / "stage.json").write_text("mine")
    assert (bare / "stage.json").read_text() == "mine"
    (bare / "stage.json").write_text("mine")
    for output in ([], ["-o", str(bare / "stage.json")]):
        assert main(["prepare-dataset", str(bare), *DESCRIBE, *output]) == 2
        assert "already exists" in capsys.readouterr().err
    assert (bare / "stage.json").read_text() == "mine"
    assert main(["prepare-dataset", str(bare), *DESCRIBE, "-o", str(bare)]) == 2
    assert "is a folder" in capsys.readouterr().err
    assert main(["prepare-dataset", str(bare), *DESCRIBE, "-o", str(bare / "new/draft.json")]) == 0
    assert (bare / "new/draft.json").is_file()


@pytest.mark.parametrize(
    "line",
    [
        "--subtract-ambient",
        "--layout stage",
        "--colour-chart chart.exr",
        "--overwrite always",
        "--crop 7",
        "--shard 1/2",
        "-j 2",
    ],
)
def test_options_of_preparing_are_refused(bare: Path, capsys: Said, line: str) -> None:
    option, *_ = {"-j": "--jobs"}.get(line[:2], line).split()
    assert main(["prepare-dataset", str(bare), *DESCRIBE, *line.split()]) == 2
    assert f"{option} has no effect with --describe" in capsys.readouterr().err
    assert not (bare / "stage.json").exists()
