"""Captures on disk: axes, lights and values become the package's; every fault is named in one line."""

from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.capture.capture import distorted
from facerf_cli.capture.layouts import read_capture
from facerf_cli.image.colour import matrix_to_rec709, named_space
from tests.worlds import FLAT, write_flat_stage

FACING = FLAT["cameras"][0]["world_to_camera"]


def test_cameras_become_designs_of_three_rows_or_four(tmp_path: Path) -> None:
    camera = read_capture(write_flat_stage(tmp_path)).cameras["C0"]
    points = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0, 1.0]])
    expected = [[33, 30], [33 + 25, 30], [33, 30 - 25], [33 + 50, 30]]  # x right, y up, z toward the camera
    assert np.abs(camera.project(points).numpy() - expected).max() < 1e-5
    in_camera = points.double() @ camera.rotation.mT + camera.translation_m
    assert (in_camera[:, 2] < 0).all() and torch.linalg.det(camera.rotation) == pytest.approx(1)
    four = [{**FLAT["cameras"][0], "world_to_camera": [*FACING, [0, 0, 0, 1]]}]
    here = read_capture(write_flat_stage(tmp_path, cameras=four)).cameras["C0"]
    there = read_capture(write_flat_stage(tmp_path)).cameras["C0"]
    assert torch.equal(here.rotation, there.rotation) and torch.equal(here.translation_m, there.translation_m)


def test_black_level_intensity_and_colour_space_are_those_of_the_description(tmp_path: Path) -> None:
    capture = read_capture(write_flat_stage(tmp_path))
    assert capture.frame("0000", "C0", 0)[5, 5] == pytest.approx([2, 1, 0.5])
    assert capture.frame("0000", "C0", 1)[5, 5] == pytest.approx([2, 2, 2])
    capture = read_capture(write_flat_stage(tmp_path, colour_space="ACEScg", black_level=0))
    space = named_space("ACEScg")
    assert space.chromaticities is not None
    expected = matrix_to_rec709(space.chromaticities) @ np.full(3, 2.25)
    assert capture.frame("0000", "C0", 1)[0, 0] == pytest.approx(expected, rel=1e-3)


def test_a_matrix_acts_on_what_is_above_the_black_of_each_channel(tmp_path: Path) -> None:
    matrix = [[1, 0.5, 0], [0, 1, 0], [0, 0, 2]]
    given = {"black_level": [0.25, 1.25, 2.0], "colour_matrix": matrix, "exposure_stops": {"0000": 1}}
    capture = read_capture(write_flat_stage(tmp_path, **given))
    assert capture.frame("0000", "C0", 1)[5, 5] == pytest.approx([1.25, 0.5, 0.25])


def test_a_light_with_a_position_shines_on_a_head_from_there(tmp_path: Path) -> None:
    lights = [{"id": "L0", "position": [0, 3, 4], "intensity": [1, 2, 4]}, FLAT["lights"][1]]
    capture = read_capture(write_flat_stage(tmp_path, lights=lights, centre=[0, 0, 4]))
    assert capture.directions_world == pytest.approx(np.array([[0, 1, 0], [0.6, 0, 0.8]]))
    nearer = capture.about(np.array([0, 1.5, 4]))
    assert nearer.intensities == pytest.approx(np.array([[4, 8, 16], [1, 1, 1]]))
    assert nearer.about(np.array([0, 0, 4])).intensities == pytest.approx(capture.intensities)
    assert nearer.frame("0000", "C0", 0)[0, 0] == pytest.approx([2 / 4, 2 / 8, 2 / 16])


