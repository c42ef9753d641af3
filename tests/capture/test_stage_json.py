"""Captures on disk: axes, lamps and values become DESIGN's; whatever is wrong is said in one line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from facerf_cli.capture.capture import distorted
from facerf_cli.capture.layouts import read_capture
from facerf_cli.capture.settings import ReadSettings
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.write import write_exr
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


def light(**changes: Any) -> list[dict[str, Any]]:
    return [FLAT["lights"][0] | changes, FLAT["lights"][1]]


def camera(**changes: Any) -> list[dict[str, Any]]:
    return [FLAT["cameras"][0] | changes]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "facerf-stage-9"}, "facerf-stage-1"),
        ({"axes": "opengl"}, "opencv"),
        ({"unit": "mm"}, "'m'"),
        ({"colour_space": "mauve"}, "unknown colour space 'mauve'"),
        ({"lights": []}, "at least 1"),
        ({"lights": light(direction=[0, 0, 2])}, "length 1"),
        ({"lights": light(direction=[0, 1])}, "finite"),
        ({"lights": light(intensity=[1, 0, 1])}, r"lights\[0\]: intensity .*positive"),
        ({"lights": light(id="L1")}, "'L1' occurs twice"),
        ({"lights": light(id="../L0")}, "a name"),
        ({"cameras": camera(width=10**9)}, r"cameras\[0\]: width .*65536"),
        ({"cameras": camera(K=[[1, 0], [0, 1]])}, "3 x 3"),
        ({"cameras": camera(K=[[500, 3, 32], [0, 500, 30], [0, 0, 1]])}, "fx, 0, cx"),
        ({"cameras": camera(K=[[500, 0, 32], [0, 600, 30], [0, 0, 1]])}, "square"),
        ({"cameras": camera(world_to_camera=[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2]])}, "rotation"),
        ({"cameras": camera(world_to_camera=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 2]])}, "rotation"),
        (
            {"cameras": camera(world_to_camera=[*FLAT["cameras"][0]["world_to_camera"], [0, 0, 1, 1]])},
            "last row",
        ),
        ({"cameras": camera(world_to_camera="eye")}, "3 x 4"),
        ({"pattern": "../{subject}/{camera}/{light}.exr"}, "below the capture"),
        ({"pattern": "{camera}/{light}.exr"}, "names {subject} and {light}"),
        ({"pattern": "{subject}/{light}.exr", "cameras": [*camera(), *camera(id="C1")]}, "and {camera} and"),
        ({"ambient": "{subject}/{light}.exr"}, "names {subject}, without"),
        ({"colour_space": None}, "colour_space is null; fill it in$"),
        ({"lights": light(direction=None), "cameras": camera(K=[None, 3])}, r"direction is null.*and 1 more"),
        ({"pattern": "{subject}/{camera}/{light}{gain}.exr"}, "and {light}, without '{' '}' elsewhere, is"),
        ({"pattern": "{subject}/{camera}/\n/{light}.exr"}, r"without '\\n' "),
        ({"subjects": ["0000"]}, "an object"),
        ({"subjects": {"0000.json": {}}}, "a name"),  # fits/0000.json is the record of 0000
        ({"subjects": {"0000": 3}}, "an object"),
        ({"black_level": [0, 1]}, "a number, or one for each of three channels"),
        ({"black_level": True}, "a number, or one"),
        ({"colour_matrix": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}, "keeps three colours apart"),
        ({"lights": light(position=[0, 0, 1])}, "either 'direction' or 'position'"),
        ({"lights": [{"id": "L0", "position": [0, 0, 0], "intensity": [1, 1, 1]}]}, "L0 is at the centre"),
        ({"exposure_stops": {"0000": 40}}, "exposure_stops"),
        ({"exposure_stops": {"1": 1}, "subjects": {"0000": {}}}, "there is no subject 1"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said) as raised:
        read_capture(write_flat_stage(tmp_path, **change))
    assert "stage.json" in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize("missing", ["unit", "cameras"])
def test_nothing_is_guessed(tmp_path: Path, missing: str) -> None:
    write_flat_stage(tmp_path)
    (tmp_path / "stage.json").write_text(json.dumps({k: v for k, v in FLAT.items() if k != missing}))
    with pytest.raises(InputError, match=f"has no '{missing}'"):
        read_capture(tmp_path)


def test_no_capture_and_no_such_layout(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"stage\.json: no such file"):
        read_capture(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        read_capture(tmp_path / "nowhere")
    with pytest.raises(UsageError, match="there is extended-yale-b, faceolat, faceolat-linear, stage"):
        read_capture(tmp_path, ReadSettings("multipie"))


def test_a_frame_that_is_missing_torn_or_of_another_size_is_named(tmp_path: Path) -> None:
    capture = read_capture(write_flat_stage(tmp_path))
    path = capture.frame_path("0000", "C0", "L1")
    write_exr(path, np.zeros((60, 60, 3), np.float32))
    with pytest.raises(InputError, match=r"L1\.exr: 60 x 60 pixels, but camera C0 has 64 x 60"):
        capture.frame("0000", "C0", 1)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(InputError, match=r"L1\.exr: .*(read|damaged)"):
        capture.frame("0000", "C0", 1)
    path.unlink()
    with pytest.raises(InputError, match=r"L1\.exr: no such file"):
        capture.frame("0000", "C0", 1)


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


@pytest.mark.parametrize(
    ("lens", "says"),
    [
        ([0.1], "k1, k2, p1, p2, k3 of OpenCV are needed"),
        ([0.1, 0, 0, "x"], "k1, k2, p1, p2, k3 of OpenCV are needed"),
        ([0.1] * 8, "undistort images of other lenses first"),
        ([-3.0, 0, 0, 0], "distortion folds the image"),
    ],
)
def test_a_lens_that_cannot_be_undone_is_one_line(tmp_path: Path, lens: list[float], says: str) -> None:
    camera = FLAT["cameras"][0] | {"K": WIDE, "distortion": lens}
    with pytest.raises(InputError, match=says):
        read_capture(write_flat_stage(tmp_path, cameras=[camera]))


def test_a_single_camera_is_the_world_and_of_several_each_has_a_pose(tmp_path: Path) -> None:
    lone = {key: value for key, value in FLAT["cameras"][0].items() if key != "world_to_camera"}
    camera = read_capture(write_flat_stage(tmp_path, cameras=[lone])).cameras["C0"]
    assert torch.equal(camera.rotation, torch.eye(3).double()) and not camera.translation_m.any()
    two = [FLAT["cameras"][0], lone | {"id": "C1", "K": FLAT["cameras"][0]["K"]}]
    with pytest.raises(InputError, match="camera C1 has no 'world_to_camera'"):
        read_capture(write_flat_stage(tmp_path, cameras=two))
