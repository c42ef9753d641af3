"""Image files: round trips, metadata, and damaged files."""

import logging
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile

from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.image_metadata import COMPOSITE_SOURCE_TYPE, Provenance, read_header
from facerf_cli.files.read import read_image
from facerf_cli.files.write import HALF_MAX, write_display, write_exr, write_tiff
from facerf_cli.image import colour
from tests.exr_layers import exr_layers
from tests.files.made import IPTC, MAP, TO_709, properties, write_hdr, write_oiio
from tests.kinds import Log
from tests.refusals import refused

VALUES = np.random.default_rng(1).random((23, 34, 4)).astype(np.float32)  # [H, W, RGBA], not square


@pytest.fixture
def warned(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> pytest.LogCaptureFixture:
    monkeypatch.setattr(logging.getLogger("facerf"), "propagate", True)
    return caplog


RGB, ALPHA = VALUES[..., :3], VALUES[..., 3]
GREY = np.full((11, 16, 1), 188 / 255, np.float32)
BY_SRGB, GREY_LINEAR = colour.srgb_to_linear(RGB), colour.srgb_to_linear(GREY).repeat(3, -1)
HOLED = np.where(np.arange(23)[:, None] < 3, 0, ALPHA)  # colour without cover is light
STRAIGHT = {"oiio__UnassociatedAlpha": 1}
SRGB, LINEAR, ACESCG, REC2020 = colour.SRGB, colour.LINEAR, colour.ACESCG, colour.LINEAR_REC2020
# Values, how they are written, their space, the pixels that are read and their alpha, and the tolerance.
WRITTEN = {
    "half.exr": (40 * RGB, {"kind": "half"}, LINEAR, 40 * RGB, None, 0.02),
    **{f"a.{kind}": (40 * RGB, {}, LINEAR, 40 * RGB, None, 0) for kind in ("exr", "tif")},
    "a.hdr": (40 * RGB, {}, LINEAR, 40 * RGB, None, 40 / 128),
    **{
        f"{kind}.{suffix}": (GREY, {"kind": kind}, SRGB, GREY_LINEAR, None, 2e-4)
        for suffix, kind in (("pgm", "uint8"), ("pgm", "uint16"), ("png", "uint8"), ("jpg", "uint8"))
    },
    "grey.png": (
        VALUES[..., :2], {"kind": "uint16", "channels": "YA", **STRAIGHT}, SRGB,
        colour.srgb_to_linear(VALUES[..., :1]).repeat(3, -1), VALUES[..., 1], 2e-5,
    ),
    **{
        f"straight.{suffix}": (VALUES, {"kind": "uint16", **STRAIGHT}, SRGB, BY_SRGB, ALPHA, 2e-5)
        for suffix in ("png", "tif")
    },
    "over.exr": (
        np.dstack([np.where(HOLED[..., None] > 0, RGB * HOLED[..., None], RGB), HOLED]), {}, LINEAR,
        RGB, HOLED, 1e-5,
    ),
    "no_alpha.exr": (VALUES, {"channels": "RGBZ"}, LINEAR, RGB, None, 0),
    "layer.exr": (RGB, {"channels": ("skin.R", "skin.G", "skin.B")}, LINEAR, RGB, None, 0),
    **{
        f"{number}.exr": (RGB, how, space, colour.to_linear_rec709(RGB, space), None, 1e-5)
        for number, (how, space) in enumerate((
            ({"chromaticities": ACESCG.chromaticities}, ACESCG), ({"oiio__ColorSpace": "ACEScg"}, ACESCG),
            ({"oiio__ColorSpace": "sRGB"}, SRGB), ({"oiio__ColorSpace": "lin_rec2020_scene"}, REC2020),
        ))
    },
}  # fmt: skip


@pytest.mark.parametrize("name", list(WRITTEN))
def test_pixels_and_alpha_are_those_that_were_written(tmp_path: Path, name: str) -> None:
    values, how, space, pixels, alpha, tolerance = WRITTEN[name]
    image = read_image(write_oiio(tmp_path / name, values, **how))
    assert image.pixels.dtype == np.float32 and image.colourspace_name == space.name
    np.testing.assert_allclose(image.pixels, pixels, rtol=0, atol=tolerance)
    assert (image.alpha is None) == (alpha is None)
    if alpha is not None:
        np.testing.assert_allclose(image.alpha, alpha, atol=1e-5)


def test_pnm_by_its_bytes(tmp_path: Path) -> None:
    levels = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)
    (tmp_path / "a.ppm").write_bytes(b"P6\n6 4\n255\n" + levels.tobytes())
    image = read_image(tmp_path / "a.ppm")
    np.testing.assert_allclose(colour.linear_to_srgb(image.pixels) * 255, levels, atol=1e-3)
    (tmp_path / "a.pgm").write_bytes(b"P5\n3 2\n1023\n" + np.arange(0, 600, 100, dtype=">u2").tobytes())
    encoded = colour.linear_to_srgb(read_image(tmp_path / "a.pgm").pixels[..., 0]) * 1023
    np.testing.assert_allclose(encoded, [[0, 100, 200], [300, 400, 500]], atol=0.02)