def test_nan_is_zero_and_noise_below_black_stays(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    import OpenImageIO as oiio

    pixels = np.full((60, 64, 3), 0.2, np.float32)
    pixels[3, 4] = np.nan
    capture = read_capture(write_flat_stage(tmp_path))
    spec = oiio.ImageSpec(64, 60, 3, "half")
    stream = oiio.ImageOutput.create("x.exr")
    path = str(capture.frame_path("0000", "C0", "L1"))
    assert stream.open(path, spec) and stream.write_image(pixels) and stream.close()
    frame = capture.frame("0000", "C0", 1)
    assert np.isfinite(frame).all() and frame[3, 4] == pytest.approx(-0.25)
    assert frame[0, 0] == pytest.approx(-0.05, abs=1e-3)  # the stack clips it after the crop


@pytest.mark.parametrize(
    "pattern",
    [
        "{subject}/{camera}/{light}.exr",
        "all/{subject}-{camera}-{light}.exr",
        "{camera}/{subject}/{light}.exr",
    ],
)
def test_subjects_are_found_by_their_images(tmp_path: Path, pattern: str) -> None:
    write_flat_stage(tmp_path, pattern=pattern)
    for subject in ("anna", "zoe"):
        path = tmp_path / pattern.format(subject=subject, camera="C0", light="L1")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    (tmp_path / "transport").mkdir()
    (tmp_path / ".hidden/C0").mkdir(parents=True)
    (tmp_path / ".hidden/C0/L0.exr").touch()
    found = set(read_capture(tmp_path).subjects) - {"0000"}
    assert found == {"anna", "zoe"}


def test_what_there_is_one_of_needs_no_place_in_the_pattern(tmp_path: Path) -> None:
    write_flat_stage(tmp_path, pattern="0000/C0/{light}.exr", subjects={"anna": {"age": None}})
    capture = read_capture(tmp_path)
    assert list(capture.subjects) == ["anna"] and capture.frame("anna", "C0", 1)[5, 5] == pytest.approx(
        [2, 2, 2]
    )


LENS = (-0.25, 0.1, 0.004, -0.003, 0.02)
WIDE = [[60.0, 0, 33], [0, 60.0, 29], [0, 0, 1]]  # the frame's corners lie at a radius of 0.7


def scene(plane: np.ndarray) -> np.ndarray:
    """A smooth picture of the plane at depth 1 [..., 2]."""
    x, y = plane[..., 0], plane[..., 1]
    return np.stack([2 + np.sin(3 * x + y), 2 + np.cos(4 * y - x), 2 + x * y], -1).astype(np.float32)


def plane_of_pixels() -> np.ndarray:
    rows, columns = np.mgrid[:60, :64] + 0.5
    return np.stack([(columns - 33) / 60, (rows - 29) / 60], -1)


def test_the_model_is_opencvs() -> None:
    """Worked by hand from its documentation at x, y = 0.5, 0.25: r2 = 0.3125, radial = 0.9322509765625."""
    moved = distorted(torch.tensor([0.5, 0.25]).double(), LENS)
    radial = 1 - 0.25 * 0.3125 + 0.1 * 0.3125**2 + 0.02 * 0.3125**3
    x = 0.5 * radial + 2 * 0.004 * 0.5 * 0.25 - 0.003 * (0.3125 + 2 * 0.25)
    y = 0.25 * radial + 0.004 * (0.3125 + 2 * 0.0625) + 2 * -0.003 * 0.5 * 0.25
    np.testing.assert_allclose(moved.numpy(), [x, y], rtol=1e-12)


def test_a_distorted_frame_is_read_as_a_pinhole_sees_it(tmp_path: Path) -> None:
    seen = wanted = torch.from_numpy(plane_of_pixels())
    for _ in range(60):  # the lens's inverse, by iteration
        seen = seen + wanted - distorted(seen, LENS)
    image = scene(seen.numpy())
    camera = FLAT["cameras"][0] | {"K": WIDE, "distortion": LENS}
    lights = [light | {"intensity": [1, 1, 1]} for light in FLAT["lights"]]
    folder = write_flat_stage(tmp_path, image, cameras=[camera], lights=lights, black_level=0.0)
    found = read_capture(folder).frame("0000", "C0", 0)
    truth, off = scene(plane_of_pixels()), (slice(4, -4), slice(4, -4))
    assert np.abs(image - truth)[off].max() > 0.1  # the lens matters
    assert np.abs(found - truth)[off].max() < 0.01
    none = write_flat_stage(tmp_path, image, cameras=[camera | {"distortion": [0, 0, 0, 0]}], lights=lights)
    assert not read_capture(none).distortion


def test_a_single_camera_is_the_world_and_of_several_each_has_a_pose(tmp_path: Path) -> None:
    lone = {key: value for key, value in FLAT["cameras"][0].items() if key != "world_to_camera"}
    camera = read_capture(write_flat_stage(tmp_path, cameras=[lone])).cameras["C0"]
    assert torch.equal(camera.rotation, torch.eye(3).double()) and not camera.translation_m.any()
