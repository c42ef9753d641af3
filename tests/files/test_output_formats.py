"""Written images: parts of an EXR over a background, colour spaces, TIFF, 16-bit PNG, views, metadata."""

import struct
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile

from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.images import read_image, write_display, write_exr, write_tiff
from facerf_cli.image import colour
from facerf_cli.run.logs import COMPOSITE_SOURCE_TYPE, Provenance
from tests.exr_layers import exr_layers
from tests.files.test_image_metadata import IPTC, properties

RGB, ALPHA = (
    np.random.default_rng(6).random((23, 34, 4)).astype(np.float32)[..., at] for at in (slice(3), 3)
)
LAYERS = {"person.A": ALPHA, "albedo": RGB[::-1], "normal": RGB * 2 - 1, "depth": ALPHA[..., None] + 1}
FACTS = Provenance("me.jpg", "default").attributes()


def test_an_exr_goes_over_a_background_without_choosing_channels(tmp_path: Path) -> None:
    """`oiiotool --over` refuses images that differ in their channels: layers are in further parts."""
    write_exr(tmp_path / "front.exr", RGB, ALPHA, LAYERS)
    front = oiio.ImageBuf(str(tmp_path / "front.exr"))
    assert front.spec().channelnames == ("R", "G", "B", "A") and front.spec().alpha_channel == 3
    back = np.concatenate([np.full((23, 34, 3), 0.25, np.float32), np.ones((23, 34, 1), np.float32)], -1)
    over = oiio.ImageBufAlgo.over(front, oiio.ImageBuf(back))
    assert not over.has_error, over.geterror()
    expected = ALPHA[..., None] * RGB + (1 - ALPHA[..., None]) * 0.25
    np.testing.assert_allclose(over.get_pixels(oiio.FLOAT)[..., :3], expected, atol=2e-3)  # half floats


def test_parts_of_an_exr_and_their_number_formats(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, RGB, ALPHA, {**LAYERS, "class.hair": ALPHA, "class.skin": 1 - ALPHA}, FACTS)
    parts = [oiio.ImageBuf(str(path), part, 0).spec() for part in range(oiio.ImageBuf(str(path)).nsubimages)]
    names = [spec.get_string_attribute("oiio:subimagename") for spec in parts]
    assert names == ["rgba", "person", "albedo", "normal", "depth", "class"]
    assert [str(spec.format) for spec in parts] == ["half", "half", "half", "half", "float", "half"]
    assert parts[-1].channelnames == ("class.hair", "class.skin")
    assert parts[0].getattribute("facerf:synthetic") == 1
    np.testing.assert_allclose(exr_layers(path)["class.skin"], 1 - ALPHA, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "interop_id"),
    [("ACEScg", "lin_ap1_scene"), ("lin_rec2020", "lin_rec2020_scene"), ("ACES2065-1", "lin_ap0_scene"),
     ("lin_p3d65", "lin_p3d65_scene"), ("Linear AdobeRGB", "lin_adobergb_scene"),
     ("ACEScct", "ocio:acescct_ap1_scene")],
)  # fmt: skip
def test_an_exr_in_another_space_says_so_and_reads_back(tmp_path: Path, name: str, interop_id: str) -> None:
    space = colour.named_space(name)
    write_exr(tmp_path / "a.exr", RGB, None, {"albedo": RGB, "normal": RGB}, space=space)
    for part in range(3):
        spec = oiio.ImageBuf(str(tmp_path / "a.exr"), part, 0).spec()
        assert spec.get_string_attribute("colorInteropID") == interop_id
        chromaticities = spec.getattribute("chromaticities")
        assert (chromaticities is None) == (space.chromaticities is None)
        if space.chromaticities:
            assert chromaticities == pytest.approx(space.chromaticities, abs=1e-6)
    stored = exr_layers(tmp_path / "a.exr")
    red = colour.from_linear_rec709(RGB, space)[..., 0]
    assert np.abs(red - RGB[..., 0]).max() > 0.03
    np.testing.assert_allclose(stored["R"], red, atol=2e-3)  # half floats
    np.testing.assert_allclose(stored["albedo.R"], red, atol=2e-3)
    np.testing.assert_allclose(stored["normal.X"], RGB[..., 0], atol=1e-3)  # is no colour
    np.testing.assert_allclose(read_image(tmp_path / "a.exr").pixels, RGB, atol=0.01)


@pytest.mark.parametrize(
    "compression", ["none", "rle", "zips", "zip", "piz", "pxr24", "b44a", "dwaa", "dwab"]
)
def test_compressions_of_exr(tmp_path: Path, compression: str) -> None:
    smooth = np.linspace(0.1, 2, 64 * 48 * 3, dtype=np.float32).reshape(48, 64, 3)
    write_exr(tmp_path / "a.exr", smooth, compression=compression)
    found = oiio.ImageBuf(str(tmp_path / "a.exr")).spec().get_string_attribute("compression")
    assert found.split(":")[0] == compression
    lossless = compression in ("none", "rle", "zips", "zip", "piz", "pxr24")
    error = np.abs(read_image(tmp_path / "a.exr").pixels - smooth.astype(np.float16)).max()
    assert error == 0 if lossless else error < 0.05