def test_a_curve_on_floats_is_warned_of(tmp_path: Path, warned: pytest.LogCaptureFixture) -> None:
    read_image(write_oiio(tmp_path / "a.exr", VALUES[..., :3]), "Rec.2020")
    assert "decoded by the curve of Rec.2020" in warned.text


@pytest.mark.parametrize("space", [colour.ACESCG, colour.REC2020], ids=lambda space: space.name)
def test_the_user_overrides_the_file_s_colour_space(tmp_path: Path, space: colour.ColourSpace) -> None:
    path = write_oiio(tmp_path / "a.png", VALUES[..., :3], "uint16")
    expected = colour.to_linear_rec709(VALUES[..., :3], space)
    np.testing.assert_allclose(read_image(path, space.name).pixels, expected, atol=1e-4)


def test_one_pixel_and_a_data_window(tmp_path: Path) -> None:
    pixels = read_image(write_oiio(tmp_path / "a.exr", VALUES[..., :3], window=(-2, 5, 40, 25))).pixels
    assert pixels.shape == (25, 40, 3) and pixels[:5].max() == 0 and pixels[:, 32:].max() == 0
    np.testing.assert_array_equal(pixels[5:25, :32], VALUES[:20, 2:, :3])
    assert read_image(write_oiio(tmp_path / "a.png", VALUES[:1, :1, :3], "uint8")).pixels.shape == (1, 1, 3)


def test_nan_and_infinity_are_counted(tmp_path: Path, warned: pytest.LogCaptureFixture) -> None:
    values = VALUES[..., :3].copy()
    values[3, 5, 1], values[3, 5, 2], values[7, 8, 0] = np.nan, np.inf, -np.inf
    path = write_oiio(tmp_path / "a.exr", values)
    refused(InputError, "2 of 782 pixels are NaN or infinite", read_image, path)
    replaced = read_image(path, non_finite="zero").pixels
    assert "2 pixels are NaN or infinite" in warned.text
    np.testing.assert_array_equal(replaced, np.where(np.isfinite(values), values, 0))


