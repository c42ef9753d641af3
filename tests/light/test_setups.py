"""Light setups: maps, rotations and single lights, and the names of images."""

import math
import re
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from facerf_cli.batch.inputs import Item
from facerf_cli.cli.relight import drawn_maps
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.light_files import LightRecord, write_light
from facerf_cli.files.write import write_exr
from facerf_cli.light.entries import StudioLight, lit_images, parse_lights, preset_names
from facerf_cli.light.light import rig_by_text
from facerf_cli.light.over_rig import (
    lights_over_rig,
    lights_over_stack,
    off_rig_deg,
    readable_setups,
    single_lights,
)
from facerf_cli.light.setups import LightSetup, LightSources, collect_setups, image_path, parse_rotations
from facerf_cli.light.sphere import azel_to_direction, direction_to_azel, latlong_solid_angles, rig_directions
from facerf_cli.main import main, repeat_options
from tests.refusals import refused

HEIGHT_PX = 16


def write_map(path: Path, bright_uv: tuple[float, float] | None = None) -> Path:
    """A dim map, or one whose single bright texel lights a white surface that faces it with radiance 1."""
    envmap = np.full((HEIGHT_PX, 2 * HEIGHT_PX, 3), 0.0 if bright_uv else 0.2, np.float32)
    if bright_uv:
        row, column = int(bright_uv[1] * HEIGHT_PX), int(bright_uv[0] * 2 * HEIGHT_PX)
        envmap[row, column] = math.pi / latlong_solid_angles(HEIGHT_PX, 2 * HEIGHT_PX)[row, column]
    write_exr(path, envmap)
    return path


