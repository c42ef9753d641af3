"""Headers of pictures, read without their pixels."""

import os
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from facerf_cli.colour import LINEAR, SRGB
from facerf_cli.errors import InputError
from facerf_cli.files.headers import read_header
from facerf_cli.files.images import read_image, write_display, write_exr
from facerf_cli.files.olat_stack import is_olat_stack


def test_size_kind_and_space(tmp_path: Path) -> None:
    pixels = np.zeros((6, 9, 3), np.float32)
    write_exr(tmp_path / "a.exr", pixels)
    write_display(tmp_path / "a.png", pixels)
    floating, display = read_header(tmp_path / "a.exr"), read_header(tmp_path / "a.png")
    assert floating is not None and display is not None
    assert (floating.width_px, floating.height_px, floating.is_floating, floating.space) == (
        9,
        6,
        True,
        LINEAR,
    )
    assert (display.width_px, display.height_px, display.bits, display.space) == (9, 6, 8, SRGB)


def test_the_size_is_upright(tmp_path: Path) -> None:
    spec = oiio.ImageSpec(9, 6, 3, "uint8")
    spec.attribute("Orientation", 6)
    stream = oiio.ImageOutput.create("a.jpg")
    assert stream.open(str(tmp_path / "a.jpg"), spec) and stream.write_image(np.zeros((6, 9, 3), np.uint8))
    stream.close()
    header = read_header(tmp_path / "a.jpg")
    assert header is not None and (header.width_px, header.height_px) == (6, 9)


def test_a_name_that_is_not_utf8_is_said(tmp_path: Path) -> None:
    name = tmp_path / os.fsdecode(b"\xff.png")
    name.write_bytes(b"no picture")
    for read in (read_header, read_image, is_olat_stack):
        with pytest.raises(InputError, match="not UTF-8; rename"):
            read(name)
    with pytest.raises(InputError, match="not UTF-8"):
        write_display(name, np.zeros((2, 2, 3), np.float32))


def test_no_picture_has_no_header(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no picture")
    assert read_header(tmp_path / "a.png") is None and read_header(tmp_path / "b.png") is None
    assert read_header(tmp_path) is None and oiio.geterror() == ""
