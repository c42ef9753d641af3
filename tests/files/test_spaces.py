"""ICC profiles, against littleCMS in Pillow."""

import io
import logging
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms

from facerf_cli.errors import InputError
from facerf_cli.files.icc import linear_profile, space_of_profile
from facerf_cli.files.read import read_image
from facerf_cli.image import colour
from tests import icc_profiles
from tests.kinds import Log
from tests.refusals import refused

COLOURS = np.random.default_rng(5).integers(30, 226, (12, 17, 3), np.uint8)
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))


def by_littlecms(pixels: np.ndarray, profile: bytes) -> np.ndarray:
    """8-bit sRGB of 8-bit values in the space of a profile, colorimetric, clipped to the gamut of sRGB."""
    source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    image = ImageCms.profileToProfile(Image.fromarray(pixels), source, SRGB, 1)
    assert image is not None
    return np.asarray(image).astype(int)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize(
    ("profile", "name"), [(icc_profiles.DISPLAY_P3, "Display P3"), (icc_profiles.PROPHOTO, "ProPhoto RGB")]
)
def test_an_embedded_profile_gives_the_colours_of_littlecms(
    tmp_path: Path, suffix: str, profile: bytes, name: str
) -> None:
    path = tmp_path / f"a.{suffix}"
    lossless = {"lossless": True} if suffix == "webp" else {}
    flat = np.repeat(np.repeat(COLOURS, 16, 0), 16, 1)  # blocks of 16 pixels, which JPEG keeps
    Image.fromarray(flat).save(path, icc_profile=profile, quality=98, subsampling=0, **lossless)
    image = read_image(path)
    assert image.colourspace_name == name
    with Image.open(path) as written:
        stored = np.asarray(written)[8::16, 8::16]
    shown = 255 * colour.linear_to_srgb(image.pixels[8::16, 8::16].clip(0, 1))
    assert np.abs(shown - by_littlecms(stored, profile)).max() < 2.5  # both round to 8 bits
    as_srgb = 255 * colour.linear_to_srgb(read_image(path, "sRGB").pixels[8::16, 8::16])
    assert np.abs(shown - as_srgb).max() > 15


def test_known_grey_and_sampled_profiles_are_recognised(tmp_path: Path) -> None:
    assert space_of_profile(icc_profiles.DISPLAY_P3, "x") is colour.DISPLAY_P3
    assert space_of_profile(SRGB.tobytes(), "x") is colour.SRGB
    prophoto = space_of_profile(icc_profiles.PROPHOTO, "My camera")
    assert prophoto is not None and prophoto.name == "My camera" and prophoto.chromaticities is not None
    romm = (0.7347, 0.2653, 0.1596, 0.8404, 0.0366, 0.0001, 0.3457, 0.3585)
    ours = colour.matrix_to_rec709(romm)
    np.testing.assert_allclose(colour.matrix_to_rec709(prophoto.chromaticities), ours, atol=2e-3)
    tags = {b"rTRC": icc_profiles.sampled(0, 16384, 65535), b"gTRC": icc_profiles.sampled(), b"bTRC": b""}
    tags[b"bTRC"] = icc_profiles.sampled(512)  # a power of 2
    for letter, column in zip((b"r", b"g", b"b"), np.eye(3) * 0.9 + 0.03, strict=True):
        tags[letter + b"XYZ"] = b"XYZ " + bytes(4) + icc_profiles.fixed(*column)
    space = space_of_profile(icc_profiles.profile(tags), "x")
    assert space is not None and space.decode is not None
    found = space.decode(np.full((1, 1, 3), 0.25, np.float32))
    np.testing.assert_allclose(found[0, 0], [0.125, 0.25, 0.0625], atol=2e-5)
    grey = icc_profiles.grey_profile("Grey", icc_profiles.sampled(512))
    Image.fromarray(np.full((6, 9), 128, np.uint8)).save(tmp_path / "a.png", icc_profile=grey)
    assert read_image(tmp_path / "a.png").pixels == pytest.approx((128 / 255) ** 2, rel=1e-4)


@pytest.mark.parametrize(
    ("kind", "parameters", "encoded", "decoded"),
    [
        (0, (2.0,), 0.5, 0.25),
        (1, (2.0, 1.25, -0.25), 0.1, 0.0),  # below 0.2 it is 0
        (1, (2.0, 1.25, -0.25), 0.6, 0.25),
        (2, (2.0, 1.25, -0.25, 0.0625), 0.1, 0.0625),
        (2, (2.0, 1.25, -0.25, 0.0625), 0.6, 0.3125),
        (3, (2.0, 1.0, 0.0, 0.5, 0.25), 0.125, 0.0625),
        (3, (2.0, 1.0, 0.0, 0.5, 0.25), 0.5, 0.25),
        (4, (2.0, 1.0, 0.0, 0.5, 0.25, 0.0625, 0.03125), 0.125, 0.09375),
        (4, (2.0, 1.0, 0.0, 0.5, 0.25, 0.0625, 0.03125), 0.5, 0.3125),
    ],
)
def test_parametric_curves(kind: int, parameters: tuple[float, ...], encoded: float, decoded: float) -> None:
    curve = icc_profiles.parametric(kind, *parameters)
    space = space_of_profile(icc_profiles.rgb_profile("x", np.eye(3) * 0.9 + 0.03, curve), "x")
    assert space is not None and space.decode is not None
    assert space.decode(np.full((1, 1, 3), encoded, np.float32)) == pytest.approx(decoded, abs=2e-5)


