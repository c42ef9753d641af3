"""Extended Yale B as a capture: lights by the files' names, grey as it is, the room's light if one asks."""

import json
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.capture.layouts import guess_camera, read_capture
from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.images import write_exr
from facerf_cli.main import main
from tests.capture.test_layouts import capture_at
from tests.capture.yale_fixture import FLASHES, ramp, write_pgm, write_yale_b

REAL = Path(__file__).parents[3] / "shared/data/extended_yale_b"


def test_lights_are_those_of_the_names(tmp_path: Path) -> None:
    capture = read_capture(write_yale_b(tmp_path), "extended-yale-b")
    assert list(capture.subjects) == ["yaleB05", "yaleB07"] and list(capture.cameras) == ["P00"]
    assert sorted(capture.light_ids) == sorted(flash.name for flash in FLASHES)
    directions = dict(zip(capture.light_ids, capture.directions_world, strict=True))
    np.testing.assert_allclose(directions["A+000E+00"], [0, 0, 1], atol=1e-9)
    assert directions["A+070E+00"][0] < -0.9 and directions["A+000E+90"][1] > 0.99  # A > 0: the left
    for number, name in enumerate(capture.light_ids):
        place = next(place for place, flash in enumerate(FLASHES) if flash.name == name)
        expected = np.repeat(ramp(place)[..., None] / 255, 3, -1)
        np.testing.assert_allclose(capture.frame("yaleB05", "P00", number), expected, atol=1e-6)


def test_a_light_that_is_bad_for_everybody_is_still_of_the_rig(tmp_path: Path) -> None:
    name = FLASHES[2].name
    for subject in ("yaleB05", "yaleB07"):
        path = write_yale_b(tmp_path) / subject / f"{subject}_P00{name}.pgm"
        path.rename(path.with_name(path.name + ".bad"))
    path = tmp_path / f"yaleB07/yaleB07_P00{name}.pgm"
    capture = read_capture(tmp_path, "extended-yale-b")
    assert name in capture.light_ids and capture.marked["yaleB07"] == {name}
    assert capture.frame_path("yaleB07", "P00", name) == path and not path.exists()


def test_the_rooms_light_is_subtracted_where_it_was_cropped(tmp_path: Path) -> None:
    write_yale_b(tmp_path)
    write_pgm(tmp_path / "yaleB05/yaleB05_P00_Ambient.pgm", np.full((192, 168), 51))
    write_pgm(tmp_path / "yaleB07/yaleB07_P00_Ambient.pgm", np.full((480, 640), 51))  # as some are
    plain, less = (read_capture(tmp_path, "extended-yale-b", subtract) for subtract in (False, True))
    for subject, level in (("yaleB05", 0.2), ("yaleB07", 0.0)):
        difference = plain.frame(subject, "P00", 3) - less.frame(subject, "P00", 3)
        np.testing.assert_allclose(difference, level, atol=1e-6)
        assert (less.ambient(subject, "P00") is None) == (level == 0)


def test_a_stage_may_name_its_ambient_images(tmp_path: Path) -> None:
    capture_at(tmp_path, ambient="{subject}/{camera}/dark.exr")
    write_exr(tmp_path / "0000/C0/dark.exr", np.full((60, 64, 3), 0.5, np.float32))
    capture = read_capture(tmp_path, "stage", subtract_ambient=True)
    assert capture.frame("0000", "C0", 0)[5, 5] == pytest.approx([1.75, 0.875, 0.4375])  # the black level too
    with pytest.raises(InputError, match=r"names {subject} is needed"):
        read_capture(capture_at(tmp_path, ambient="dark.exr"))
    with pytest.raises(UsageError, match="names no 'ambient'"):
        read_capture(capture_at(tmp_path), "stage", subtract_ambient=True)


def test_no_database(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="yaleB01 to yaleB39"):
        read_capture(tmp_path, "extended-yale-b")


def test_a_metre_before_the_camera_a_face_fills_the_image() -> None:
    camera = guess_camera()
    across_px = 0.089 * camera.focal_px[0]  # the outer corners of the eyes, a metre away
    assert 0.4 * camera.width_px < across_px < 0.6 * camera.width_px


@pytest.mark.skipif(not REAL.is_dir(), reason="needs ../shared/data/extended_yale_b")
def test_real_people_are_prepared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One whose pictures are partly marked as damaged, and whose ambient picture is not cropped."""
    capture, output = tmp_path / "capture", tmp_path / "out"
    capture.mkdir()
    (capture / "yaleB16").symlink_to(REAL / "yaleB16")
    line = ["prepare-dataset", str(capture), "-o", str(output), "--layout", "extended-yale-b"]
    assert main([*line, "--crop", "96", "--split", "1/0/0", "--subtract-ambient", "--checks", "off"]) == 0
    said = capsys.readouterr().err
    assert "2 images that are marked as damaged" in said and "yaleB16/P00: no ambient image" in said
    dataset = read_dataset(output)
    assert len(dataset.light_ids) == 64 and len(dataset.lights_of("yaleB16")) == 62
    entry = json.loads((output / "dataset.json").read_text())["subjects"]["yaleB16"]
    assert entry["faces_found"] == 1 and entry["error_iod"] < 0.04
    assert entry["left_out"]["A+095E+00"] == "P00: marked as damaged" and entry["ambient_kept"] == ["P00"]
