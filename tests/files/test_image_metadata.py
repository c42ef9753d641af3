"""Headers of images and their XMP packets."""

import math
import os
import re
import tracemalloc
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from facerf_cli.errors import InputError
from facerf_cli.files.image_metadata import embed_xmp, plate_metadata, read_header, xmp_packet
from facerf_cli.files.olat_stack import is_olat_stack
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display, write_exr, write_tiff
from facerf_cli.image.colour import ACES, ACESCG, LINEAR, LINEAR_P3, LINEAR_REC2020, SRGB, ColourSpace
from facerf_cli.run.logs import COMPOSITE_SOURCE_TYPE, Provenance

IPTC = "{http://iptc.org/std/Iptc4xmpExt/2008-02-29/}DigitalSourceType"


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


def write_primaries(path: Path, chromaticities: tuple[float, ...], kind: str = "float[8]") -> Path:
    spec = oiio.ImageSpec(9, 6, 3, "half")
    spec.attribute("chromaticities", oiio.TypeDesc(kind), chromaticities)
    stream = oiio.ImageOutput.create(path.name)
    assert stream.open(str(path), spec) and stream.write_image(np.full((6, 9, 3), 0.5, np.float32))
    stream.close()
    return path


@pytest.mark.parametrize(
    "space", [ACES, ACESCG, LINEAR, LINEAR_P3, LINEAR_REC2020], ids=lambda space: space.name
)
def test_known_primaries_get_their_name(tmp_path: Path, space: ColourSpace) -> None:
    assert space.chromaticities is not None
    path = write_primaries(tmp_path / "a.exr", space.chromaticities)
    header = read_header(path)
    assert header is not None and header.space == space
    assert read_image(path).colourspace_name == space.name


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
    path = write_primaries(tmp_path / "a.exr", chromaticities)
    header = read_header(path)
    assert header is not None and header.space == LINEAR
    assert "impossible primaries" in caplog.text
    assert read_image(path).pixels == pytest.approx(0.5)


def test_primaries_of_another_type_are_ignored(tmp_path: Path) -> None:
    header = read_header(write_primaries(tmp_path / "a.exr", (0.3,) * 6, "float[6]"))
    assert header is not None and header.space == LINEAR


def test_a_name_that_is_not_utf8_is_an_error(tmp_path: Path) -> None:
    name = tmp_path / os.fsdecode(b"\xff.exr")
    name.write_bytes(b"not an image")
    for read in (read_header, read_image, is_olat_stack):
        with pytest.raises(InputError, match="not UTF-8; rename"):
            read(name)
    with pytest.raises(InputError, match="not UTF-8"):
        write_display(name.with_suffix(".png"), np.zeros((2, 2, 3), np.float32))


def test_a_file_that_is_no_image_has_no_header(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"not an image")
    assert read_header(tmp_path / "a.png") is None and read_header(tmp_path / "b.png") is None
    assert read_header(tmp_path) is None and oiio.geterror() == ""


def properties(data: bytes) -> dict[str, str]:
    (packet,) = re.findall(rb"<x:xmpmeta.*?</x:xmpmeta>", data, re.S)
    return ElementTree.fromstring(packet)[0][0].attrib


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


def test_attributes_without_an_xmp_name_are_left_out() -> None:
    assert b"compression" not in xmp_packet({"compression": "zip"})


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
