"""AVIF: depth, colour, alpha, orientation; and what is damaged.

deep.avif has 12 bits, 4:4:4, Display P3, alpha .4; multiplied.avif the same with the colour multiplied by
alpha; limited.avif 10 bits, 4:2:0, limited range. All show QUADS in the values that they store.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from facerf_cli.errors import InputError
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.isobmff import open_avif
from facerf_cli.files.read import read_image
from facerf_cli.run import memory
from tests import icc_profiles
from tests.files.made import levels_of
from tests.kinds import Log, Patch
from tests.refusals import refused

H, W = 16, 24
CORNERS = np.array([[200, 60, 40], [40, 180, 60], [50, 70, 200], [255, 255, 255]], np.uint8)
QUADS = CORNERS.reshape(2, 2, 3).repeat(H // 2, 0).repeat(W // 2, 1)  # no symmetry
INSIDE = np.ix_([2, H - 3], [2, W - 3])  # near the corners, away from the edges of colours
DEEP, MULTIPLIED, LIMITED = (
    Path(__file__).with_name(f"{name}.avif") for name in ("deep", "multiplied", "limited")
)


def stored(path: Path) -> np.ndarray:
    return levels_of(path, "sRGB")


def save(path: Path, values: np.ndarray, **options: object) -> Path:
    Image.fromarray(values).save(path, "AVIF", quality=100, subsampling="4:4:4", **options)
    return path


@pytest.mark.parametrize("path", [DEEP, MULTIPLIED, LIMITED], ids=lambda path: path.stem)
def test_ten_and_twelve_bits_keep_their_depth(path: Path, caplog: Log) -> None:
    """Nearer than a value of 8 bits is, which the same files miss by 1 and more."""
    image, header = read_image(path), read_header(path)
    np.testing.assert_allclose(stored(path)[INSIDE], QUADS[INSIDE], atol=0.4)
    assert stored(path).max() == pytest.approx(255, abs=1e-3)  # white of any range is white
    assert header is not None and header.bits == 16 and (header.width_px, header.height_px) == (W, H)
    assert image.colourspace_name == ("sRGB" if path == LIMITED else "Display P3")
    if path == LIMITED:
        assert image.alpha is None
    else:
        np.testing.assert_allclose(image.alpha, 0.4, atol=1e-4)
    assert caplog.text == ""


def test_without_pyav_a_line_says_that_bits_are_lost(caplog: Log, monkeypatch: Patch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    image = read_image(MULTIPLIED)
    np.testing.assert_allclose(255 * image.alpha, 102, atol=1e-3)
    (record,) = caplog.records
    said = record.getMessage()
    assert "multiplied.avif" in said and "12 bits" in said and "pip install 'facerf[video]'" in said
    np.testing.assert_allclose(stored(MULTIPLIED)[INSIDE], QUADS[INSIDE], atol=4)  # of 8 bits, divided by .4


@pytest.mark.parametrize("multiplied", [False, True])
def test_alpha_of_eight_bits(tmp_path: Path, multiplied: bool) -> None:
    alpha = np.full((H, W, 1), 102, np.uint8)
    path = save(tmp_path / "a.avif", np.dstack([QUADS, alpha]), alpha_premultiplied=multiplied)
    assert open_avif(path)[0].get_int_attribute("oiio:UnassociatedAlpha") == (not multiplied)
    np.testing.assert_allclose(read_image(path).alpha, 0.4, atol=1e-6)
    np.testing.assert_allclose(stored(path)[INSIDE], QUADS[INSIDE], atol=4 if multiplied else 1.5)


def test_grey_orientation_and_a_profile_count_under_another_name(tmp_path: Path) -> None:
    grey = QUADS[..., 0]
    np.testing.assert_allclose(stored(save(tmp_path / "g.avif", grey))[..., 2], grey, atol=1.5)
    exif = Image.Exif()
    exif[0x0112] = 6
    path = save(tmp_path / "a.jpg", QUADS, exif=exif)
    header = read_header(path)
    assert header is not None and (header.width_px, header.height_px, header.bits) == (H, W, 8)
    np.testing.assert_allclose(stored(path), np.rot90(QUADS, -1), atol=2.5)
    path = save(tmp_path / "a.avif", QUADS, icc_profile=icc_profiles.DISPLAY_P3)
    assert read_image(path).colourspace_name == "Display P3"
    memory.set_limit(H * W * 36 - 1)
    with pytest.raises(InputError, match=r"deep\.avif: 24 x 16 pixels: needs \S+ GB of memory"):
        read_image(DEEP)


@pytest.mark.parametrize("size", [30, 150, -30, -1])
def test_a_damaged_one_of_eight_bits(tmp_path: Path, size: int, caplog: Log) -> None:
    path = save(tmp_path / "a.avif", QUADS)
    path.write_bytes(path.read_bytes()[:size])
    refused(InputError, "a.avif: damaged or cut short; copy it again", read_image, path)
    assert caplog.text == ""
