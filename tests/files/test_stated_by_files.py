"""What a file states of itself is followed: geometry, alpha, layers, colour. Each file is made here."""

import logging
import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from facerf_cli.errors import InputError
from facerf_cli.files import isobmff
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.light_files import read_map_file
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.image.colour import linear_to_srgb
from tests.files.made import (
    LINEAR,
    QUADS,
    TO_709,
    H,
    W,
    bt2020_of,
    levels_of,
    write_oiio,
    write_parts,
    write_png,
)
from tests.icc_profiles import press_profile

# Geometry
from tests.refusals import refused


def test_an_offset_of_a_page_moves_nothing(tmp_path: Path) -> None:
    path = write_png(tmp_path / "a.png", QUADS, (b"oFFs", struct.pack(">iiB", 3, -5, 0)))
    np.testing.assert_allclose(levels_of(path), QUADS, atol=0.1)
    tifffile.imwrite(
        tmp_path / "a.tif", QUADS, extratags=[(286, 5, 1, (3, 1), True), (287, 5, 1, (2, 1), True)]
    )
    np.testing.assert_allclose(levels_of(tmp_path / "a.tif"), QUADS, atol=0.1)


@pytest.mark.parametrize("orientation", [0, 9, 77])
def test_an_orientation_that_does_not_exist_turns_nothing(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(QUADS).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_allclose(levels_of(tmp_path / "a.png"), QUADS, atol=0.1)
    header = read_header(tmp_path / "a.png")
    assert header is not None and (header.width_px, header.height_px) == (W, H)


@pytest.mark.parametrize(
    ("aspect", "orientation", "size"), [(2.0, 1, (H, 2 * W)), (0.5, 1, (2 * H, W)), (2.0, 6, (2 * W, H))]
)
def test_pixels_become_square(tmp_path: Path, aspect: float, orientation: int, size: tuple[int, int]) -> None:
    path = write_oiio(tmp_path / "a.exr", LINEAR, PixelAspectRatio=aspect, Orientation=orientation)
    image, header = read_image(path), read_header(path)
    assert header is not None and image.pixels.shape[:2] == (header.height_px, header.width_px) == size
    corner = LINEAR[0, 0] if orientation == 1 else LINEAR[-1, 0]
    np.testing.assert_allclose(image.pixels[2, 2], corner, atol=1e-6)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "bmp"])
def test_resolutions_for_print_change_no_shape(tmp_path: Path, suffix: str) -> None:
    """300 x 72 dots an inch, and two dots to one without a unit, are shown as square pixels everywhere."""
    Image.fromarray(QUADS).save(path := tmp_path / f"a.{suffix}", dpi=(300, 72))
    image, header = read_image(path), read_header(path)
    assert header is not None and image.pixels.shape[:2] == (header.height_px, header.width_px) == (H, W)
    if suffix == "jpg":
        data = bytearray(path.read_bytes())
        data[13:18] = struct.pack(">BHH", 0, 2, 1)  # of the JFIF segment: no unit
        path.write_bytes(data)
    elif suffix == "png":
        write_png(path, QUADS, (b"pHYs", struct.pack(">IIB", 2, 1, 0)))
    elif suffix == "tif":
        tifffile.imwrite(path, QUADS, resolution=(2, 1), resolutionunit=1)
    assert read_image(path).pixels.shape[:2] == (H, W)


# Alpha


@pytest.mark.parametrize("suffix", ["jxl", "bmp", "png", "tif", "webp", "jp2", "tga"])
def test_alpha_that_is_not_multiplied_in_is_not_divided_out(tmp_path: Path, suffix: str) -> None:
    alpha = np.linspace(1, 255, W).astype(np.uint8)[None, :, None].repeat(H, 0)
    values = np.concatenate([QUADS, alpha], -1)
    path = tmp_path / f"a.{suffix}"
    if suffix == "jp2":
        Image.fromarray(values).save(path)
    else:
        write_oiio(path, values, "uint8", oiio__UnassociatedAlpha=1, compression="lossless:100")
    image = read_image(path)
    np.testing.assert_allclose(image.alpha, alpha[..., 0] / 255, atol=1e-6)
    np.testing.assert_allclose(255 * linear_to_srgb(image.pixels), QUADS, atol=1.5)


