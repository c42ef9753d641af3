"""Photographs of a colour chart: found, measured, refused, and frames corrected by them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skimage import data

from facerf_cli.capture.capture import Capture, ChartCorrection, correct_colours
from facerf_cli.capture.chart import (
    four_turns,
    published_colours,
    read_charts,
    squares_px,
    write_chart_overlays,
)
from facerf_cli.capture.layouts import read_capture
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.image.colour import linear_to_srgb
from tests.capture.chart_image import CAMERA, CORNERS, SHAPE, chart_image, kept_luminance
from tests.worlds import FLAT, write_flat_stage

WHITE = [{**light, "intensity": [2, 2, 2]} for light in FLAT["lights"]]
LEVEL = 0.25  # black, in `FLAT`
CAMERAS = [FLAT["cameras"][0], {**FLAT["cameras"][0], "id": "C1"}]


def capture(folder: Path, **changes: Any) -> Capture:
    folder.mkdir(exist_ok=True)
    return read_capture(write_flat_stage(folder, **{"lights": WHITE, "cameras": CAMERAS, **changes}))


def correction(folder: Path, image: np.ndarray, corners_px: np.ndarray = CORNERS) -> ChartCorrection:
    """By a chart's picture [H, W, 3] above black, of a capture with white lamps."""
    write_exr(folder / "chart.exr", image + LEVEL)
    return next(read_charts(capture(folder), str(folder / "chart.exr"), [corners_px]))


def delta_e(chart: ChartCorrection) -> float:
    """The mean that the correction leaves."""
    return float(chart.record["delta_e_2000"]["after"]["mean"])


def test_a_camera_with_noise_is_undone_and_lamps_of_one_colour_change_nothing(tmp_path: Path) -> None:
    image = chart_image(matrix=CAMERA, light=(1.2, 0.8), noise=0.01)
    chart = correction(tmp_path, image)
    before, after = (chart.record["delta_e_2000"][when] for when in ("before", "after"))
    np.testing.assert_allclose(chart.record["matrix"], kept_luminance(CAMERA), atol=0.02)
    assert after["mean"] < 0.5 and after["max"] < 1.5 < 5 < before["mean"]
    assert chart.record["light_span"] == pytest.approx(1.25, abs=0.05)
    assert chart.record["cameras"] == ["C0", "C1"]
    # A camera that was calibrated by the lamps sees the chart in their colour; frames lose it first.
    tinted = [{**light, "intensity": [3, 2, 1]} for light in FLAT["lights"]]
    for name, lights, tint in (("white", WHITE, [1, 1, 1]), ("tinted", tinted, [3, 2, 1])):
        stage = capture(tmp_path / name, lights=lights)
        write_exr(tmp_path / f"{name}.exr", chart_image(matrix=CAMERA, noise=0.0) * np.float32(tint) + LEVEL)
        chart = next(read_charts(stage, str(tmp_path / f"{name}.exr"), [CORNERS]))
        np.testing.assert_allclose(chart.record["matrix"], kept_luminance(CAMERA), atol=5e-3)


@pytest.mark.parametrize("turn", [1, 2])
def test_corners_begin_anywhere_and_go_either_way(tmp_path: Path, turn: int) -> None:
    corners = four_turns(CORNERS)[turn][:: -1 if turn % 2 else 1]
    chart = correction(tmp_path, chart_image(matrix=CAMERA), corners)
    assert chart.record["corners_px"] == CORNERS.tolist() and delta_e(chart) < 0.5


