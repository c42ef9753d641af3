"""Formats, colours and the standard output of `facerf relight`."""

import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from facerf_cli.errors import UsageError
from facerf_cli.files.output_options import OutputOptions, check_stdout, parse_formats
from facerf_cli.files.read import read_image
from facerf_cli.files.texts import file_sha256
from facerf_cli.files.write import write_exr
from facerf_cli.image import colour
from facerf_cli.main import main
from facerf_cli.relighting.memory import canvas
from tests.astronaut import PATH
from tests.cli import lines
from tests.exr_layers import exr_layers
from tests.folders import only_row, rows
from tests.kinds import Folders, Patch, Said
from tests.refusals import refused

NAME = "astronaut_light_40_10"
LIGHT = ("--light", "40,10")
FIELD = ("--reflectance", "field")  # faster, where any image serves
SIDE = 256


@pytest.fixture(scope="module")
def given(given: Path, tmp_path_factory: Folders) -> Path:
    """The folder of the other tests with a smaller photo and its landmarks."""
    folder = Path(shutil.copytree(given, tmp_path_factory.mktemp("small") / "given"))
    landmarks = np.array(json.loads((given / "astronaut.json").read_text()))
    with Image.open(PATH) as image:
        (folder / "astronaut.json").write_text(json.dumps((landmarks * SIDE / image.width).tolist()))
        image.resize((SIDE, SIDE)).save(folder / "astronaut.png")
    return folder


def relight(given: Path, output: Path, *line: str, photo: Path | None = None) -> int:
    return lines.relight(given, output, *line, photo=photo or given / "astronaut.png")


def test_formats_of_the_command_line() -> None:
    assert parse_formats("png, exr") == ("exr", "png")
    assert parse_formats("jpeg,tif") == ("tiff", "jpg")
    options = OutputOptions(parse_formats("jpg,tiff,png16"))
    assert options.suffixes == (".png", ".tif", ".jpg")
    for wrong in ("", "png,png16", "bmp", "exr,gif"):
        refused(UsageError, "--format", parse_formats, wrong)


@pytest.mark.slow
def test_every_format_holds_the_same_image(given: Path, tmp_path: Path, capsys: Said) -> None:
    line = [*LIGHT, "--exposure", "0", "--view", "none", "--format", "jpg,exr,tiff,png16", "--aov", "albedo"]
    assert relight(given, tmp_path, *line, "--output-colourspace", "ACEScg", "--compression", "piz") == 0
    printed = [Path(text).name for text in capsys.readouterr().out.splitlines()]
    assert printed == [f"{NAME}{suffix}" for suffix in (".exr", ".png", ".tif", ".jpg")]
    assert only_row(tmp_path)["outputs"] == printed
    spec = oiio.ImageBuf(str(tmp_path / f"{NAME}.exr")).spec()
    assert spec.get_string_attribute("compression") == "piz"
    assert spec.getattribute("chromaticities") == pytest.approx(colour.ACESCG.chromaticities, abs=1e-6)
    linear = read_image(tmp_path / f"{NAME}.exr").pixels
    np.testing.assert_allclose(read_image(tmp_path / f"{NAME}.tif").pixels, linear, atol=3e-3)
    for suffix, atol in (".png", 2e-3), (".jpg", 0.25):
        image = read_image(tmp_path / f"{NAME}{suffix}")
        np.testing.assert_allclose(image.pixels, linear.clip(0, 1), atol=atol)
        assert image.metadata.get("facerf:view", "none") == "none"
    assert "albedo.R" in exr_layers(tmp_path / f"{NAME}.exr")
    assert relight(given, tmp_path, *line) == 0  # finished
    jpeg = tmp_path / f"{NAME}.jpg"
    for quality in ("95", "20"):
        assert relight(given, tmp_path / quality, *LIGHT, "--format", "jpg", "--quality", quality) == 0
    small, usual = ((tmp_path / quality / jpeg.name).stat().st_size for quality in ("20", "95"))
    assert 3 * small < usual


@pytest.mark.slow
def test_the_soft_view_changes_the_bright_person_alone(given: Path, tmp_path: Path) -> None:
    line = ["--light", "40,10,3", "--exposure", "0.5", "--format", "png16,exr"]
    stem = "astronaut_light_40_10_3"
    for view in ("soft", "none"):
        assert relight(given, tmp_path / view, *line, "--view", view) == 0
    soft, none = (read_image(tmp_path / view / f"{stem}.png").pixels for view in ("soft", "none"))
    matte = exr_layers(tmp_path / "soft" / f"{stem}.exr")["person.A"]
    assert (soft[matte == 0] == none[matte == 0]).all() and none[matte == 0].max() > 0.95
    linear = read_image(tmp_path / "soft" / f"{stem}.exr").pixels * 2**0.5
    person = matte == 1
    np.testing.assert_allclose(soft[person], colour.softened(linear[person]).clip(0, 1), atol=2e-3)
    assert (linear[person] > 1.2).mean() > 0.01 and np.abs(soft - none)[person].max() > 0.05