def test_a_fourth_sample_of_a_tiff_without_a_tag_is_not_multiplied_in(tmp_path: Path) -> None:
    """Integers above their alpha cannot be multiplied by it; Pillow reads such a file so, too."""
    values = np.dstack([QUADS, np.full((H, W), 100, np.uint8)])
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb", extrasamples=["assocalpha"])
    data = (tmp_path / "a.tif").read_bytes()
    extra_samples, unknown = struct.pack("<HHI", 338, 3, 1), struct.pack("<HHI", 65000, 3, 1)
    assert data.count(extra_samples) == 1
    (tmp_path / "a.tif").write_bytes(data.replace(extra_samples, unknown))
    np.testing.assert_allclose(levels_of(tmp_path / "a.tif"), QUADS, atol=0.1)
    np.testing.assert_allclose(read_image(tmp_path / "a.tif").alpha, 100 / 255, atol=1e-6)


def test_associated_integers_stay_within_white(tmp_path: Path) -> None:
    """Rounding makes a colour of small alpha larger than it."""
    values = np.dstack([np.full((H, W, 3), 3, np.uint8), np.full((H, W), 2, np.uint8)])
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb", extrasamples=["assocalpha"])
    assert read_image(tmp_path / "a.tif").pixels.max() == 1


def test_alpha_and_codes_of_a_heif(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As pi-heif reports them: alpha that is multiplied in, and HLG, which is refused."""
    (path := tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic")
    values = np.dstack([QUADS // 2, np.full((H, W), 128, np.uint8)])
    stated = {"shape": np.array([H, W, 4]), "bits": np.array(8), "is_associated": np.array(True)}
    found = {**stated, "pixels": values, "codes": np.array([1, 13])}
    monkeypatch.setattr(isobmff, "read_in_subprocess", lambda *_: found)
    np.testing.assert_allclose(levels_of(path), QUADS, atol=2)
    found["codes"] = np.array([9, 18])
    refused(InputError, "a.heic: HDR (HLG)", read_image, path)


@pytest.mark.parametrize(("suffix", "is_alpha"), [("bmp", False), ("png", True), ("webp", True)])
def test_an_empty_fourth_byte_of_a_bmp_is_no_alpha(tmp_path: Path, suffix: str, is_alpha: bool) -> None:
    """A PNG or WebP has four channels only to be transparent."""
    values = np.dstack([QUADS, np.zeros((H, W), np.uint8)])
    path = write_oiio(tmp_path / f"a.{suffix}", values, "uint8", oiio__UnassociatedAlpha=1)
    assert (read_image(path).alpha is not None) == is_alpha
    if not is_alpha:
        np.testing.assert_allclose(levels_of(path), QUADS, atol=0.1)


@pytest.mark.parametrize(("bits", "alpha"), [(0, None), (8, 99 / 255)])
def test_the_fourth_channel_of_a_tga(tmp_path: Path, bits: int, alpha: float | None) -> None:
    """It is alpha where the descriptor counts its bits."""
    head = struct.pack("<BBB9xHHBB", 0, 0, 2, W, H, 32, 0x20 | bits)
    values = np.dstack([QUADS[..., ::-1], np.full((H, W), 99, np.uint8)])
    (tmp_path / "a.tga").write_bytes(head + values.tobytes())
    image = read_image(tmp_path / "a.tga")
    np.testing.assert_allclose(image.pixels, LINEAR, atol=1e-6)
    assert image.alpha is None if alpha is None else image.alpha == pytest.approx(alpha)


def test_alpha_of_a_map_is_no_light_and_layers_have_names(tmp_path: Path) -> None:
    values = np.full((8, 16, 4), 0.3, np.float32)
    values[..., 3] = np.linspace(0, 1, 16)
    assert read_map_file(write_oiio(tmp_path / "map.exr", values)).numpy() == pytest.approx(0.3)
    write_exr(tmp_path / "a.exr", LINEAR, layers={"albedo": 1 - LINEAR})
    albedo = read_image(tmp_path / "a.exr", layer="Albedo").pixels
    np.testing.assert_allclose(albedo, 1 - LINEAR, atol=1e-3)


# Layers

COLOURS = ("R", "G", "B")


def test_the_image_of_an_exr_is_chosen_by_its_name(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "facerf")
    other, depth = 1 - LINEAR, LINEAR[..., :1]
    in_layers = [f"V.{layer}.{letter}" for layer in ("AO", "Combined") for letter in "RGB"]
    for name, parts, layers in [
        ("depth_first", [("depth", depth, ("Z",)), ("rgba", LINEAR, COLOURS)], ["rgba", "depth"]),
        ("albedo_first", [("albedo", other, COLOURS), ("main", LINEAR, COLOURS)], ["main", "albedo"]),
        ("beauty", [("diffuse", other, COLOURS), ("beauty", LINEAR, COLOURS)], ["beauty", "diffuse"]),
        ("blender", [("", np.dstack([other, LINEAR]), tuple(in_layers))], ["V.Combined", "V.AO"]),
        ("nuke", [("", LINEAR, ("fill.red", "fill.green", "fill.blue"))], ["fill"]),
        ("plain", [("rgba", LINEAR, COLOURS), ("albedo", other, COLOURS)], []),
    ]:
        caplog.clear()
        path = write_parts(tmp_path / f"{name}.exr", parts, "float", oiio__ColorSpace="lin_rec709_scene")
        np.testing.assert_array_equal(read_image(path).pixels, LINEAR, err_msg=name)
        lines = [record.getMessage() for record in caplog.records]
        assert len(lines) == bool(layers) and all(layer in line for line in lines for layer in layers)
    assert read_header(path).width_px == W


# Colour


@pytest.mark.parametrize("suffix", ["jpg", "webp"])
def test_exif_of_dcf_says_adobe_rgb(tmp_path: Path, suffix: str) -> None:
    """R03 in the interoperability directory, as cameras write; a space that is only uncalibrated is sRGB."""
    for index, name in (("R03", "Adobe RGB"), ("R98", "sRGB")):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0xA001: 65535, 0xA005: {1: index}})  # ColorSpace, and the directory
        path = tmp_path / f"{name}.{suffix}"
        Image.fromarray(QUADS).save(path, exif=exif.tobytes(), quality=98)
        assert read_image(path).colourspace_name == name


def test_codes_of_bt2020(tmp_path: Path) -> None:
    levels = np.round(255 * bt2020_of(LINEAR)).astype(np.uint8)
    path = write_png(tmp_path / "a.png", levels, (b"cICP", bytes([9, 14, 0, 1])))
    np.testing.assert_allclose(levels_of(path), QUADS, atol=4)
    narrow = write_png(tmp_path / "b.png", levels, (b"cICP", bytes([9, 14, 0, 0])))
    refused(InputError, "b.png: narrow-range ... convert it to full range", read_image, narrow)


def test_primaries_and_gamma_of_a_png(tmp_path: Path) -> None:
    """Rec.2020 primaries at gamma 2, against the matrix of BT.2087."""
    xy = (0.3127, 0.3290, 0.708, 0.292, 0.170, 0.797, 0.131, 0.046)
    stored = np.round(255 * bt2020_of(LINEAR).clip(0, 1)).astype(np.uint8)  # any values
    chunks = (
        (b"gAMA", struct.pack(">I", 50000)),
        (b"cHRM", struct.pack(">8I", *(round(value * 100000) for value in xy))),
    )
    path = write_png(tmp_path / "a.png", stored, *chunks)
    np.testing.assert_allclose(read_image(path).pixels, (stored / 255) ** 2 @ TO_709.T, atol=1e-3)
    with_srgb = write_png(tmp_path / "b.png", QUADS, *chunks, (b"sRGB", b"\0"))
    np.testing.assert_allclose(levels_of(with_srgb), QUADS, atol=0.1)


@pytest.mark.parametrize("suffix", ["jpg", "tif"])
def test_inks_with_a_profile(tmp_path: Path, suffix: str) -> None:
    """Of a press whose cyan is grey: L* 50 where the product of the inks is cyan."""
    inks = np.zeros((H, W, 4), np.uint8)
    inks[:, W // 2 :, 0] = 255
    path = tmp_path / f"a.{suffix}"
    more = {"quality": 100} if suffix == "jpg" else {}
    Image.fromarray(inks, "CMYK").save(path, icc_profile=press_profile(), **more)
    linear = read_image(path).pixels
    np.testing.assert_allclose(linear[:, : W // 2 - 1], 1, atol=0.02)
    np.testing.assert_allclose(linear[:, W // 2 + 1 :], ((50 + 16) / 116) ** 3, atol=0.006)
    for profile in (None, b"broken" * 50):
        Image.fromarray(inks, "CMYK").save(path, icc_profile=profile, **more)
        refused(InputError, "CMYK without a valid profile ... convert it to RGB", read_image, path)
