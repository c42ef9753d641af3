"""Headers of images and their XMP packets."""

import math
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from facerf_cli.files.image_metadata import (
    COMPOSITE_SOURCE_TYPE,
    Provenance,
    embed_xmp,
    plate_metadata,
    read_header,
    xmp_packet,
)
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display, write_exr, write_tiff
from facerf_cli.image.colour import LINEAR
from tests.files.made import IPTC, properties, write_oiio


def test_size_kind_and_space_upright(tmp_path: Path) -> None:
    pixels = np.zeros((6, 9, 3), np.float32)
    write_exr(tmp_path / "a.exr", pixels)
    write_display(tmp_path / "a.png", pixels)
    floating, display = read_header(tmp_path / "a.exr"), read_header(tmp_path / "a.png")
    assert floating is not None and display is not None
    for header, *kind in ((floating, True, 16), (display, False, 8)):
        assert [header.width_px, header.height_px, header.is_floating, header.bits] == [9, 6, *kind]
    header = read_header(
        write_oiio(tmp_path / "a.jpg", np.zeros((6, 9, 3), np.uint8), "uint8", Orientation=6)
    )
    assert header is not None and (header.width_px, header.height_px) == (6, 9)


def write_primaries(path: Path, chromaticities: tuple[float, ...]) -> Path:
    return write_oiio(path, np.full((6, 9, 3), 0.5, np.float32), "half", chromaticities=chromaticities)


@pytest.mark.parametrize(
    "chromaticities",
    [
        (0.3, 0.3) * 4,
        (0.0,) * 8,
        (math.nan,) * 8,
        (1e30, 0.3, 0.3, 1e30, 0.1, 0.1, 0.3, 0.3),
        (0.6, 0.0, 0.3, 0.6, 0.1, 0.1, 0.3, 0.3),
        (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.7, 0.7),
    ],
    ids=["one point", "zero", "NaN", "huge", "a primary without luminance", "white outside"],
)
def test_impossible_primaries_are_ignored(
    tmp_path: Path, chromaticities: tuple[float, ...], caplog: pytest.LogCaptureFixture
) -> None:
    image = read_image(write_primaries(tmp_path / "a.exr", chromaticities))
    assert "impossible primaries" in caplog.text
    assert image.pixels == pytest.approx(0.5) and image.colourspace_name == LINEAR.name


def test_other_primaries_and_attributes_are_left_out(tmp_path: Path) -> None:
    image = read_image(write_primaries(tmp_path / "a.exr", (0.3,) * 6))
    assert image.colourspace_name == LINEAR.name
    assert b"compression" not in xmp_packet({"compression": "zip"})


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_xmp_marks_a_display_image_as_synthetic(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    pixels = np.full((9, 14, 3), 0.25, np.float32)
    write_display(path, pixels, metadata=Provenance('a "b" <c> ü.jpg', "default").attributes())
    found = properties(path.read_bytes())
    assert found[IPTC] == COMPOSITE_SOURCE_TYPE and found["{urn:facerf:1}synthetic"] == "1"
    assert found["{urn:facerf:1}input"] == 'a "b" <c> ü.jpg'
    np.testing.assert_allclose(read_image(path).pixels, pixels, atol=0.01)  # and is still readable


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif"])
def test_a_packet_is_added_without_the_file_in_memory(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    noise = np.random.default_rng(0).random((700, 900, 3), np.float32)
    write_tiff(path, noise) if suffix == "tif" else write_display(path, noise)
    size = path.stat().st_size
    tracemalloc.start()
    embed_xmp(path, {"facerf:input": "another.jpg"})
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert b"another.jpg" in path.read_bytes() and list(tmp_path.iterdir()) == [path]
    assert most < size / 4
    assert read_image(path).pixels.shape == noise.shape


def test_results_keep_how_a_photo_was_made_and_no_names_or_numbers_of_people_and_devices(
    tmp_path: Path,
) -> None:
    exif = Image.Exif()
    exif[0x010F], exif[0x013B], exif[0x8298] = "Maker", "Jane Artist", "(c) Jane"
    exif.get_ifd(0x8769).update({0x829D: 2.8, 0x8827: 400, 0xA434: "50 mm"})
    private = {0xA420: "UNIQUE-ID", 0xA430: "Jane Owner", 0xA431: "SN-1", 0xA435: "LENS-SN-2"}
    exif.get_ifd(0x8769).update({**private, 0x9286: b"ASCII\0\0\0remark", 0x927C: b"note"})
    Image.fromarray(np.zeros((6, 9, 3), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    header = read_header(tmp_path / "a.jpg")
    assert header is not None and "Jane Owner" in header.metadata.values()  # which the file has
    kept = plate_metadata(header.metadata)
    assert kept.items() >= {"Make": "Maker", "Exif:LensModel": "50 mm"}.items()
    assert kept.keys() <= {"Make", "Exif:LensModel", "Exif:PhotographicSensitivity", "FNumber"}
    assert plate_metadata({"cameraSerialNumber": "1", "cameraUuid": "2", "lensModel": "x"}) == {
        "lensModel": "x"
    }


def test_results_keep_what_an_exr_says_of_its_shot(tmp_path: Path) -> None:
    """In its own types, since another program reads them by their types."""
    said: dict[str, Any] = {
        "focalLength": 50.0,
        "framesPerSecond": (24000, 1001),
        "smpte:TimeCode": (0x01020344, 7),
        "smpte:KeyCode": (1, 2, 3, 4, 5, 6, 7),
        "cameraColorBalance": (1.5, 2.0),
        "tStop": 2.5,
        "reelName": "A001",
    }
    write_exr(tmp_path / "a.exr", np.zeros((4, 6, 3), np.float32), metadata=said)
    for name, copy in (("a.exr", "b.exr"), ("b.exr", "c.exr")):
        header = read_header(tmp_path / name)
        assert header is not None
        kept = plate_metadata(header.metadata)
        assert kept.items() >= said.items()
        write_exr(tmp_path / copy, np.zeros((4, 6, 3), np.float32), metadata=kept)