def test_a_background_colour_keeps_its_look_and_a_map_does_not(given: Path, tmp_path: Path) -> None:
    white = [*LIGHT, *FIELD, "--background", "#ffffff", "--format", "png,exr"]
    assert relight(given, tmp_path / "white", *white) == 0
    matte = exr_layers(tmp_path / "white" / f"{NAME}.exr")["person.A"]
    assert (read_image(tmp_path / "white" / f"{NAME}.png").pixels[matte == 0] == 1).all()
    write_exr(tmp_path / "ones.exr", np.ones((8, 16, 3), np.float32))
    sky = [*FIELD, "--envmap", str(tmp_path / "ones.exr"), "--background", "envmap", "--exposure", "0"]
    assert relight(given, tmp_path / "map", *sky) == 0
    shown = read_image(tmp_path / "map/astronaut_ones.png").pixels[matte == 0]
    assert shown == pytest.approx(1 - 0.2 / np.e, abs=5e-3)  # 8 bits


def test_one_image_on_standard_output(
    given: Path, tmp_path: Path, capsysbinary: pytest.CaptureFixture[bytes], monkeypatch: Patch
) -> None:
    assert relight(given, Path("-"), *LIGHT, *FIELD) == 0
    said = capsysbinary.readouterr()
    line, _ = said.err.decode().splitlines()  # the other one rates the person
    # no path that is gone
    assert re.fullmatch(
        rf"{given}/astronaut.png under light_\S+: exposure \S+ EV, with \S+ % ambient fill .*", line
    )
    with Image.open(io.BytesIO(said.out)) as image:
        assert image.format == "PNG" and image.size == (SIDE, SIDE)
    with (given / "astronaut.png").open("rb") as photo:
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(photo))
        assert relight(given, Path("-"), *LIGHT, *FIELD, photo=Path("-")) == 0
    piped = capsysbinary.readouterr()
    assert piped.err.startswith(b"- under light_")
    first, second = (Image.open(io.BytesIO(image)) for image in (said.out, piped.out))
    assert first.tobytes() == second.tobytes()
    assert relight(given, Path("-"), *LIGHT, "--format", "exr", "--composite", "face") == 0
    (tmp_path / "piped.exr").write_bytes(capsysbinary.readouterr().out)
    assert read_image(tmp_path / "piped.exr").alpha is not None
    assert relight(given, Path("-"), *LIGHT, photo=tmp_path / "missing.png") == 1
    assert capsysbinary.readouterr().out == b"" and not Path("-").exists()


@pytest.mark.parametrize(
    "words", ["--light 1,2", "--format exr,png", "--dry-run", "--face all", str(PATH.parent)]
)
def test_several_images_are_refused_before_anything_is_loaded(
    given: Path, words: str, capsysbinary: pytest.CaptureFixture[bytes], monkeypatch: Patch
) -> None:
    assert relight(given, Path("-"), *LIGHT, *words.split(), photo=PATH) == 2
    said = capsysbinary.readouterr()
    (error,) = [line for line in said.err.splitlines() if b"error" in line]
    assert said.out == b"" and b"-o -" in error
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    refused(UsageError, "is a terminal; redirect it", check_stdout, 1, ("png",))


@pytest.mark.slow
def test_a_configuration_of_a_show_names_spaces_in_and_out(given: Path, tmp_path: Path) -> None:
    """In its space "Half" values are half of linear Rec.709; its view takes square roots."""
    (tmp_path / "show.ocio").write_text(
        "ocio_profile_version: 2\nroles: {scene_linear: lin_rec709, default: lin_rec709}\n"
        "displays: {Monitor: [!<View> {name: Root, colorspace: Roots}]}\ncolorspaces:\n"
        "  - !<ColorSpace> {name: lin_rec709}\n"
        "  - !<ColorSpace> {name: Half, to_scene_reference: !<MatrixTransform> "
        "{matrix: [2,0,0,0, 0,2,0,0, 0,0,2,0, 0,0,0,1]}}\n"
        "  - !<ColorSpace> {name: Roots, to_scene_reference: !<ExponentTransform> {value: [2, 2, 2, 1]}}\n"
    )
    show = ["--ocio", str(tmp_path / "show.ocio"), "--exposure", "0", "--background", "0.04,0.25,0.81"]
    out = ["--view", "root", "--output-colourspace", "half", "--format", "exr,png16"]
    assert relight(given, tmp_path / "out", *LIGHT, *show, *out) == 0
    stored = exr_layers(tmp_path / "out" / f"{NAME}.exr")
    behind = stored["person.A"] == 0
    np.testing.assert_allclose(
        [stored[letter][behind].mean() for letter in "RGB"], [0.02, 0.125, 0.405], rtol=2e-3
    )
    png = oiio.ImageBuf(str(tmp_path / "out" / f"{NAME}.png")).get_pixels(oiio.FLOAT)
    np.testing.assert_allclose(png[behind].mean(0), [0.2, 0.5, 0.9], atol=1e-3)
    write_exr(tmp_path / "astronaut.exr", read_image(given / "astronaut.png").pixels / 2)
    line = [*show[:4], *LIGHT, "--input-colourspace", "Half", "--format", "exr"]
    assert relight(given, tmp_path / "in", *line, photo=tmp_path / "astronaut.exr") == 0
    assert relight(given, tmp_path / "in2", *line[2:6], "--format", "exr") == 0
    one, two = (read_image(tmp_path / folder / f"{NAME}.exr").pixels for folder in ("in", "in2"))
    # halves round the pixels otherwise, which moves a few at the edge of the matte, where it is solved for
    assert (np.abs(one - two) > 0.02).mean() < 1e-4