def test_maps_may_be_files_folders_and_patterns_told_apart_by_folder(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write_map(tmp_path / f"{name}.exr")
    for given in ([str(tmp_path)], [str(tmp_path / "*.exr")], [str(tmp_path / f"{n}.exr") for n in "cab"]):
        setups = collect_setups(LightSources(envmap=given), tmp_path / "out")
        assert [setup.name for setup in setups] == ["a", "b", "c"]
    for place in ("day/sky.exr", "night/sky.exr", "night/moon.exr"):
        write_map(tmp_path / "more" / place)
    setups = collect_setups(LightSources(envmap=[str(tmp_path / "more")]), tmp_path / "out")
    assert [setup.name for setup in setups] == ["day_sky", "moon", "night_sky"]


def test_a_light_of_estimate_light_is_a_map_too(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rig = rig_directions(60)
    lamp = (rig @ azel_to_direction(60, 30)).clamp_min(0)[:, None] ** 20
    weights = 0.01 + lamp * torch.tensor([1, 0.8, 0.6])
    write_light(tmp_path / "a_light.json", LightRecord(rig, weights))
    (tmp_path / "c.json").write_text("{}")
    given = [str(tmp_path / name) for name in ("a_light.json", "c.json")]
    setups = readable_setups(collect_setups(LightSources(envmap=given, rotate="90"), tmp_path / "out"))
    assert [setup.name for setup in setups] == ["a_light_rot90"]
    assert "c.json: format: is missing; add it" in caplog.text
    (setup,) = collect_setups(LightSources(envmap=given[:1]), tmp_path / "out")
    found = lights_over_stack((setup,), rig, "cell").weights[0]
    assert float((found - weights).abs().max()) < 0.02 * float(weights.max())
    with pytest.raises(UsageError, match="no inputs"):  # a folder is walked for maps alone
        collect_setups(LightSources(envmap=[str(tmp_path)]), tmp_path / "out")


def test_a_pattern_that_the_shell_expanded_stays_with_its_option() -> None:
    line = ["relight", "a.jpg", "--envmap", "x.exr", "y.EXR", "z.hdr", "-o", "out", "stack.exr"]
    expected = ["relight", "a.jpg", *(p for n in ("x.exr", "y.EXR", "z.hdr") for p in ("--envmap", n))]
    expected += ["-o", "out", "stack.exr"]
    assert repeat_options(line) == expected
    assert repeat_options(["relight", "--envmap", "x.exr", "a.jpg", "b.exr"])[2:] == [
        "x.exr",
        "a.jpg",
        "b.exr",
    ]


@pytest.mark.parametrize(
    "text, expected",
    [
        (None, [("", "", 0.0)]),
        ("-90", [("_rot-90", "", -90.0)]),
        ("0:360:3", [("", ".0000", 0.0), ("", ".0001", 120.0), ("", ".0002", 240.0)]),
        ("10:20:1", [("", ".0000", 10.0)]),
    ],
)
def test_rotations(text: str | None, expected: list[tuple[str, str, float]]) -> None:
    assert parse_rotations(text) == expected


@pytest.mark.parametrize(
    "text", ["", "left", "nan", "0:360", "0:360:0", "0:360:2.5", "0:360:nan", "0:1:2:3", "::"]
)
def test_wrong_rotations(text: str) -> None:
    refused(UsageError, "--rotate", parse_rotations, text)


@pytest.mark.parametrize(
    "text", ["", ";", "1", "1,2,3,4", "0,0,-1", "a,b", "1,2,3,4,5,6", "1,inf", "0,91", "0,0,1,-1,0"]
)
def test_wrong_lamps(text: str) -> None:
    refused(UsageError, "--light", collect_setups, LightSources(light=[text]), Path("out"))


def test_a_rig_out_of_range_and_a_light_given_twice(tmp_path: Path) -> None:
    (tmp_path / "rig.txt").write_text("0 0\n0 100\n")
    refused(UsageError, "rig.txt: ... use -90", parse_lights, str(tmp_path / "rig.txt"))
    refused(UsageError, "once", collect_setups, LightSources(light=["1,2", "1.0,2"]), Path("out"))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("dome.lp", "3\r\nimg 1.jpg 0.0 0.0 2.5\r\nimg#2.jpg 1 0 0\r\nimg_3.jpg\t0\t.6\t.8\r\n"),
        ("dome.txt", "# x y z\n0 0 1\n\n4e1, 0, 0  # right\n0, 3, 4\n"),
        ("dome.txt", "3\n0 0 1\n+1.5 0 0\n0 3 4\n"),
        ("dome.lp", "\ufeff3\n1 0 0 1\n2 1 0 0\n3 0 3 4\n"),
        ("dome.json", '{"light_positions": [[0, 0, 1], [2, 0, 0], [0, 3, 4]]}'),
    ],
)
def test_a_rig_of_vectors_has_their_directions(tmp_path: Path, name: str, text: str) -> None:
    """As the LP files of RTI have them: x to the image's right, y up, z toward the camera."""
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    elevation = np.degrees(np.arctan2(3, 4))
    np.testing.assert_allclose(parse_lights(str(path)), [(0, 0), (90, 0), (0, elevation)], atol=1e-9)
    expected = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 0.6, 0.8]])
    torch.testing.assert_close(rig_by_text(str(path)), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("2\na.jpg 0 0 1\n", "states 2"),
        ("a.jpg 0 0 1\nb.jpg 0 0\n", "line 2"),
        ("a.jpg 0 0 1\nb.jpg 0 0 0\n", "line 2"),
        ("a.jpg nan 0 1\n", "line 1"),
        ("", "x y z on each line"),
    ],
)
def test_a_wrong_rig_of_vectors_costs_a_line_that_names_file_and_line(
    tmp_path: Path, text: str, said: str
) -> None:
    (tmp_path / "dome.lp").write_text(text)
    with pytest.raises(UsageError, match=rf"--lights .*dome\.lp.*{said}"):
        parse_lights(str(tmp_path / "dome.lp"))


def test_frame_numbers_stay_at_the_end() -> None:
    still = Item(Path("a.jpg"), Path("out/a"), "a")
    moving = Item(Path("setup.0007.jpg"), Path("out/b/setup.0007"), "b/setup.0007")
    turned = LightSetup("sky", ".0001")
    assert image_path(turned, still, "", ".exr") == Path("out/a_sky.0001.exr")
    assert image_path(LightSetup("sky"), moving, "_face0", ".png") == Path("out/b/setup_face0_sky.0007.png")
    assert image_path(turned, moving, "", ".exr") == Path("out/b/setup_sky.0001.0007.exr")


