"""Ambient fill, which lights have by default, and maps that share an image with lights."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.errors import UsageError
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.image.strips import resized
from facerf_cli.light.entries import StudioLight
from facerf_cli.light.light import UNIFORM_LIGHTS, Light
from facerf_cli.light.over_rig import as_lit, lights_over_rig, with_ambient
from facerf_cli.light.setups import LightSetup, LightSources, collect_setups, set_ambient
from facerf_cli.main import main
from facerf_cli.work.relight_options import parse_background
from tests.astronaut import PATH as PHOTO
from tests.cli.lines import relight
from tests.exr_layers import exr_layers
from tests.kinds import Said
from tests.refusals import refused

KEY, RIM = "name=key;from=40,20;kelvin=3200", "name=rim;from=160,0;stops=-1;rgb=0.5,1,1"


@pytest.fixture
def sky(tmp_path: Path) -> Path:
    path = tmp_path / "sky.exr"
    write_exr(path, np.random.default_rng(1).uniform(0, 2, (16, 32, 3)).astype(np.float32))
    return path


def setups_of(
    light: list[str], envmap: list[str] | None = None, rotate: str | None = None
) -> list[LightSetup]:
    return list(collect_setups(LightSources(envmap=envmap, light=light, rotate=rotate), Path("out")))


def lights_of(*setups: LightSetup) -> Light:
    return lights_over_rig(tuple(with_ambient(setup) for setup in setups), "150", "cell")


def test_a_named_light_is_one_of_the_sums_that_it_shines_in() -> None:
    (setup,) = setups_of([KEY, RIM])
    found = lights_over_rig(as_lit((replace(setup, ambient=0.1),), 0), "150", "cell")
    assert len(found.weights) == 4 and len(found.directions) == 2 + UNIFORM_LIGHTS
    torch.testing.assert_close(found.weights[0], found.weights[1:].sum(0))


@pytest.mark.parametrize(
    ("background", "share"),
    [
        ("photo", 0.06),
        ("#b0b0b0", 0.06),
        ("0.5,0.5,0.5", 0.06),
        ("none", 0.03),
        ("envmap", 0.03),  # black behind lights
        ("#000000", 0.03),
        ("#202830", 0.03),
    ],
)
def test_the_default_share_follows_the_background(background: str, share: float) -> None:
    (setup,) = setups_of([KEY])
    assert set_ambient(setup, None, parse_background(background).is_dark(setup)).ambient == share


def test_a_map_has_no_ambient_fill_and_a_light_of_that_name_replaces_it(sky: Path) -> None:
    (mapped,) = setups_of([], [str(sky)])
    assert set_ambient(mapped, None, False) == set_ambient(mapped, "0.5", False) == mapped
    for entry in ("name=fill;from=uniform", "ambient=90,0"):
        (setup,) = setups_of([KEY, entry])
        assert set_ambient(setup, None, False) == setup
    refused(UsageError, "--ambient 0.1: a light has this name", set_ambient, setup, "0.1", False)


def test_none_leaves_the_lights_and_ambient_fill_is_a_fraction_of_their_sum() -> None:
    (setup,) = setups_of([KEY, RIM])
    assert set_ambient(setup, "none", False) == setup == with_ambient(setup)
    assert set_ambient(setup, "0", False) == setup
    red, near = "name=a;from=90,0;rgb=1,0,0", "name=b;at=0,0,1;rgb=0,2,0;stops=1"
    (setup,) = setups_of([red, near])
    lit = with_ambient(set_ambient(setup, "0.1", False))
    assert lit.names == ("a", "b", "ambient") and lit.lights[:2] == setup.lights
    assert lit.lights[2] == StudioLight(rgb=pytest.approx((0.1, 0.4, 0.0)))


def test_stacked_images_stay_sums(sky: Path) -> None:
    """Of lights by themselves, and of a map with them: weights of all that shines add up."""
    key, rim, together, alone = (
        set_ambient(setup, None, False)
        for setup in (
            *setups_of([KEY]),
            *setups_of([RIM]),
            *setups_of([KEY, RIM], [f"sky={sky}"]),
            *setups_of([], [str(sky)]),
        )
    )
    assert together.names == ("sky", "key", "rim") and together.name == "light_sky+key+rim"
    every = lights_of(key, rim, alone, together)
    arriving = torch.einsum("mlc,ld->mcd", every.weights, every.directions.abs())  # of each sum, by direction
    torch.testing.assert_close(arriving[:3].sum(0), arriving[3], rtol=1e-5, atol=1e-6)
    assert every.strengths()[3] == pytest.approx(sum(every.strengths()[:3]), rel=1e-5)


def test_a_map_with_a_name_turns_in_every_frame_and_has_an_intensity(sky: Path) -> None:
    frames = setups_of(["key=40,20"], [f"sky={sky}"], rotate="0:90:3")
    assert [setup.frame for setup in frames] == [".0000", ".0001", ".0002"]
    assert [setup.lights[0].rotate_deg for setup in frames] == [0, 30, 60]
    dim, turned = setups_of([f"name=sky;map={sky};stops=-1;rotate=30"]), setups_of([], [str(sky)], "30")
    weights = lights_of(*dim, *turned).weights
    torch.testing.assert_close(2 * weights[0], weights[1])


def test_maps_of_rig_files_and_of_the_ambient_fill(sky: Path) -> None:
    rig = sky.with_name("studio.toml")
    rig.write_text("[sky]\nmap = 'sky.exr'\nstops = -1\n[key]\nfrom = [40, 20]\n")
    (setup,) = setups_of([str(rig)])
    assert setup.lights[0] == StudioLight(envmap=sky, stops=-1.0) and setup.names == ("sky", "key")
    (setup,) = setups_of([KEY])
    lit = set_ambient(setup, str(sky), False)
    assert lit.names == ("key", "ambient") and lit.lights[1] == StudioLight(envmap=sky)


def test_the_ambient_fill_is_logged_and_a_stack_has_none(
    given: Path, stack: Path, tmp_path: Path, capsys: Said
) -> None:
    line = ["--light", "70,0", "--composite", "face"]
    assert relight(given, tmp_path / "a", *line) == 0
    assert "3 % ambient fill (--ambient)" in capsys.readouterr().err
    for name, more in (("default", []), ("none", ["--ambient", "none"]), ("wide", ["--ambient", "0.5"])):
        assert relight(given, tmp_path / name, "--light", "70,0", *more, photo=stack) == 0
    assert capsys.readouterr().err.count("ambient fill") == 1
    images = {
        name: read_image(next((tmp_path / name).glob("*.exr"))).pixels for name in ("default", "none", "wide")
    }
    np.testing.assert_array_equal(images["default"], images["none"])
    assert images["wide"].mean() > 1.2 * images["none"].mean()


def test_each_person_of_a_group_has_lights_of_its_own(given: Path, tmp_path: Path, capsys: Said) -> None:
    """Red on the left one, which is smaller and so composed last, green on the right one."""
    small = read_image(PHOTO).pixels[:300, 60:400]
    large = resized(small, 375, 425)
    write_display(
        tmp_path / "two.png", np.concatenate([np.pad(small, ((0, 75), (0, 0), (0, 0)), "edge"), large], 1)
    )
    red, green = "name=a;from=20,10;rgb=1,0,0;face=0", "name=b;from=-20,10;rgb=0,1,0;face=1"
    line = ["--reflectance", "field", "--ambient", "none", "--background", "0,0,0", "--format", "exr"]
    checkpoint = ["--checkpoint", str(given / "lambert.safetensors")]
    photo = [*checkpoint, "relight", str(tmp_path / "two.png"), "--light", red, "--light", green, *line]
    assert main([*photo, "--face", "all", "-o", str(tmp_path / "out")]) == 0
    layers = exr_layers(tmp_path / "out/two_light_a+b.exr")
    for of_red, of_green in (("R", "G"), ("a.R", "b.G")):
        assert layers[of_red][:, :340].max() > 0.05 and layers[of_green][:, 340:].max() > 0.05
        assert layers[of_red][:, 400:].max() == 0 == layers[of_green][:, :300].max()
    one = [*photo[:4], "--light", green, *line, "--face"]
    assert main([*one, "1", "-o", str(tmp_path / "one")]) == 0
    assert exr_layers(tmp_path / "one/two_light_b.exr")["G"][:, 400:].max() > 0.05
    for rejected, code in (([*photo[:4], "--light", red], 1), ([*one, "0"], 1), (photo, 1)):
        assert main([*rejected, *line, "-o", str(tmp_path / "rejected")]) == code
        assert "add --face all" in capsys.readouterr().err
    assert not any((tmp_path / "rejected").glob("*.exr"))
