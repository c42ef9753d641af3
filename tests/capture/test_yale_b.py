"""Extended Yale B: its files and shifts, and the database read as a capture."""

import json
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.capture.layouts import read_capture
from facerf_cli.capture.settings import ReadSettings
from facerf_cli.capture.yale_b import UNMARKED_DAMAGE, Flash, YaleB, read_shifts, read_yale_b
from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.files.write import write_exr
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.main import main
from tests.capture.yale_fixture import FLASHES, ramp, write_pgm, write_yale_b
from tests.worlds import write_flat_stage


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_yale_b(tmp_path / "yale")


@pytest.mark.parametrize("name", ["A+000E+00", "A-035E+40", "A+110E-20", "A+000E+90", "A-005E-10"])
def test_names_are_those_of_the_files(name: str) -> None:
    flash = Flash.named(name)
    assert flash is not None and flash.name == name


@pytest.mark.parametrize("name", ["_Ambient", "A35E40", "A+035E-20x", "A+0350E+00", ""])
def test_other_names_are_no_flashes(name: str) -> None:
    assert Flash.named(name) is None


def test_azimuth_has_the_opposite_sign_and_a_face_fills_the_image_at_a_metre(folder: Path) -> None:
    flash = Flash(35, -20)  # from the viewer's left and below
    assert flash.direction[0] < 0 and flash.direction[1] < 0 < flash.direction[2]
    np.testing.assert_allclose(flash.direction, azel_to_direction(-35.0, -20.0).numpy(), atol=1e-6)
    np.testing.assert_allclose(Flash(0, 90).direction, [0, 1, 0], atol=1e-12)
    assert Flash(-60, 0).angle_deg == pytest.approx(60)
    camera = read_capture(folder, ReadSettings("extended-yale-b")).cameras["P00"]
    across_px = 0.089 * camera.focal_px[0]  # the outer corners of the eyes, a metre away
    assert 0.4 * camera.width_px < across_px < 0.6 * camera.width_px


def test_what_is_there(folder: Path) -> None:
    database = read_yale_b(folder)
    assert database.subjects == ["yaleB05", "yaleB07"]
    assert database.flashes("yaleB07") == sorted(FLASHES)
    frontal = database.image("yaleB07", Flash(0, 0))
    assert frontal.shape == (192, 168) and frontal.dtype == np.float32
    np.testing.assert_allclose(frontal, ramp(0) / 255, atol=1e-7)  # no curve
    assert database.images("yaleB07").shape == (9, 192, 168)


def test_damaged_images_are_left_out_and_counted(folder: Path) -> None:
    for angles in ("A-035E+40", "A+035E+15"):
        write_pgm(folder / "yaleB05" / f"yaleB05_P00{angles}.pgm.bad", ramp(0))
    database = read_yale_b(folder)
    assert database.marked == {"yaleB05": {Flash(-35, 40), Flash(35, 15)}, "yaleB07": frozenset()}
    assert database.left_out == ["yaleB05_P00A+035E+40"]  # known to be two fields in one
    assert Flash(35, 40) not in database.flashes("yaleB05") and Flash(35, 40) in database.flashes("yaleB07")
    assert Flash(35, 40) in read_yale_b(folder, leave_out={}).flashes("yaleB05")
    assert sum(map(len, UNMARKED_DAMAGE.values())) == 16


def test_a_shift_moves_down_and_right(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "shifts.csv").write_text("subject,light,dy,dx,ncc\nyaleB07,A-025E+00,2,-3,0.5\n")
    database = read_yale_b(folder, read_shifts(tmp_path / "shifts.csv"))
    still, moved = (read.image("yaleB07", Flash(-25, 0)) for read in (read_yale_b(folder), database))
    np.testing.assert_array_equal(moved[2:, :-3], still[:-2, 3:])
    np.testing.assert_array_equal(moved[:2, :-3], still[[0, 0], 3:])
    np.testing.assert_array_equal(database.image("yaleB05", Flash(-25, 0)), still)


def test_the_database_itself(shared_data: Path) -> None:
    database: YaleB = read_yale_b(shared_data / "extended_yale_b")
    assert len(database.subjects) == 21 and sum(map(len, database.marked.values())) == 18
    assert len(database.left_out) == 10  # of the 16, whose other subjects are not in this copy
    assert [len(database.flashes(subject)) for subject in ("yaleB01", "yaleB05")] == [64, 62]


REAL = Path(__file__).parents[3] / "shared/data/extended_yale_b"


def test_lights_are_those_of_the_names(tmp_path: Path) -> None:
    capture = read_capture(write_yale_b(tmp_path), ReadSettings("extended-yale-b"))
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
    capture = read_capture(tmp_path, ReadSettings("extended-yale-b"))
    assert name in capture.light_ids and capture.marked["yaleB07"] == {name}
    assert capture.frame_path("yaleB07", "P00", name) == path and not path.exists()


def test_the_rooms_light_is_subtracted_where_it_was_cropped(tmp_path: Path) -> None:
    write_yale_b(tmp_path)
    write_pgm(tmp_path / "yaleB05/yaleB05_P00_Ambient.pgm", np.full((192, 168), 51))
    write_pgm(tmp_path / "yaleB07/yaleB07_P00_Ambient.pgm", np.full((480, 640), 51))  # as some are
    plain, less = (
        read_capture(tmp_path, ReadSettings("extended-yale-b", subtract)) for subtract in (False, True)
    )
    for subject, level in (("yaleB05", 0.2), ("yaleB07", 0.0)):
        difference = plain.frame(subject, "P00", 3) - less.frame(subject, "P00", 3)
        np.testing.assert_allclose(difference, level, atol=1e-6)
        assert (less.ambient(subject, "P00") is None) == (level == 0)


def test_a_stage_may_name_its_ambient_images(tmp_path: Path) -> None:
    write_flat_stage(tmp_path, ambient="{subject}/{camera}/dark.exr")
    write_exr(tmp_path / "0000/C0/dark.exr", np.full((60, 64, 3), 0.5, np.float32))
    capture = read_capture(tmp_path, ReadSettings(subtract_ambient=True))
    assert capture.frame("0000", "C0", 0)[5, 5] == pytest.approx([1.75, 0.875, 0.4375])  # the black level too


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