def test_bad_maps_cost_a_line_and_not_the_others(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_map(tmp_path / "good.exr")
    write_exr(tmp_path / "square.exr", np.ones((8, 8, 3), np.float32))
    (tmp_path / "text.exr").write_text("not a picture")
    given = [str(tmp_path), str(tmp_path / "missing.exr")]
    setups = readable_setups(
        collect_setups(LightSources(envmap=given, light=["0,0"], rotate="0:360:2"), tmp_path / "out")
    )
    assert [setup.name + setup.frame for setup in setups] == ["good.0000", "good.0001", "light_0_0"]


@pytest.mark.parametrize(("name", "bits"), [("a.jpg", 8), ("a.png", 8), ("a.tif", 16), ("a.hdr", 0)])
def test_a_map_of_display_values_has_one_warning_for_its_missing_highlights(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, bits: int
) -> None:
    spec = oiio.ImageSpec(32, 16, 3, f"uint{bits}" if bits else "float")
    image = oiio.ImageBuf(spec)
    oiio.ImageBufAlgo.fill(image, (1.0, 0.9, 0.8))
    assert image.write(str(tmp_path / name))
    sources = LightSources(
        envmap=[str(tmp_path / name), f"sky={tmp_path / name}"],
        light=["key=0,0", f"name=side;map={tmp_path / name}"],
        rotate="0:360:2",
    )
    for _ in range(2):
        readable_setups(collect_setups(sources, tmp_path / "out"))
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    clipped = [text for text in warnings if "clipped" in text]
    assert len(clipped) == bool(bits) and all(f"{tmp_path / name}: " in text for text in clipped)


@pytest.mark.parametrize("azimuth_deg", [90.0, 11.25, -45.0])
def test_a_lamp_and_a_one_texel_map_agree(tmp_path: Path, azimuth_deg: float) -> None:
    """Conventions: azimuth a is u = 0.5 - a / 360, and a lamp of 1 is a texel that gives radiance 1."""
    elevation_deg = 90 / HEIGHT_PX  # a row's centre
    u = 0.5 - azimuth_deg / 360 + 1e-4
    envmap = write_map(tmp_path / "one.exr", (u, 0.5 - elevation_deg / 180))
    texel_deg = 360 / (2 * HEIGHT_PX)
    centre_deg = 180 - (math.floor(u * 2 * HEIGHT_PX) + 0.5) * texel_deg
    setups = collect_setups(
        LightSources(envmap=[str(envmap)], light=[f"{centre_deg},{elevation_deg}"]), tmp_path / "out"
    )
    lights = lights_over_rig(setups, "600", "cell")
    directions, weights = lights.directions, lights.weights
    mean = torch.einsum("lc,ld->cd", weights[0], directions)
    lamp = torch.einsum("lc,ld->cd", weights[1], directions)
    torch.testing.assert_close(weights.sum(1), torch.ones(2, 3), rtol=2e-3, atol=0)
    assert float((mean / mean.norm(dim=-1, keepdim=True) * lamp).sum(-1).min()) > math.cos(math.radians(3))
    assert (float(lamp[0, 0]) > 0) == (azimuth_deg > 0)  # + is the picture's right, +x


def test_rotation_adds_to_the_azimuth(tmp_path: Path) -> None:
    envmap = write_map(tmp_path / "one.exr", (0.5, 0.49))
    setups = collect_setups(LightSources(envmap=[str(envmap)], rotate="40"), tmp_path / "out")
    lights = lights_over_rig(setups, "600", "cell")
    directions, weights = lights.directions, lights.weights
    azimuth = torch.atan2(*(weights[0, :, 0] @ directions)[[0, 2]].split(1))
    assert math.degrees(float(azimuth)) == pytest.approx(40 - 360 / (4 * HEIGHT_PX), abs=3)


def test_lamps_shine_together_with_their_colours() -> None:
    entries = ["0,0", "a=90,0;rgb=1,0,0", "b=-90,0;rgb=0,0,2"]
    setups = collect_setups(LightSources(light=entries), Path("out"))[::-1]
    lights = lights_over_rig(setups, "150", "cell")
    directions, weights = lights.directions, lights.weights
    assert directions.shape == (3, 3)  # the rig is not needed
    torch.testing.assert_close(directions[0], torch.tensor([1.0, 0, 0]), atol=1e-6, rtol=0)
    torch.testing.assert_close(weights[0], torch.tensor([[1.0, 0, 0], [0, 0, 2], [0, 0, 0]]))
    torch.testing.assert_close(weights[1, 2], torch.ones(3))
    fill = single_lights(collect_setups(LightSources(light=["90,0,0.3"]), Path("out")))
    torch.testing.assert_close(fill.weights, torch.full((1, 1, 3), 0.3))


def test_lamps_of_a_stack_are_shared_by_the_lights_around_them() -> None:
    """Three at most, whose sum lies where the lamp is; a light of the stack is itself."""
    directions = rig_directions(50)
    azimuth, elevation = direction_to_azel(directions[7])
    own = f"{float(azimuth)},{float(elevation)};rgb=1,2,3"
    setups = collect_setups(LightSources(light=["30,20;rgb=1,2,3", own]), Path("out"))
    mixed, exact = lights_over_stack(setups, directions, "cell").weights
    lamp = azel_to_direction(30.0, 20.0)
    torch.testing.assert_close(mixed.sum(0), torch.tensor([1.0, 2, 3]))
    middle = torch.nn.functional.normalize(mixed[:, 0] @ directions, dim=0)
    torch.testing.assert_close(middle, lamp, atol=1e-5, rtol=0)
    assert 2 <= int((mixed != 0).any(-1).sum()) <= 3 and (mixed >= 0).all()
    torch.testing.assert_close(exact[7], torch.tensor([1.0, 2, 3]), atol=1e-4, rtol=0)
    apart = (directions @ lamp).max()
    assert math.isclose(math.cos(math.radians(off_rig_deg(setups, directions))), float(apart), rel_tol=1e-5)


def test_procedural_maps_are_those_that_envmap_writes(tmp_path: Path) -> None:
    assert main(["envmap", "-o", str(tmp_path), "--count", "2", "--seed", "3"]) == 0
    files = collect_setups(LightSources(envmap=[str(tmp_path)], rotate="0:360:2"), tmp_path / "out")
    sources = LightSources(envmap=["procedural:2"], rotate="0:360:2")
    maps = drawn_maps(sources, seed=3)
    assert not any(one.envmap.exists() for one in maps)  # until the work begins
    for one in maps:
        one.write()
    drawn = collect_setups(sources, tmp_path / "out", maps)
    assert [(setup.name, setup.frame) for setup in drawn] == [(setup.name, setup.frame) for setup in files]
    assert readable_setups(drawn) == drawn
    rigs = [lights_over_rig(setups, "12", "cell").weights for setups in (files, drawn)]
    np.testing.assert_allclose(rigs[0], rigs[1], rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("word", ["procedural:", "procedural:x", "procedural:10000"])
def test_a_bad_number_of_procedural_maps_is_refused(word: str) -> None:
    refused(UsageError, "procedural", drawn_maps, LightSources(envmap=[word]), 0)


def single(text: str) -> StudioLight:
    (image,) = lit_images([text])
    ((light,),) = image.frames
    return light


def test_lights_by_their_keys_and_by_the_names_of_presets() -> None:
    near = single("at=0.5,0.3,1;size=0.4;kelvin=3200;stops=+1;rgb=1,0.5,0.25;spot=40")
    assert near == StudioLight(None, (0.5, 0.3, 1.0), (1.0, 0.5, 0.25), 3200.0, 1.0, 0.4, 0.0, 40.0)
    far = StudioLight((40.0, 20.0), kelvin=5600.0, stops=-1.0, size_deg=30.0)
    assert single("from=40,20; kelvin=5600 ;stops=-1;size_deg=30") == far
    assert single("40,20,2") == single("from=40,20,2") == StudioLight((40.0, 20.0), rgb=(2.0, 2.0, 2.0))
    assert single("from=uniform;stops=-3") == StudioLight(stops=-3.0)
    assert single("at=0,0,1;size=0") == StudioLight(at_m=(0.0, 0.0, 1.0))
    assert lit_images(["rim"])[0].names == ("right", "left", "fill")
    assert lit_images(["rim=-150,15"])[0].frames == ((StudioLight((-150.0, 15.0)),),)
    assert lit_images(["rim=rim"])[0].names == ("rim_right", "rim_left", "rim_fill")
    assert lit_images(["name=map;map=a.exr"])[0].names == ("map",)  # as pages of `facerf view` write
    page = (Path(__file__).parents[2] / "docs/lights.md").read_text().partition("## Presets")[2]
    assert sorted(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)) == list(preset_names())
    setups = collect_setups(LightSources(light=preset_names()), Path("out"))
    assert [setup.name for setup in setups] == list(preset_names())
    assert all(setup.lights and len(setup.names) == len(setup.lights) for setup in setups)


def test_lights_with_names_share_an_image_whatever_their_form() -> None:
    entries = ["key=40,20;rim=160,10,2", "5,6", "name=top;at=0,1,0", "at=0,0,2;size=1"]
    images = lit_images(entries)
    assert [image.name for image in images] == ["light_5_6", "light_at_0_0_2_size_1", "light_key+rim+top"]
    assert images[2].names == ("key", "rim", "top") and images[0].names == ()
    (lights,) = images[2].frames
    assert lights[1] == StudioLight((160.0, 10.0), rgb=(2.0, 2.0, 2.0)) and lights[2].at_m == (0, 1, 0)


def test_a_name_a_place_and_options_combine_in_any_light() -> None:
    key = lit_images(["key=40,20;stops=-1;kelvin=3200"])[0]
    assert (key.name, key.names) == ("light_key", ("key",))
    assert key.frames == ((StudioLight((40.0, 20.0), kelvin=3200.0, stops=-1.0),),)
    assert lit_images(["name=key;40,20;stops=-1;kelvin=3200"]) == [key]
    assert lit_images(["stops=-1;kelvin=3200;name=key;from=40,20"]) == [key]
    assert single("40,20,2;rgb=0.25,0.25,0;size_deg=9") == StudioLight(
        (40.0, 20.0), rgb=(0.5, 0.5, 0.0), size_deg=9.0
    )
    assert [one.name for one in lit_images(["40,20;stops=1", "40.0,20"])] == [
        "light_40_20_stops_1",
        "light_40_20",
    ]


def test_options_of_a_preset_act_on_all_its_lights(tmp_path: Path) -> None:
    (plain,) = lit_images(["rembrandt"])
    named, alone = (
        lit_images(["key=rembrandt;stops=-1;rgb=1,0.5,1;face=2"]),
        lit_images(["rembrandt;stops=-1"]),
    )
    assert [light.stops for light in plain.frames[0]] == [0.0, -7.5]
    assert [light.stops for light in named[0].frames[0]] == [-1.0, -8.5]
    assert {(light.rgb, light.face) for light in named[0].frames[0]} == {((1.0, 0.5, 1.0), 2)}
    assert [light.at_m for light in named[0].frames[0]] == [light.at_m for light in plain.frames[0]]
    assert (named[0].name, named[0].names) == ("light_key", ("key_key", "key_fill"))
    assert (alone[0].name, alone[0].names) == ("light_rembrandt_stops_-1", ("key", "fill"))
    (tmp_path / "a;b=c.toml").write_text("[top]\nfrom = 'above'\n[side]\nfrom = '0:90:2,0'\n")
    (rig,) = lit_images([str(tmp_path / "a;b=c.toml")])
    assert (rig.name, rig.names, len(rig.frames)) == ("a;b=c", ("top", "side"), 2)
    assert rig.frames[1] == (StudioLight((0.0, 90.0)), StudioLight((45.0, 0.0)))


@pytest.mark.parametrize(
    "word, direction",
    [
        ("left", (-1, 0, 0)),
        ("right", (1, 0, 0)),
        ("above", (0, 1, 0)),
        ("below", (0, -1, 0)),
        ("front", (0, 0, 1)),
        ("behind", (0, 0, -1)),
    ],
)
def test_directions_have_words(word: str, direction: tuple[int, int, int]) -> None:
    """By the axes of the camera: x to the image's right, y up, z toward the camera."""
    azimuth, elevation = single(word).azel_deg or (0.0, 0.0)
    np.testing.assert_allclose(azel_to_direction(azimuth, elevation), direction, atol=1e-6)
    assert single(f"key={word}") == single(f"from={word}") == single(word)
    assert lit_images([f"{word};40,20"])[0].name == f"light_{word}+40_20"
    assert lit_images([f"{word}={word};stops=1"])[0].names == (word,)


def test_lights_apart_from_those_with_names_are_said(caplog: pytest.LogCaptureFixture) -> None:
    """Only what is mixed: lights without names get an image each, as documented."""

    def said(*entries: str, maps: tuple[str, ...] = ()) -> str:
        caplog.clear()
        sources = LightSources(light=[*entries], envmap=[*maps])
        collect_setups(sources, Path("out"), drawn_maps(sources, 0))
        return "\n".join(caplog.messages)

    assert said("40,20", "rembrandt") == said("key=40,20", "fill=rembrandt") == said("key=40,20") == ""
    mixed = said("key=40,20", "60,10", "5,6")
    assert mixed.startswith("light_60_10, light_5_6: ") and "light_key" in mixed
    assert "fill=rembrandt" in mixed and said("key=40,20", "rim").startswith("rim: ")
    assert said("key=40,20", maps=("procedural:1",)).startswith("00000_")
    assert said("key=40,20", maps=("sky=a.exr",)) == ""


def test_sweeps_number_their_frames_and_other_lights_shine_in_each() -> None:
    setups = collect_setups(LightSources(light=["from=-90:90:3,20"]), Path("out"))
    assert [setup.frame for setup in setups] == [".0000", ".0001", ".0002"]
    assert {setup.name for setup in setups} == {"light_from_-90_90_3_20"}  # and so of one exposure
    assert [setup.lights[0].azel_deg for setup in setups] == [(-90, 20), (-30, 20), (30, 20)]
    item = Item(Path("a.jpg"), Path("out/a"), "a")
    assert image_path(setups[1], item, "", ".exr") == Path("out/a_light_from_-90_90_3_20.0001.exr")
    both = collect_setups(LightSources(light=["0:20:2,0:90:2;stops=1"]), Path("out"))
    assert [setup.lights[0].azel_deg for setup in both] == [(0, 0), (10, 45)]
    assert collect_setups(LightSources(light=["0:20:1,5"]), Path("out"))[0].name == "light_0_20_1_5"
    setups = collect_setups(LightSources(light=["key=0:90:3,0", "fill=-40,0"]), Path("out"))
    assert [[light.azel_deg for light in setup.lights] for setup in setups] == [
        [(0, 0), (-40, 0)],
        [(30, 0), (-40, 0)],
        [(60, 0), (-40, 0)],
    ]
    assert all(setup.names == ("key", "fill") for setup in setups)
    refused(UsageError, "use the same N", lit_images, ["a=0:90:3,0", "b=0:90:2,0"])


@pytest.mark.parametrize(
    "entry, said",
    [
        ("at=0,0,1;colour=red", "'colour=red' ... keys: at, from"),
        ("at=0,0", "at '0,0' ... use X,Y,Z"),
        ("at=0,0,0.1", "at '0,0,0.1' ... use 0.15"),
        ("at=0,0,1;from=0,0", "use at=X,Y,Z"),
        ("kelvin=3200", "use at=X,Y,Z"),
        ("at=0,0,1;kelvin=50", "kelvin '50' ... use 1667 to 25000"),
        ("at=0,0,1;rgb=1,-1,1", "rgb '1,-1,1' ... use 0"),
        ("at=0,0,1;size_deg=3", "size_deg ... far lights ... remove it"),
        ("from=0,0;size=1", "size ... near lights ... remove it"),
        ("at=0,0,1;at=0,0,2", "at ... use a separate --light"),
        ("az=60,el=10", "use 'from=60,10;stops=1'"),
        ("from=0:90,3", "from '0:90' ... FROM:TO:N"),
        ("0:90:2,0:9:3", "use the same N"),
        ("az=0:360:24;el=10", "use from=0:360:24,10"),
        ("name=a;az=20", "use from=20,0"),
        ("a=40,20,1,2,3", "use 40,20;rgb=1,2,3"),
        ("from=0,0:200:4", "use -90 (below) to 90 (above)"),
        ("from=uniform;size_deg=3", "size_deg ... far lights (from=AZ,EL)"),
        ("at=0,0,1;rotate=30", "rotate ... maps (map=); remove it"),
        ("from=20,0;face=1.5", "face '1.5': use a whole number"),
        ("name=;at=0,0,1", "'': use a different name"),
        ("=40,20", "'': use a different name"),
        ("rembrant", "use AZ,EL, a rig file (.toml) or one of beauty, "),
        ("key=rembrant", "'key=rembrant' ... use AZ,EL"),
        ("key=40,20;colour=red", "'colour=red' ... use AZ,EL"),
        ("key=40,20,stops=-1", "use 'from=60,10;stops=1'"),
        ("key=40,20;at=0,0,3", "use a separate --light for each light"),
        ("a=40,20;b=left;stops=1", "use a separate --light for each light"),
        ("key=40,20;60,30", "name all"),
        ("name=a;key=40,20", "remove name="),
        ("size=rembrandt;stops=1", "use at=X,Y,Z"),
        ("key=rembrandt;size=3", "size ... near lights ... remove it"),
        ("from=up", "from 'up' ... use AZ,EL or one of left, right"),
        ("missing.toml", "missing.toml ... check the path"),
        ("original;at=0,0,1", "use a separate --light for each light"),
        ("original;size=1", "size ... near lights ... remove it"),
        ("original;size_deg=5", "size_deg ... far lights ... remove it"),
        ("original;rotate=5", "rotate ... maps (map=); remove it"),
        ("own;stops=1", "'own': no such light; use original"),
        ("even", "'even': no such light; use delight"),
        ("name=a;from=around", "'around': no such light; use uniform"),
    ],
)
def test_faults_say_what_to_give(entry: str, said: str) -> None:
    refused(UsageError, f"{said} ... --light", collect_setups, LightSources(light=[entry]), Path("out"))


def test_a_rig_file_is_one_image_with_a_layer_for_each_light(tmp_path: Path) -> None:
    (tmp_path / "studio.toml").write_text(
        "[key]\nat = [0.5, 0.3, 1]\nsize = 0.4\nkelvin = 3200\n[rim]\nfrom = '150:170:2,10'\nstops = -1\n"
    )
    setups = collect_setups(LightSources(light=[str(tmp_path / "studio.toml"), "key=1,2"]), tmp_path / "out")
    assert [setup.name + setup.frame for setup in setups] == ["studio.0000", "studio.0001", "light_key"]
    assert setups[0].names == ("key", "rim")
    assert setups[1].lights == (
        StudioLight(at_m=(0.5, 0.3, 1.0), kelvin=3200.0, size_m=0.4),
        StudioLight((160.0, 10.0), stops=-1.0),
    )


@pytest.mark.parametrize(
    "text, said",
    [
        ("[key]\nat = [0, 0, 1]\nwatts = 3\n", "key: 'watts' ... use at, from"),
        ("[key]\nname = 'a'\nat = [0, 0, 1]\n", "key: 'name' ... use at, from"),
        ("[key]\nat = [0, 0]\n", "key: at '0.0,0.0' ... use X,Y,Z"),
        ("['a b']\nat = [0, 0, 1]\n", "'a b': use a different name"),
        ("[key]\nfrom = 'up'\n", "key: from 'up' ... use AZ,EL or one of left, right"),
        ("[key]\nfrom = 'own'\n", "key: from 'own': no such light; use original"),
        ("[a]\nfrom = '0:9:2,0'\n[b]\nfrom = '0:9:3,0'\n", "use the same N"),
    ],
)
def test_a_fault_of_a_rig_file_names_file_and_light(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "studio.toml"
    path.write_text(text)
    refused(InputError, f"{path} ... {said}", lit_images, [str(path)])


def test_near_lights_are_kept_apart_from_far_ones_and_prepared_once() -> None:
    entries = ["name=a;at=0,0,1;stops=1", "b=30,0", "at=0,0,1;rgb=1,0,0", "at=0,0,2"]
    setups = collect_setups(LightSources(light=entries), Path("out"))  # the image of names comes last
    lights = lights_over_rig(setups, "150", "cell")
    assert [light.at_m for light in lights.near] == [(0, 0, 1), (0, 0, 2)]
    assert lights.near_weights is not None and lights.near_weights.tolist() == [
        [[1, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [1, 1, 1]],
        [[2, 2, 2], [0, 0, 0]],
    ]
    assert len(lights.directions) == 1 and lights.weights.sum((1, 2)).tolist() == [0, 0, 3]
    assert [light.at_m for light in lights.some(slice(1, 2)).near] == [(0, 0, 2)]
    alone = lights_over_rig(setups[:1], "150", "cell")
    assert len(alone.directions) == 1 and alone.weights.abs().max() == 0  # a dark one, since models want one


def test_strengths_count_all_light_wherever_it_comes_from(tmp_path: Path) -> None:
    write_exr(tmp_path / "even.exr", np.full((16, 32, 3), 0.5, np.float32))
    entries = ["0,0,3", "180,0", "at=0,0,1;stops=1", "from=uniform"]
    setups = collect_setups(LightSources(envmap=[str(tmp_path / "even.exr")], light=entries), Path("out"))
    assert lights_over_rig(setups, "150", "cell").strengths() == pytest.approx(
        [2, 3, 1, 2, 4], rel=1e-3
    )  # an even map of 0.5 first