@pytest.mark.parametrize("name", ["linear", "ACEScg"])
def test_tiff_has_floats_their_profile_and_what_made_it(tmp_path: Path, name: str) -> None:
    path, space = tmp_path / "a.tif", colour.named_space(name)
    write_tiff(path, RGB * 3 - 0.5, ALPHA, FACTS, space)
    spec = oiio.ImageBuf(str(path)).spec()
    assert str(spec.format) == "float" and spec.nchannels == 4
    header, image = read_header(path), read_image(path)
    assert header is not None and header.space.name == space.name
    np.testing.assert_allclose(image.pixels, RGB * 3 - 0.5, atol=2e-3)  # the profile's rounding
    np.testing.assert_array_equal(image.alpha, ALPHA)
    found = properties(path.read_bytes())
    assert found[IPTC] == COMPOSITE_SOURCE_TYPE and found["{urn:facerf:1}input"] == "me.jpg"
    with tifffile.TiffFile(path) as other:  # another reader
        tags = other.pages[0].tags
        assert bytes(tags["XMP"].value).startswith(b"<?xpacket") and tags["ExtraSamples"].value == (2,)
        assert [tag.code for tag in tags] == sorted(tag.code for tag in tags)
    stored = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)
    multiplied = colour.from_linear_rec709(RGB * 3 - 0.5, space) * ALPHA[..., None]  # by OpenImageIO
    np.testing.assert_allclose(stored[..., :3], multiplied, atol=1e-6)


def test_writing_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        write_exr(tmp_path / folder / "x.exr", RGB, ALPHA, LAYERS, FACTS)
        write_tiff(tmp_path / folder / "x.tif", RGB, ALPHA, FACTS)
        for suffix in ("png", "jpg"):
            write_display(tmp_path / folder / f"x.{suffix}", RGB, 0.0, ALPHA, FACTS, colour.SOFT_VIEW)
    for suffix in ("exr", "tif", "png", "jpg"):
        one, two = ((tmp_path / folder / f"x.{suffix}").read_bytes() for folder in "ab")
        assert one == two


def test_png_of_16_bits(tmp_path: Path) -> None:
    write_display(tmp_path / "a.png", RGB, metadata=FACTS, bits=16)
    header = read_header(tmp_path / "a.png")
    assert header is not None and header.bits == 16
    np.testing.assert_allclose(read_image(tmp_path / "a.png").pixels, RGB, atol=4e-5)  # 1 / 65535 of sRGB
    assert properties((tmp_path / "a.png").read_bytes())[IPTC] == COMPOSITE_SOURCE_TYPE


def test_jpeg_keeps_the_resolution_of_colour(tmp_path: Path) -> None:
    """4:4:4: red and blue columns, a pixel wide, stay apart."""
    stripes = np.zeros((32, 32, 3), np.float32)
    stripes[:, ::2, 0] = stripes[:, 1::2, 2] = 1
    write_display(tmp_path / "a.jpg", stripes)
    found = read_image(tmp_path / "a.jpg").pixels
    assert found[:, ::2, 0].min() > 0.8 and found[:, 1::2, 0].max() < 0.1
    data = (tmp_path / "a.jpg").read_bytes()
    frame = data.index(b"\xff\xc0")
    height, width, channels = struct.unpack_from(">HHB", data, frame + 5)
    assert (height, width) == (32, 32) and [data[frame + 11 + 3 * k] for k in range(channels)] == [0x11] * 3


def test_a_jpeg_shows_an_image_with_alpha_over_black(tmp_path: Path) -> None:
    flat = np.full((16, 16, 3), 0.5, np.float32)
    write_display(tmp_path / "a.jpg", flat, alpha=np.full((16, 16), 0.5, np.float32), view=colour.SOFT_VIEW)
    assert read_image(tmp_path / "a.jpg").pixels == pytest.approx(0.25, abs=0.01)


def test_the_soft_view_is_plain_up_to_its_start_and_where_it_has_no_share(tmp_path: Path) -> None:
    linear = np.broadcast_to(np.float32([[0.1], [0.8], [1.0], [2.0], [40.0]])[None], (4, 5, 3))
    share = np.float32([0, 0.5, 1, 1])[:, None] * np.ones(5, np.float32)
    write_display(tmp_path / "a.png", linear, view=colour.SOFT_VIEW, share=share, bits=16)
    shown = read_image(tmp_path / "a.png").pixels[..., 0]
    soft = [0.1, 0.8, 1 - 0.2 / np.e, 1 - 0.2 * np.exp(-6), 1]
    np.testing.assert_allclose(shown[2], soft, atol=1e-4)
    np.testing.assert_allclose(shown[0], [0.1, 0.8, 1, 1, 1], atol=1e-4)
    np.testing.assert_allclose(shown[1, :3], [0.1, 0.8, 1 - 0.1 / np.e], atol=1e-4)
    write_display(tmp_path / "b.png", linear, view=colour.SOFT_VIEW, bits=16)
    np.testing.assert_allclose(read_image(tmp_path / "b.png").pixels[0, :, 0], soft, atol=1e-4)
    write_display(tmp_path / "c.png", linear, bits=16)
    np.testing.assert_allclose(read_image(tmp_path / "c.png").pixels[0, :, 0], [0.1, 0.8, 1, 1, 1], atol=1e-4)