def test_exr_round_trip_with_layers_and_provenance(tmp_path: Path) -> None:
    rgb, alpha = VALUES[..., :3] * 30 - 1, VALUES[..., 3]
    layers = {
        "normal": VALUES[..., :3] * 2 - 1,
        "position": VALUES[..., 1:] - 1,
        "uv": VALUES[..., :2],
        "id": alpha,
    }
    path = tmp_path / "new" / "a.exr"
    facts = Provenance("me.jpg", "default", "builtin", "MIT").attributes()
    assert write_exr(path, rgb, alpha, layers, facts) == 0
    image = read_image(path)
    np.testing.assert_allclose(image.pixels, rgb, rtol=2e-3, atol=3e-3)
    np.testing.assert_allclose(image.alpha, alpha, atol=3e-4)
    assert image.metadata["facerf:synthetic"] == 1 and image.metadata["facerf:input"] == "me.jpg"
    assert image.metadata["IPTC:DigitalSourceType"].endswith("compositeWithTrainedAlgorithmicMedia")
    assert image.metadata["chromaticities"] == pytest.approx(colour.REC709_CHROMATICITIES)
    stored = exr_layers(path)
    xyz = [f"{layer}.{letter}" for layer in ("normal", "position") for letter in "XYZ"]
    assert list(stored) == [*"RGBA", *xyz, "uv.U", "uv.V", "id"]
    np.testing.assert_array_equal(stored["position.Z"], layers["position"][..., 2])
    np.testing.assert_array_equal(stored["uv.V"], layers["uv"][..., 1])
    np.testing.assert_allclose(stored["normal.Y"], layers["normal"][..., 1], atol=1e-3)
    assert not list(path.parent.glob(".*"))


def test_exr_keeps_values_beyond_1_and_counts_those_beyond_half(tmp_path: Path) -> None:
    values = np.array([[[-3, 1e-4, 6e4], [1e6, -1e6, 0]]], np.float32)
    assert write_exr(tmp_path / "a.exr", values) == 2
    expected = np.array([[[-3, 1e-4, 6e4], [HALF_MAX, -HALF_MAX, 0]]])
    np.testing.assert_allclose(read_image(tmp_path / "a.exr").pixels, expected, rtol=1e-3)
    with pytest.raises(InputError, match="1 values are NaN"):
        write_exr(tmp_path / "b.exr", np.full((1, 1, 3), [0, np.nan, 0], np.float32))


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_display_round_trip_with_exposure(tmp_path: Path, suffix: str) -> None:
    linear = np.linspace(0, 0.5, 60, dtype=np.float32)[None, :, None] * np.ones((40, 1, 3), np.float32)
    path = tmp_path / f"a.{suffix}"
    assert write_display(path, linear, exposure=1.0) == 1.0
    shown = read_image(path)
    assert shown.colourspace_name == "sRGB"
    tolerance = 0.01 if suffix == "jpg" else 0.002
    expected = colour.linear_to_srgb(linear * 2)
    np.testing.assert_allclose(colour.linear_to_srgb(shown.pixels), expected, atol=tolerance)


def test_display_auto_exposure_is_returned_and_alpha_is_not_premultiplied(tmp_path: Path) -> None:
    linear, alpha = VALUES[..., :3] * 0.01, VALUES[..., 3]
    chosen_ev = write_display(tmp_path / "a.png", linear, "auto", alpha, Provenance("me.jpg").attributes())
    assert chosen_ev == colour.auto_exposure_ev(linear, alpha)
    image = read_image(tmp_path / "a.png")
    expected = np.clip(linear * 2**chosen_ev, 0, 1)
    np.testing.assert_allclose(
        colour.linear_to_srgb(image.pixels), colour.linear_to_srgb(expected), atol=0.002
    )
    np.testing.assert_allclose(image.alpha, alpha, atol=0.002)
    assert image.metadata["Software"].startswith("facerf ")


def test_what_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    refused(FacerfError, "cannot write", write_display, tmp_path / "file" / "a.png", VALUES[..., :3])
    refused(UsageError, "use .exr, .png or .jpg", write_display, tmp_path / "a.xyz", VALUES[..., :3])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]


