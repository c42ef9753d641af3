"""`facerf prepare-dataset --colour-chart`: a wrong camera's frames become those of the right one."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facerf_cli.capture.layouts import read_capture
from facerf_cli.files.write import write_exr
from facerf_cli.main import main
from tests.capture.chart_image import CAMERA, CORNERS, chart_image, kept_luminance
from tests.cli.lines import prepare
from tests.folders import tree
from tests.stacks import read_olat_stack
from tests.worlds import BLACK_LEVEL, write_capture

LIGHTS = 10
PLACE = ("--chart-corners", " ".join(f"{x:g},{y:g}" for x, y in CORNERS))
SPLIT = ("--split", "1/0/0")
Said = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture by a camera that sees linear Rec.709; lamps in several colours."""
    folder = tmp_path_factory.mktemp("right") / "capture"
    write_capture(folder, subjects=1, lights=LIGHTS)
    return folder


@pytest.fixture(scope="module")
def wrong(right: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """That capture by another camera, and its picture of a chart under the lamps' mean."""
    folder = tmp_path_factory.mktemp("wrong") / "capture"
    shutil.copytree(right, folder)
    there = read_capture(right)
    for camera in there.cameras:
        for number, light in enumerate(there.light_ids):
            seen = there.frame("0000", camera, number) @ CAMERA.T.astype(np.float32)
            path = folder / there.frame_path("0000", camera, light).relative_to(right)
            write_exr(path, seen * there.intensities[number].astype(np.float32) + BLACK_LEVEL)
    chart = chart_image(matrix=CAMERA, noise=0.002) * there.intensities.mean(0)
    write_exr(folder / "chart.exr", (chart + BLACK_LEVEL).astype(np.float32))
    return folder


@pytest.fixture(scope="module")
def corrected(wrong: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("corrected") / "dataset"
    assert prepare(wrong, output, *SPLIT, "--colour-chart", str(wrong / "chart.exr"), *PLACE) == 0
    return output


def normalisation(dataset: Path) -> Any:
    return json.loads((dataset / "dataset.json").read_text())["normalisation"]


def test_the_dataset_is_that_of_the_right_camera(right: Path, corrected: Path, tmp_path: Path) -> None:
    assert prepare(right, tmp_path, *SPLIT) == 0
    scale = np.diag(kept_luminance(CAMERA) @ CAMERA).mean()  # luminance is kept as the wrong camera saw it
    for camera in ("C0", "C1", "C2"):
        there, here = (
            read_olat_stack(folder / f"olat/0000/{camera}.exr") for folder in (tmp_path, corrected)
        )
        olats = there.olats.float() * scale
        error = (here.olats.float() - olats).abs().mean((0, 2, 3)) / olats.mean((0, 2, 3))
        assert error.max() < 0.02
    assert "colour_charts" not in normalisation(tmp_path)


def test_what_was_done_is_told(wrong: Path, corrected: Path, tmp_path: Path, capsys: Said) -> None:
    (chart,) = normalisation(corrected)["colour_charts"]
    assert chart["picture"] == "chart.exr" and len(chart["picture_sha256"]) == 64
    assert (
        chart["cameras"] == ["C0", "C1", "C2"] and np.abs(np.subtract(chart["corners_px"], CORNERS)).max() < 2
    )
    np.testing.assert_allclose(chart["matrix"], kept_luminance(CAMERA), atol=0.02)
    assert chart["delta_e_2000"]["after"]["mean"] < 0.5 < 5 < chart["delta_e_2000"]["before"]["mean"]
    line = ["--colour-chart", str(wrong / "chart.exr"), *PLACE, "--dry-run"]
    assert prepare(wrong, tmp_path / "out", *SPLIT, *line) == 0
    said = capsys.readouterr().err
    assert "delta E 2000 mean 0." in said and said.count("\n") == 2 and not (tmp_path / "out").exists()


def test_jobs_and_a_second_run(wrong: Path, corrected: Path, tmp_path: Path, capsys: Said) -> None:
    """Jobs change no byte; another chart, or another place of it, is another dataset."""
    before, chart = tree(corrected), ["--colour-chart", str(wrong / "chart.exr"), *PLACE]
    assert prepare(wrong, tmp_path / "jobs", *SPLIT, *chart, "--jobs", "2") == 0
    assert tree(tmp_path / "jobs") == before
    assert prepare(wrong, corrected, *SPLIT, *chart) == 0 and tree(corrected) == before
    capsys.readouterr()
    corners = " ".join(f"{x + 1:g},{y:g}" for x, y in CORNERS)
    for line in ([], [*chart[:2], "--chart-corners", corners]):
        assert prepare(wrong, corrected, *SPLIT, *line) == 2
        assert "other stage values; pass --overwrite" in capsys.readouterr().err and tree(corrected) == before


def test_an_older_correction_does_not_outlive_its_dataset_and_a_file_is_none(
    wrong: Path, corrected: Path, tmp_path: Path, capsys: Said
) -> None:
    shutil.copytree(corrected, tmp_path / "again")
    assert prepare(wrong, tmp_path / "again", *SPLIT, "--overwrite", "always") == 0
    assert "colour_charts" not in normalisation(tmp_path / "again")
    (tmp_path / "file").touch()
    assert prepare(wrong, tmp_path / "file", *SPLIT, "--colour-chart", str(wrong / "chart.exr"), *PLACE) == 2
    assert "file: cannot be written to" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (["--colour-chart", "none.exr", *PLACE], "none.exr: no such file"),
        (["--colour-chart", "chart.exr", "--chart-corners", "1,2 3,4 5,6"], "four corners in pixels"),
        (["--colour-chart", "chart.exr", "--chart-corners", "a,b c,d e,f g,h"], "four corners in pixels"),
        (["--colour-chart", "chart.exr", "--chart-corners", "1,2 3,4 5,6 nan,8"], "four corners in pixels"),
        (["--colour-chart", "chart.exr", "--chart-corners", "0,0 900,0 900,9 0,9"], "outside its 330 x 240"),
        (["--colour-chart", "0000/C0/L000.exr"], "pass the image and its chart's corners"),
        (["--chart-corners", "1,2 3,4 5,6 7,8"], "pass the image and its chart's corners"),
        (["--colour-chart", "{camera}.exr", *PLACE], "--colour-chart names 3"),
    ],
)
def test_wrong_charts_stop_the_run(
    wrong: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said, line: list[str], said: str
) -> None:
    monkeypatch.chdir(wrong)
    assert main(["prepare-dataset", ".", "-o", str(tmp_path / "out"), *line]) == 2
    complaint = capsys.readouterr().err
    assert said in complaint and complaint.count("\n") == 1 and not (tmp_path / "out").exists()