@pytest.mark.parametrize("gamma", [1, 2])
def test_a_grey_profile_that_gives_lightness(tmp_path: Path, gamma: int) -> None:
    """The connection space is Lab, so the curve gives L*, not luminance."""
    ramp = np.arange(0, 256, 5, np.uint8)[None].repeat(3, 0)
    grey = icc_profiles.grey_profile("Grey L*", icc_profiles.sampled(256 * gamma), b"Lab ")
    Image.fromarray(ramp).save(tmp_path / "a.png", icc_profile=grey)
    found = read_image(tmp_path / "a.png").pixels
    lightness = 100 * (ramp / 255.0) ** gamma
    luminance = np.where(lightness > 8, ((lightness + 16) / 116) ** 3, lightness / 903.2963)
    np.testing.assert_allclose(found[..., 1], luminance, atol=1e-6)
    source = ImageCms.ImageCmsProfile(io.BytesIO(grey))
    shown = ImageCms.profileToProfile(Image.fromarray(ramp), source, SRGB, 1, "RGB")
    assert shown is not None
    assert np.abs(255 * colour.linear_to_srgb(found) - np.asarray(shown)).max() < 1.5  # of 8 bits


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
def test_a_grey_profile_of_an_image_with_colours_is_left_out(
    tmp_path: Path, suffix: str, caplog: Log
) -> None:
    grey = icc_profiles.grey_profile("Dot Gain", icc_profiles.sampled(512))
    lossless = {"lossless": True} if suffix == "webp" else {}
    levels = np.full((16, 32, 3), (200, 60, 40), np.uint8)
    Image.fromarray(levels).save(path := tmp_path / f"a.{suffix}", icc_profile=grey, quality=98, **lossless)
    image = read_image(path)
    np.testing.assert_allclose(255 * colour.linear_to_srgb(image.pixels), levels, atol=1.5)
    assert image.colourspace_name == "sRGB"
    if suffix != "png":  # libpng leaves it out itself
        assert "profile 'Dot Gain' is for grey images; assuming sRGB" in caplog.text


def test_broken_profiles_are_no_space() -> None:
    whole = icc_profiles.DISPLAY_P3
    assert all(space_of_profile(whole[:size], "x") is None for size in range(0, len(whole) - 60, 13))
    assert space_of_profile(whole.replace(b"rTRC", b"xTRC"), "x") is None  # as a profile of tables
    generator = np.random.default_rng(0)
    for _ in range(300):  # none raises
        damaged = bytearray(whole)
        for at in generator.integers(0, len(whole), 8):
            damaged[at] = generator.integers(256)
        space_of_profile(bytes(damaged), "x")


def test_tables_are_applied_to_eight_bits_and_refused_for_more(tmp_path: Path, caplog: Log) -> None:
    """As littleCMS does, but for the compensation of the black point."""
    caplog.set_level(logging.INFO, "facerf")
    scanner, alpha = icc_profiles.scanner_profile(), COLOURS[..., :1]
    for suffix in ("png", "tif", "webp"):
        path = tmp_path / f"a.{suffix}"
        Image.fromarray(np.dstack([COLOURS, alpha])).save(path, icc_profile=scanner, lossless=True)
        image = read_image(path)
        assert image.colourspace_name == "sRGB" and image.alpha == pytest.approx(alpha[..., 0] / 255)
        shown = 255 * colour.linear_to_srgb(image.pixels)
        assert np.abs(shown - by_littlecms(COLOURS, scanner)).max() < 12
        assert np.abs(shown - COLOURS).max() > 40
        assert "'Scanner 9'" in caplog.records[-1].getMessage()
    tifffile.imwrite(path := tmp_path / "b.tif", 257 * COLOURS.astype(np.uint16), iccprofile=scanner)
    refused(InputError, "'Scanner 9' has tables ... convert it to sRGB", read_image, path)
    assert read_image(path, "Display P3").colourspace_name == "Display P3"


def test_a_broken_profile_is_one_line_that_says_what_is_assumed(tmp_path: Path, caplog: Log) -> None:
    tables = icc_profiles.DISPLAY_P3.replace(b"rTRC", b"A2B0").replace(*(
        name.encode("utf-16-be") for name in ("Display P3", "Scanner 77")
    ))  # fmt: skip
    Image.fromarray(COLOURS).save(tmp_path / "a.png", icc_profile=tables)
    assert read_image(tmp_path / "a.png").colourspace_name == "sRGB"
    (line,) = [record.getMessage() for record in caplog.records]
    assert "a.png" in line and "'Scanner 77'" in line and line.endswith("assuming sRGB")


@pytest.mark.parametrize("space", [colour.LINEAR, colour.ACESCG, colour.ACES], ids=lambda space: space.name)
def test_the_profile_of_a_linear_space(space: colour.ColourSpace) -> None:
    made = linear_profile(space)
    assert ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(made))).strip() == space.name
    found = space_of_profile(made, space.name)
    assert found is not None and found.chromaticities is not None and space.chromaticities is not None
    expected = colour.matrix_to_rec709(space.chromaticities)
    np.testing.assert_allclose(colour.matrix_to_rec709(found.chromaticities), expected, atol=1e-3)
    if space is colour.LINEAR:
        assert found is space
        ramp = np.arange(0, 256, 5, np.uint8)[None, :, None].repeat(3, -1)
        encoded = 255 * colour.linear_to_srgb(ramp / np.float32(255))
        assert np.abs(by_littlecms(ramp, made) - encoded).max() < 1