def test_a_chart_for_each_camera(tmp_path: Path) -> None:
    stage = capture(tmp_path / "stage")
    for number, matrix in enumerate((CAMERA, np.eye(3))):
        write_exr(tmp_path / f"chart_C{number}.exr", chart_image(matrix=matrix) + LEVEL)
    name = str(tmp_path / "chart_{camera}.exr")
    charts = tuple(read_charts(stage, name, [CORNERS, CORNERS]))
    assert [chart.record["cameras"] for chart in charts] == [["C0"], ["C1"]]
    np.testing.assert_allclose(charts[1].record["matrix"], np.eye(3), atol=0.01)
    seen = (np.array([[[0.3, 0.5, 0.2]]]) @ CAMERA.T).astype(np.float32)
    assert np.abs(correct_colours(charts, "C1", seen) - seen).max() < 0.01
    assert (
        np.abs(correct_colours(charts, "C0", seen) - seen @ np.array(charts[0].record["matrix"]).T).max()
        < 1e-6
    )
    assert correct_colours((), "C0", seen) is seen
    with pytest.raises(UsageError, match="corners of 1 image, and --colour-chart names 2"):
        next(read_charts(stage, name, [CORNERS]))
    write_chart_overlays(replace(stage, charts=charts), tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "colour_chart_C0.png",
        "colour_chart_C1.png",
    ]


def test_the_overlay_shows_published_colours_in_corrected_ones(tmp_path: Path) -> None:
    image = chart_image(matrix=CAMERA)
    chart = correction(tmp_path, image)
    write_chart_overlays(replace(capture(tmp_path), charts=(chart,)), tmp_path)
    shown = read_image(tmp_path / "colour_chart.png").pixels
    assert shown.shape == (*SHAPE, 3)
    x, y = squares_px(CORNERS)[6].mean(0).astype(int)
    orange = shown[y - 6 : y + 6, x - 6 : x + 6]  # the published colour within what was sampled
    assert np.abs(orange - published_colours()[6]).max() < 0.05
    assert json.dumps(chart.record) and "max" in chart.in_words() and "\n" not in chart.in_words()


DIM, FACE = 0.0005, data.astronaut()[:240, 60:390].astype(np.float32) / 255
REFUSED: dict[str, tuple[np.ndarray, np.ndarray, str]] = {
    "clipped at 1": (chart_image(exposure=1.5).clip(max=1 - LEVEL), CORNERS, "white patch is clipped"),
    "clipped below 1": (chart_image().clip(max=0.5), CORNERS, "white patch is clipped"),
    "grey": (chart_image().mean(-1, keepdims=True).repeat(3, -1), CORNERS, "is grey"),
    "a face": (FACE, CORNERS, "delta E"),
    "too dark": (chart_image(exposure=DIM), CORNERS, "too dark"),
    "encoded": (linear_to_srgb(chart_image().clip(0, 1)), CORNERS, "lin_rec709"),
    "small": (chart_image(CORNERS / 8, (60, 80), noise=0.0), CORNERS / 8, "pixels in its middle"),
    "outside": (chart_image(), CORNERS + np.array([90, 0]), "outside its 330 x 240"),
    "crossed": (chart_image(), CORNERS[[0, 2, 1, 3]], "convex"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_implausible_is_refused_in_a_line(tmp_path: Path, name: str) -> None:
    image, corners_px, said = REFUSED[name]
    with pytest.raises(InputError, match=said) as raised:
        correction(tmp_path, image, corners_px)
    assert "chart.exr: " in str(raised.value) and "\n" not in str(raised.value)


def test_a_white_is_clipped_of_eight_bits_and_not_of_floats(tmp_path: Path) -> None:
    write_display(tmp_path / "chart.png", chart_image(exposure=1.3))
    stage = capture(tmp_path, colour_space="sRGB", black_level=0.0)
    with pytest.raises(InputError, match="of the chart's patches are clipped"):
        next(read_charts(stage, str(tmp_path / "chart.png"), [CORNERS]))
    write_display(tmp_path / "chart.png", chart_image(matrix=CAMERA, exposure=0.8))
    chart = next(read_charts(stage, str(tmp_path / "chart.png"), [CORNERS]))
    np.testing.assert_allclose(chart.record["matrix"], kept_luminance(CAMERA), atol=0.03)
    image = chart_image(noise=0.0)
    assert (
        correction(tmp_path, image * np.float32((1 - LEVEL) / image.max())).record["delta_e_2000"]["after"][
            "mean"
        ]
        < 0.5
    )