def test_layers_that_do_not_fit_are_files_that_go(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    with canvas(path, (1 << 30, 1 << 30), images=1) as empty:
        image, shadow = empty("rgb", (6, 8, 3)), empty("shadow", (6, 8, 3))
        assert isinstance(image, np.memmap) and (image.dtype, shadow.dtype) == (np.float32, np.float16)
        assert len(list(tmp_path.glob(".*/*"))) == 2
    assert not any(tmp_path.iterdir())
    with canvas(path, (4, 6), images=0) as empty:
        assert not isinstance(empty("rgb", (6, 8, 3)), np.memmap) and not any(tmp_path.iterdir())


def test_one_image_goes_to_the_file_that_is_named(given: Path, tmp_path: Path, capsys: Said) -> None:
    assert relight(given, tmp_path / "out.v2.jpeg", *LIGHT, *FIELD, "--background", "black") == 0
    assert capsys.readouterr().out == f"{tmp_path / 'out.v2.jpeg'}\n"
    with Image.open(tmp_path / "out.v2.jpeg") as image:
        assert image.format == "JPEG"
    assert not list(tmp_path.glob("*.exr"))


@pytest.mark.parametrize(
    ("output", "words", "warns"),
    [
        ("out", ["--background", "none", "--format", "exr,jpg"], True),
        ("x.jpg", ["--background", "none"], True),
        ("x.jpeg", ["--composite", "face"], True),
        ("out", ["--background", "none", "--format", "png"], False),
        ("x.jpg", ["--background", "black"], False),
    ],
)
def test_alpha_that_a_jpeg_loses_is_warned_of(
    tmp_path: Path, capsys: Said, output: str, words: list[str], warns: bool
) -> None:
    line = ["relight", str(PATH), *LIGHT, "-o", str(tmp_path / output), "--dry-run"]
    assert main([*line, *words]) == 0
    assert ("JPEG has no alpha" in capsys.readouterr().err) == warns


def test_layers_are_parts_or_channels_of_one_and_data_have_no_colour_space(
    given: Path, tmp_path: Path
) -> None:
    line = (*LIGHT, "--format", "exr", "--aov", "normal,depth,albedo", "--output-colorspace", "ACEScg")
    assert relight(given, tmp_path / "parts", *line) == 0
    assert relight(given, tmp_path / "one.exr", *line, "--exr", "single") == 0
    single, parts = tmp_path / "one.exr", tmp_path / "parts" / f"{NAME}.exr"
    assert oiio.ImageBuf(str(single)).nsubimages == 1
    layers = exr_layers(single)
    for name, values in exr_layers(parts).items():
        np.testing.assert_array_equal(values, layers[name])
    spaces = {
        (spec := oiio.ImageBuf(str(parts), part, 0).spec())["name"]: spec["oiio:ColorSpace"]
        for part in range(oiio.ImageBuf(str(parts)).nsubimages)
    }
    data = dict.fromkeys(("person", "normal", "depth"), "data")
    assert spaces == dict.fromkeys(("rgba", "albedo"), "lin_ap1_scene") | data


def test_the_header_keeps_the_plate_s_camera_and_says_what_made_the_image(
    given: Path, tmp_path: Path
) -> None:
    pixels = read_image(given / "astronaut.png").pixels
    said = {"smpte:TimeCode": (16777216, 0), "FramesPerSecond": (24000, 1001), "lensModel": "50 mm"}
    write_exr(tmp_path / "plate.exr", pixels, metadata={**said, "Exif:GPSLatitude": "here"})
    line = ("--envmap", str(given / "maps/grey.exr"))
    assert relight(given, tmp_path / "out.exr", *line, photo=tmp_path / "plate.exr") == 0
    header = read_image(tmp_path / "out.exr").metadata
    assert {name: header[name] for name in said} == said and "Exif:GPSLatitude" not in header
    digest = file_sha256(given / "maps/grey.exr")[:16]
    (light,) = json.loads(header["facerf:lights"])["lights"]
    assert light["envmap"] == f"sha256:{digest}"
    assert json.loads(header["facerf:options"])["reflectance"] == "portrait"
    assert json.loads(header["facerf:networks"])["reflectance"]["file"] == "lambert.safetensors"


def test_the_distance_of_the_identity_is_reported(given: Path, tmp_path: Path) -> None:
    pytest.importorskip("dlib")
    assert relight(given, tmp_path, *LIGHT, "--identity") == 0
    (row,) = rows(tmp_path).values()
    assert row["exposure_ev"].keys() == row["identity_distance"].keys() == {NAME}
    assert 0.01 < row["identity_distance"][NAME] < 0.6  # below it dlib takes two photos for one person's
