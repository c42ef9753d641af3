"""The reader of Extended Yale B: names, axes, what is left out, and what is wrong with a copy of it."""

from pathlib import Path

import numpy as np
import pytest

from facerf_cli.capture.yale_b import UNMARKED_DAMAGE, Flash, YaleB, read_shifts, read_yale_b
from facerf_cli.errors import InputError
from facerf_cli.light.sphere import azel_to_direction
from tests.capture.yale_fixture import FLASHES, ramp, write_pgm, write_yale_b


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


def test_azimuth_has_the_opposite_sign_of_ours() -> None:
    flash = Flash(35, -20)  # from the viewer's left and below
    assert flash.direction[0] < 0 and flash.direction[1] < 0 < flash.direction[2]
    np.testing.assert_allclose(flash.direction, azel_to_direction(-35.0, -20.0).numpy(), atol=1e-6)
    np.testing.assert_allclose(Flash(0, 90).direction, [0, 1, 0], atol=1e-12)
    assert Flash(-60, 0).angle_deg == pytest.approx(60)


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
    assert database.marked_damaged == ["yaleB05_P00A+035E+15.pgm.bad", "yaleB05_P00A-035E+40.pgm.bad"]
    assert database.left_out == ["yaleB05_P00A+035E+40"]  # known to be two fields in one
    assert Flash(35, 40) not in database.flashes("yaleB05") and Flash(35, 40) in database.flashes("yaleB07")
    assert Flash(35, 40) in read_yale_b(folder, leave_out={}).flashes("yaleB05")
    with pytest.raises(InputError, match=r"yaleB05: no sound image under A\+035E\+40"):
        database.image("yaleB05", Flash(35, 40))
    assert sum(map(len, UNMARKED_DAMAGE.values())) == 16


def test_the_room_without_a_flash(folder: Path) -> None:
    write_pgm(folder / "yaleB05" / "yaleB05_P00_Ambient.pgm", ramp(3))
    write_pgm(folder / "yaleB07" / "yaleB07_P00_Ambient.pgm", np.zeros((480, 640)))  # as distributed
    database = read_yale_b(folder)
    ambient = database.ambient("yaleB05")
    assert ambient is not None and len(database.flashes("yaleB05")) == 8
    np.testing.assert_allclose(ambient, ramp(3) / 255, atol=1e-7)
    assert database.ambient("yaleB07") is None


def test_a_shift_moves_down_and_right(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "shifts.csv").write_text("subject,light,dy,dx,ncc\nyaleB07,A-025E+00,2,-3,0.5\n")
    database = read_yale_b(folder, read_shifts(tmp_path / "shifts.csv"))
    still, moved = (read.image("yaleB07", Flash(-25, 0)) for read in (read_yale_b(folder), database))
    np.testing.assert_array_equal(moved[2:, :-3], still[:-2, 3:])
    np.testing.assert_array_equal(moved[:2, :-3], still[[0, 0], 3:])
    np.testing.assert_array_equal(database.image("yaleB05", Flash(-25, 0)), still)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "no shifts"),
        ("subject,light,dy,dx\n", "no shifts"),
        ("subject,light,dy,dx\nyaleB01,A+000E+00,1,1\nyaleB01,front,1,1\n", "line 3"),
        ("subject,light,dy,dx\nyaleB01,A+000E+00,1.5,1\n", "line 2"),
        ("subject,light,dy,dx\nyaleB01,A+000E+00,1\n", "line 2"),
        ("subject,light,dy,dx\nyaleB01,A+000E+00,400,1\n", "line 2"),
        ("light,dy,dx\nA+000E+00,1,1\n", "line 2"),
    ],
)
def test_wrong_lists_of_shifts(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "shifts.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=complaint):
        read_shifts(path)


def test_no_list_of_shifts(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_shifts(tmp_path / "shifts.csv")


def test_folders_that_are_not_the_database(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        read_yale_b(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no folders yaleB01"):
        read_yale_b(folder / "yaleB05")
    (folder / "yaleB09").mkdir()
    with pytest.raises(InputError, match="yaleB09: no images"):
        read_yale_b(folder)


@pytest.mark.parametrize(("height", "width", "said"), [(96, 84, "84 x 96"), (480, 640, "640 x 480")])
def test_images_of_another_size(folder: Path, height: int, width: int, said: str) -> None:
    write_pgm(folder / "yaleB05" / "yaleB05_P00A+070E+00.pgm", np.zeros((height, width)))
    with pytest.raises(InputError, match=rf"A\+070E\+00.pgm: {said} pixels, not 168 x 192"):
        read_yale_b(folder).images("yaleB05")


def test_a_image_that_is_cut_short(folder: Path) -> None:
    path = folder / "yaleB05" / "yaleB05_P00A+000E+00.pgm"
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(InputError, match="cut short"):
        read_yale_b(folder).image("yaleB05", Flash(0, 0))


def test_the_database_itself(shared_data: Path) -> None:
    database: YaleB = read_yale_b(shared_data / "extended_yale_b")
    assert len(database.subjects) == 21 and len(database.marked_damaged) == 18
    assert len(database.left_out) == 10  # of the 16, whose other subjects are not in this copy
    assert [len(database.flashes(subject)) for subject in ("yaleB01", "yaleB05")] == [64, 62]
    cropped = [subject for subject in database.subjects if database.ambient(subject) is not None]
    assert len(cropped) == 10 and "yaleB05" in cropped
