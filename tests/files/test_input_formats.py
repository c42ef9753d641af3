"""Every format that folders are searched for: its pixels, its orientation, its colour space."""

import logging
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from facerf_cli.batch.inputs import PHOTO_SUFFIXES
from facerf_cli.errors import InputError
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear
from facerf_cli.run import memory
from tests import icc_profiles
from tests.files.made import LEVELS, levels_of, write_oiio, write_png, write_psd

ULTRA_HDR = Path(__file__).with_name("ultra_hdr.jpg")  # examples/astronaut.jpg, with a gain map
QUADS = Path(__file__).with_name("quads.heic")  # 600 x 400: its pixels outgrow what a small allocation keeps
HEIC = Path(__file__).with_name("phone.heic")  # upright: green above red on the left, blue below right
BLOCKS = np.repeat(np.repeat(LEVELS[::8, ::8], 8, 0), 8, 1)  # which lossy formats keep roughly
LOSSY = {
    **dict.fromkeys((".jpg", ".jpeg", ".jpe", ".jfif"), 3),
    ".gif": 1,
    ".avif": 2,
    ".webp": 12,
}  # largest error inside a block, of 255


def save(path: Path, levels: np.ndarray) -> Path:
    """Write 8-bit sRGB values in the format of the suffix."""
    suffix = path.suffix
    if suffix in (".heic", ".heif"):
        shutil.copy(HEIC, path)
    elif suffix == ".psd":
        write_psd(path, levels)
    elif suffix == ".jp2":
        Image.fromarray(levels).save(path)  # OpenImageIO writes files that it does not read
    elif suffix == ".avif":
        Image.fromarray(levels).save(path, quality=100, subsampling="4:4:4")
    elif suffix in (".exr", ".hdr"):
        write_oiio(path, levels / np.float32(255), "float")
    else:
        write_oiio(path, levels, "uint8", **({"CompressionQuality": 98} if suffix in LOSSY else {}))
    return path


@pytest.mark.parametrize("suffix", sorted(PHOTO_SUFFIXES - {".heic", ".heif", ".cin"}))
def test_every_suffix_that_folders_are_searched_for_is_read(tmp_path: Path, suffix: str) -> None:
    lossy = suffix in LOSSY
    levels = BLOCKS if lossy else LEVELS
    image = read_image(save(tmp_path / f"a{suffix}", levels))
    found = image.pixels if suffix in (".exr", ".hdr") else linear_to_srgb(image.pixels)
    inside = np.s_[3::8, 3::8] if lossy else np.s_[:]
    error = np.abs(255 * found - levels)[inside]
    assert error.max() < {".hdr": 2.1}.get(suffix, 0.6) + LOSSY.get(suffix, 0)


def test_photos_of_phones_under_any_name(tmp_path: Path) -> None:
    image = read_image(HEIC)
    assert image.colourspace_name == "Display P3" and image.pixels.shape == (64, 48, 3)
    stored = levels_of(HEIC, "sRGB")
    for at, level in {(5, 5): (40, 200, 60), (-5, 5): (50, 60, 210), (5, -5): (220, 60, 40)}.items():
        np.testing.assert_allclose(stored[at], level, atol=4)
    # Pixels outlive the memory of pi-heif's image.
    stored = levels_of(QUADS)
    assert stored.shape == (400, 600, 3)
    for at, level in {
        (9, 9): (200, 60, 40), (9, -9): (40, 180, 60), (-9, 9): (50, 70, 200), (-9, -9): (128, 128, 128),
    }.items():  # fmt: skip
        np.testing.assert_allclose(stored[at], level, atol=4)
    shutil.copy(HEIC, tmp_path / "a.jpg")
    assert read_image(tmp_path / "a.jpg").pixels.shape == (64, 48, 3)
    header = read_header(tmp_path / "a.jpg")
    assert header is not None and (header.height_px, header.width_px, header.bits) == (64, 48, 8)
    memory.set_limit(48 * 64 * 24 - 1)
    with pytest.raises(
        InputError, match=r"phone\.heic: \d+ x \d+ pixels: needs \S+ GB of memory, .* --memory"
    ):
        read_image(HEIC)


def by_pillow(levels: np.ndarray, path: Path, orientation: int) -> Path:
    exif = Image.Exif()
    exif[0x0112] = orientation
    lossless = {"lossless": True} if path.suffix == ".webp" else {"quality": 98, "subsampling": 0}
    Image.fromarray(levels).save(path, exif=exif.tobytes(), **lossless)
    return path


@pytest.mark.parametrize("suffix", ["png", "tif", "webp", "jpg"])
def test_exif_orientations_turn_a_photo_upright_once(tmp_path: Path, suffix: str) -> None:
    """All eight, against Pillow's own transposition; what is written of it needs no turning."""
    for orientation in range(1, 9):
        path = by_pillow(BLOCKS, tmp_path / f"{orientation}.{suffix}", orientation)
        with Image.open(path) as stored:
            expected = np.asarray(ImageOps.exif_transpose(stored))
        image = read_image(path)
        np.testing.assert_allclose(255 * linear_to_srgb(image.pixels), expected, atol=1.1)
    write_display(tmp_path / "out.jpg", image.pixels)
    with Image.open(tmp_path / "out.jpg") as written:
        assert written.getexif().get(0x0112, 1) == 1 and written.size == image.pixels.shape[1::-1]


def test_a_psd_has_its_profile_and_its_composite(tmp_path: Path) -> None:
    image = read_image(write_psd(tmp_path / "a.psd", LEVELS, (1039, icc_profiles.DISPLAY_P3)))
    assert image.colourspace_name == "Display P3"
    # Photoshop says so in the resource of its version.
    resources = (1039, b"odd"), (1057, struct.pack(">IB", 1, 1) + bytes(12))
    assert read_image(write_psd(tmp_path / "a.psd", LEVELS, *resources)).pixels.shape == LEVELS.shape
    # Primaries of P3 (12), the curve of sRGB (13).
    path = write_png(tmp_path / "a.png", LEVELS, (b"cICP", bytes([12, 13, 0, 1])))
    assert read_image(path).colourspace_name == "Display P3"


def test_floats_without_a_stated_space_are_one_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "facerf")
    values = LEVELS / np.float32(255)
    for name, attributes, lines in (
        ("bare.exr", {}, 1),
        ("stated.exr", {"oiio__ColorSpace": "lin_ap1_scene"}, 0),
        ("bare.tif", {}, 1),
        ("a.hdr", {}, 0),  # Radiance files are Rec.709
    ):
        caplog.clear()
        read_image(write_oiio(tmp_path / name, values, "float", **attributes))
        said = [record.getMessage() for record in caplog.records]
        assert len(said) == lines
        assert all(name in line and "linear Rec.709" in line for line in said)
    caplog.clear()
    read_image(tmp_path / "bare.exr", "ACEScg")
    read_image(write_oiio(tmp_path / "a.png", LEVELS, "uint8"))
    assert not caplog.records


def test_an_ultra_hdr_jpeg_is_decoded_once() -> None:
    """Linear with the gain map applied, in the map's primaries: Rec.709, while the base is Display P3."""
    image = read_image(ULTRA_HDR)
    with Image.open(ULTRA_HDR.parents[2] / "examples" / "astronaut.jpg") as photo:
        expected = srgb_to_linear(np.asarray(photo.resize((256, 256))) / np.float32(255))
    assert image.alpha is None and image.colourspace_name == "linear Rec.709"
    np.testing.assert_allclose(image.pixels.mean((0, 1)), expected.mean((0, 1)), rtol=0.02)
    assert np.abs(image.pixels - expected).mean() < 0.01
