"""The colour chart: its colours, its geometry, and the fit, against rendered charts and colour-science."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skimage import data

from facerf_cli.capture.capture import Capture, ChartCorrection, correct_colours
from facerf_cli.capture.chart import (
    GREYS,
    fit_colours,
    published_colours,
    read_charts,
    sample,
)
from facerf_cli.capture.layouts import read_capture
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.image.colour import (
    REC709_CHROMATICITIES,
    linear_to_srgb,
    luminance,
    matrix_to_rec709,
    rgb_to_xyz,
)
from tests.capture.chart_image import CAMERA, CORNERS, chart_image, kept_luminance
from tests.refusals import refused
from tests.worlds import FLAT, write_flat_stage


def test_published_colours_are_those_of_the_chart() -> None:
    """X-Rite's L*a*b* under D50 of dark skin, orange and neutral 5, by matrices of our own."""
    published = published_colours()
    white_xy = (0.34567, 0.35850)
    primaries = (*REC709_CHROMATICITIES[:6], *white_xy)
    to_rec709 = matrix_to_rec709(primaries) @ np.linalg.inv(rgb_to_xyz(primaries))
    for place, lab in ((0, (37.54, 14.37, 14.92)), (6, (62.73, 35.83, 56.5)), (21, (50.76, -0.13, 0.14))):
        y = (lab[0] + 16) / 116
        xyz = np.array([y + lab[1] / 500, y, y - lab[2] / 200]) ** 3 * rgb_to_xyz(primaries).sum(1)
        np.testing.assert_allclose(published[place], to_rec709 @ xyz, atol=2e-3)
    greys = published[GREYS]
    assert (np.ptp(greys, -1) < 0.06 * greys.max(-1)).all()  # nearly neutral under D65: adapted from D50


def test_a_camera_is_undone_and_luminance_stays() -> None:
    fit = fit_colours(0.37 * published_colours() @ CAMERA.T)
    np.testing.assert_allclose(fit.matrix, kept_luminance(CAMERA), atol=1e-6)
    assert fit.delta_e_after.max() < 1e-3 < 5 < fit.delta_e_before.mean()
    greys = (published_colours() @ CAMERA.T)[GREYS].sum(0)
    assert luminance(fit.matrix @ greys) == pytest.approx(luminance(greys))


def test_importing_colour_science_changes_nothing_and_nothing_is_printed_at_the_end() -> None:
    program = (
        "import numpy as np, warnings\n"
        "import OpenImageIO as oiio\n"
        "from facerf_cli.capture.chart import published_colours\n"
        "before, filters = np.get_printoptions(), list(warnings.filters)\n"
        "published_colours()\n"
        "import OpenImageIO\n"
        "assert OpenImageIO is oiio\n"
        "assert np.get_printoptions() == before, np.get_printoptions()\n"
        "assert warnings.filters == filters\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_middles_are_sampled() -> None:
    np.testing.assert_allclose(
        sample(chart_image(noise=0.0, exposure=1.0), CORNERS), published_colours(), atol=1e-6
    )
    careless = CORNERS + np.array([[4, -4], [-4, 4], [4, 4], [-4, -4]])
    sampled = sample(chart_image(noise=0.0, exposure=1.0), careless)
    np.testing.assert_allclose(sampled, published_colours(), atol=1e-6)


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
    image = chart_image(matrix=CAMERA, noise=0.01)
    chart = correction(tmp_path, image)
    before, after = (chart.record["delta_e_2000"][when] for when in ("before", "after"))
    np.testing.assert_allclose(chart.record["matrix"], kept_luminance(CAMERA), atol=0.02)
    assert after["mean"] < 0.5 and after["max"] < 1.5 < 5 < before["mean"]
    assert chart.record["cameras"] == ["C0", "C1"]
    # A camera that was calibrated by the lamps sees the chart in their colour; frames lose it first.
    tinted = [{**light, "intensity": [3, 2, 1]} for light in FLAT["lights"]]
    for name, lights, tint in (("white", WHITE, [1, 1, 1]), ("tinted", tinted, [3, 2, 1])):
        stage = capture(tmp_path / name, lights=lights)
        write_exr(tmp_path / f"{name}.exr", chart_image(matrix=CAMERA, noise=0.0) * np.float32(tint) + LEVEL)
        chart = next(read_charts(stage, str(tmp_path / f"{name}.exr"), [CORNERS]))
        np.testing.assert_allclose(chart.record["matrix"], kept_luminance(CAMERA), atol=5e-3)


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
    refused(UsageError, "corners of 1 image ... --colour-chart", next, read_charts(stage, name, [CORNERS]))


DIM, FACE = 0.0005, data.astronaut()[:240, 60:390].astype(np.float32) / 255
REFUSED: dict[str, tuple[np.ndarray, np.ndarray, str]] = {
    "clipped at 1": (chart_image(exposure=1.5).clip(max=1 - LEVEL), CORNERS, "white patch is clipped"),
    "clipped below 1": (chart_image().clip(max=0.5), CORNERS, "white patch is clipped"),
    "grey": (chart_image().mean(-1, keepdims=True).repeat(3, -1), CORNERS, "delta E"),
    "a face": (FACE, CORNERS, "delta E"),
    "too dark": (chart_image(exposure=DIM), CORNERS, "delta E"),
    "encoded": (linear_to_srgb(chart_image().clip(0, 1)), CORNERS, "lin_rec709"),
    "outside": (chart_image(), CORNERS + np.array([90, 0]), "outside its 330 x 240"),
    "crossed": (chart_image(), CORNERS[[0, 2, 1, 3]], "delta E"),
    "turned": (chart_image(), np.roll(CORNERS, 1, 0), "clockwise from dark skin"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_implausible_is_refused_in_a_line(tmp_path: Path, name: str) -> None:
    image, corners_px, said = REFUSED[name]
    refused(InputError, f"chart.exr: ... {said}", correction, tmp_path, image, corners_px)


def test_white_is_clipped_in_eight_bits_but_not_in_floats(tmp_path: Path) -> None:
    write_display(tmp_path / "chart.png", chart_image(exposure=1.5))
    stage = capture(tmp_path, colour_space="sRGB", black_level=0.0)
    charts = read_charts(stage, str(tmp_path / "chart.png"), [CORNERS])
    refused(InputError, "patch is clipped", next, charts)
    write_display(tmp_path / "chart.png", chart_image(matrix=CAMERA, exposure=0.8))
    chart = next(read_charts(stage, str(tmp_path / "chart.png"), [CORNERS]))
    np.testing.assert_allclose(chart.record["matrix"], kept_luminance(CAMERA), atol=0.03)
    image = chart_image(noise=0.0)
    assert delta_e(correction(tmp_path, image * np.float32((1 - LEVEL) / image.max()))) < 0.5
