"""Where lamps stand, by the names of pictures and by lists beside them."""

import math
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.capture.draft_lights import by_light, direction_in_name, read_lamps
from facerf_cli.errors import InputError

HALF, ROOT = 0.5, math.sqrt(3) / 2


@pytest.mark.parametrize(
    ("name", "direction"),
    [
        ("A+030E+00", [HALF, 0, ROOT]),  # to the picture's right
        ("x_P00A-030E+00", [-HALF, 0, ROOT]),
        ("A+000E+30", [0, HALF, ROOT]),
        ("az30_el-030", [HALF * ROOT, -HALF, ROOT * ROOT]),
        ("Azimuth_180.0_Elevation_0.0", [0, 0, -1]),
        ("A030E10", None),  # letters alone may be anything
        ("L034", None),
        ("data+3e+5", None),
        ("L_sea+1e-3", None),
        ("az720_el500", None),
        ("az400_el0", None),
        ("az0_el91", None),
    ],
)
def test_angles_in_a_name(name: str, direction: list[float] | None) -> None:
    found = direction_in_name(name)
    assert found is None if direction is None else found == pytest.approx(direction, abs=1e-6)


def listed(folder: Path, text: str) -> Path:
    (folder / "lights.lp").write_text(text)
    return folder / "lights.lp"


def test_an_lp_file_is_read_by_the_images_names(tmp_path: Path) -> None:
    path = listed(tmp_path, "3\r\nC:\\rti\\a 1.jpg 0 0 2\r\nrti/L2.jpg 0.6 0 .8\r\nL9.jpg 1 0 0\r\n")
    lamps = read_lamps(path)
    assert [lamp.length for lamp in lamps] == pytest.approx([2, 1, 1])
    assert by_light(lamps, ["L1", "L2"], {"a 1": "L1"}) == {"L1": [0, 0, 1], "L2": [0.6, 0, 0.8]}


def test_a_list_without_names_goes_by_order(tmp_path: Path) -> None:
    lamps = read_lamps(listed(tmp_path, "# x y z\n\n0 0 1\n0, 1, 0\n-1e0 0 0\n"))
    assert by_light(lamps, ["2", "10", "11"], {}) == {"2": [0, 0, 1], "10": [0, 1, 0], "11": [-1, 0, 0]}
    assert by_light(lamps, ["2", "10"], {}) == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1\nL1 0 0", "line 2 is not"),
        ("L1 0 0 1\nL2 a b c", "line 2 is not"),
        ("L1 0 0 0", "line 1 points nowhere"),
        ("L1 nan 0 0", "nowhere"),
        ("L1 inf 0 0", "nowhere"),
        ("\0\1\2", "line 1 is not"),
        ("0 0 1\n" * 1_000_000, "too large"),
    ],
)
def test_a_list_that_is_none(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_lamps(listed(tmp_path, text))


def test_directions_are_unit_to_what_stage_json_asks(tmp_path: Path) -> None:
    vectors = np.random.default_rng(1).normal(size=(50, 3))
    lamps = read_lamps(listed(tmp_path, "\n".join(" ".join(map(str, row)) for row in vectors)))
    assert np.abs(np.linalg.norm([lamp.direction for lamp in lamps], axis=1) - 1).max() < 1e-5
