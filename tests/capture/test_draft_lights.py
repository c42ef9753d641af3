"""Directions of lights from lists next to the images."""

from pathlib import Path

import numpy as np
import pytest

from facerf_cli.capture.draft_lights import match_lights, read_light_list
from facerf_cli.errors import InputError


def listed(folder: Path, text: str) -> Path:
    (folder / "lights.lp").write_text(text)
    return folder / "lights.lp"


def test_an_lp_file_is_read_by_the_images_names(tmp_path: Path) -> None:
    path = listed(tmp_path, "3\r\nC:\\rti\\a 1.jpg 0 0 2\r\nrti/L2.jpg 0.6 0 .8\r\nL9.jpg 1 0 0\r\n")
    lights = read_light_list(path)
    assert [name for name, _ in lights] == ["C:\\rti\\a 1.jpg", "rti/L2.jpg", "L9.jpg"]
    assert match_lights(lights, ["L1", "L2"], {"a 1": "L1"}) == {"L1": [0, 0, 1], "L2": [0.6, 0, 0.8]}


def test_a_list_without_names_goes_by_order(tmp_path: Path) -> None:
    lights = read_light_list(listed(tmp_path, "# x y z\n\n0 0 1\n0, 1, 0\n-1e0 0 0\n"))
    expected = {"2": [0, 0, 1], "10": [0, 1, 0], "11": [-1, 0, 0]}
    assert match_lights(lights, ["2", "10", "11"], {}) == expected
    assert match_lights(lights, ["2", "10"], {}) == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1\nL1 0 0", "line 2 is wrong"),
        ("L1 0 0 1\nL2 a b c", "line 2 is wrong"),
        ("L1 0 0 0", "line 1 has no direction"),
        ("L1 nan 0 0", "no direction"),
        ("L1 inf 0 0", "no direction"),
        ("\0\1\2", "line 1 is wrong"),
        ("0 0 1\n" * 1_000_000, "too large"),
    ],
)
def test_a_wrong_list_is_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_light_list(listed(tmp_path, text))


def test_directions_are_unit_to_what_stage_json_asks(tmp_path: Path) -> None:
    vectors = np.random.default_rng(1).normal(size=(50, 3))
    lights = read_light_list(listed(tmp_path, "\n".join(" ".join(map(str, row)) for row in vectors)))
    lengths = np.linalg.norm([direction for _, direction in lights], axis=1)
    assert np.abs(lengths - 1).max() < 1e-5