def test_two_writes_of_any_time_give_the_same_bytes(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", VALUES[..., :3])
    assert b"capDate" not in (tmp_path / "a.exr").read_bytes()
    for folder in ("a", "b"):
        write_exr(tmp_path / folder / "x.exr", RGB, ALPHA, LAYERS, FACTS)
        write_tiff(tmp_path / folder / "x.tif", RGB, ALPHA, FACTS)
        for suffix in ("png", "jpg"):
            write_display(tmp_path / folder / f"x.{suffix}", RGB, 0.0, ALPHA, FACTS, colour.SOFT_VIEW)
    for suffix in ("exr", "tif", "png", "jpg"):
        one, two = ((tmp_path / folder / f"x.{suffix}").read_bytes() for folder in "ab")
        assert one == two


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


@pytest.mark.parametrize("floats", [(), ("depth", "position", "uv")])
def test_channels_of_a_single_part_have_the_number_formats_of_parts(
    tmp_path: Path, floats: tuple[str, ...]
) -> None:
    path, values = tmp_path / "a.exr", {"depth": ALPHA, "position": RGB - 1, "uv": RGB[..., :2]}
    layers = {name: one for name, one in LAYERS.items() if name != "depth"}
    write_exr(path, RGB, ALPHA, {**layers, **{name: values[name] for name in floats}}, single=True)
    spec = oiio.ImageBuf(str(path)).spec()
    kinds = {name: str(spec.channelformat(index)) for index, name in enumerate(spec.channelnames)}
    assert kinds == {name: "float" if name.split(".")[0] in floats else "half" for name in kinds}
    stored = exr_layers(path)
    np.testing.assert_array_equal(stored["normal.Y"], np.float16(2 * RGB[..., 1] - 1))
    if floats:
        np.testing.assert_array_equal(stored["depth"], ALPHA)
        np.testing.assert_array_equal(stored["position.Z"], RGB[..., 2] - 1)


@pytest.mark.parametrize(
    ("name", "interop_id"),
    [("ACEScg", "lin_ap1_scene"), ("lin_rec2020", "lin_rec2020_scene"), ("ACES2065-1", "lin_ap0_scene"),
     ("lin_p3d65", "lin_p3d65_scene"), ("Linear AdobeRGB", "lin_adobergb_scene"),
     ("ACEScct", "ocio:acescct_ap1_scene")],
)  # fmt: skip
def test_an_exr_in_another_space_says_so_and_reads_back(tmp_path: Path, name: str, interop_id: str) -> None:
    space = colour.named_space(name)
    write_exr(tmp_path / "a.exr", RGB, None, {"albedo": RGB, "normal": RGB}, space=space)
    normal = oiio.ImageBuf(str(tmp_path / "a.exr"), 2, 0).spec()
    assert normal.get_string_attribute("colorInteropID") == "data"
    for part in range(2):
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
    image = read_image(path)
    assert image.colourspace_name == space.name
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


@pytest.mark.parametrize("form", ["plain", "new"])
@pytest.mark.parametrize("order", ["-Y +X", "-Y -X", "+Y -X", "+Y +X", "+X -Y", "-X +Y"])
def test_orders_of_axes_and_forms(tmp_path: Path, order: str, form: str) -> None:
    path = write_hdr(tmp_path / "a.hdr", MAP, "", order, form)
    np.testing.assert_allclose(read_image(path).pixels, MAP, atol=0.005)


def test_exposures_and_primaries_are_undone(tmp_path: Path, caplog: Log) -> None:
    head = "EXPOSURE=2.0\nEXPOSURE= 3\nCOLORCORR= 1 1 1\nPIXASPECT=1.0\n"
    np.testing.assert_allclose(
        read_image(write_hdr(tmp_path / "a.hdr", MAP * 6, head)).pixels, MAP, rtol=0.02, atol=0.005
    )
    for zeros in ("0 0 0", "0 0 0 0 0 0 0 0"):  # as in the maps of Poly Haven
        found = read_image(write_hdr(tmp_path / "0.hdr", MAP, f"PRIMARIES={zeros}\n"))
        np.testing.assert_allclose(found.pixels, MAP, rtol=0.02, atol=0.005)
    assert caplog.text == ""
    head = "PRIMARIES=0.708 0.292 0.170 0.797 0.131 0.046 0.3127 0.3290\n"
    found = read_image(write_hdr(tmp_path / "b.hdr", MAP, head)).pixels
    np.testing.assert_allclose(found, MAP @ TO_709.T, atol=0.005)
