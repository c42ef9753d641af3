"""The original light, and the light that removes it; other lights add to both."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import facerf_cli as facerf
from facerf_cli.errors import UsageError
from facerf_cli.files.read import read_image
from facerf_cli.image.colour import SOFT_VIEW, encode_display, linear_to_srgb, luminance
from facerf_cli.light.entries import DELIGHT, ORIGINAL, LitImage, lit_images
from facerf_cli.light.light import Light
from facerf_cli.light.over_rig import lights_over_rig, with_ambient
from facerf_cli.light.setups import LightSources, collect_setups, set_ambient
from facerf_cli.person import Target
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.white import WhiteBalance
from tests import astronaut
from tests.astronaut import PATH as PHOTO
from tests.cli.lines import relight
from tests.exr_layers import exr_layers
from tests.folders import only_row
from tests.refusals import refused

HALF = 2.0**-11  # relative error of half floats


def image_of(*entries: str) -> LitImage:
    (image,) = lit_images(entries)
    return image


@pytest.mark.parametrize(
    "entry", ["original", "from=original", "name=original;from=original", "original;stops=-1"]
)
def test_original_is_a_light_of_that_name(entry: str) -> None:
    image = image_of(entry)
    assert image.names == (ORIGINAL,) and image.name == "light_original"
    (light,) = image.frames[0]
    assert light.original and not light.is_uniform and light.stops == (-1.0 if "stops" in entry else 0.0)


def test_original_is_a_light_like_others_but_for_the_ambient_fill() -> None:
    image = image_of("key=40,20", "name=day;from=original;rgb=1,.9,.8")
    assert image.names == ("key", "day") and image.frames[0][1].rgb == (1.0, 0.9, 0.8)
    assert not image_of("original=40,20").frames[0][0].original  # a light of that name
    (both,) = collect_setups(LightSources(light=["original", "key=40,20;stops=1"]), Path("out"))
    assert set_ambient(both, None, False).ambient == 0
    asked = with_ambient(set_ambient(both, "0.1", False))
    assert asked.names == ("original", "key", "ambient")
    assert asked.lights[2].rgb == pytest.approx((0.2, 0.2, 0.2))
    (alone,) = collect_setups(LightSources(light=["original"]), Path("out"))
    assert not alone.has_single
    lights = lights_over_rig((alone, both), "12", "cell")
    assert lights.original_rgb is not None and lights.original_rgb.tolist() == [[1, 1, 1], [1, 1, 1]]
    assert lights.weights.abs().sum((1, 2)).tolist() == [0, 6]


def test_alone_it_gives_the_photo_back(given: Path, tmp_path: Path) -> None:
    assert relight(given, tmp_path, "--light", "original") == 0
    image, photo = read_image(tmp_path / "astronaut_light_original.exr").pixels, read_image(PHOTO).pixels
    assert np.abs(image - photo).max() <= HALF
    shown, plate = (read_image(path).pixels for path in (tmp_path / "astronaut_light_original.png", PHOTO))
    assert np.abs(linear_to_srgb(shown) - linear_to_srgb(plate)).max() < 1.5 / 255
    (ev,) = only_row(tmp_path)["exposure_ev"].values()
    assert ev == 0


def test_layers_of_lights_and_the_background_add_up_to_the_image(given: Path, tmp_path: Path) -> None:
    line = ["--light", "original;stops=-1", "--light", "key=40,25;kelvin=3200", "--format", "exr"]
    assert relight(given, tmp_path, *line) == 0
    path, photo = tmp_path / "astronaut_light_original+key.exr", read_image(PHOTO).pixels
    channels = exr_layers(path)
    original, key = (np.stack([channels[f"{name}.{c}"] for c in "RGB"], -1) for name in ("original", "key"))
    sure, image = channels["person.A"] == 1, read_image(path).pixels
    assert np.abs(original - 0.5 * photo)[sure].max() < 2 * HALF
    behind = photo - 2 * original  # of the background what is seen
    assert np.abs(image - behind - original - key).max() < 6 * HALF
    assert key[sure].mean() > 0.01 and np.abs(behind[sure]).max() < 4 * HALF


def test_exposure_is_chosen_where_it_is_asked(given: Path, tmp_path: Path) -> None:
    line = ["--light", "original;stops=-3", "--exposure", "auto", "--format", "png"]
    assert relight(given, tmp_path, *line) == 0
    (ev,) = only_row(tmp_path)["exposure_ev"].values()
    assert 2.5 < ev < 3.5


def test_the_soft_view_bends_what_other_lights_add() -> None:
    photo = np.linspace(0, 1, 33, dtype=np.float32).repeat(3).reshape(3, 11, 3)
    plain = encode_display(photo, SOFT_VIEW, added=np.zeros_like(photo))
    assert np.abs(plain - linear_to_srgb(photo)).max() < 1e-6
    more = encode_display(photo + 0.5, SOFT_VIEW, added=np.full_like(photo, 0.5))
    bent = encode_display(photo + 0.5, SOFT_VIEW)
    assert (more >= plain - 1e-6).all() and np.abs(more[0] - bent[0]).max() < 1e-6  # dark: all of it is added
    assert (more >= bent - 1e-6).all() and (more[-1, 4:] > bent[-1, 4:]).all()


def test_two_people_under_the_original_light_are_the_photo() -> None:
    photo, person = astronaut.photo(), astronaut.person()
    height, width = photo.shape[:2]
    left = np.clip((width / 2 - np.arange(width)) / 40 + 0.5, 0, 1).astype(np.float32)[None].repeat(height, 0)
    both = PeopleInPhoto([person.in_photo(Target(matte=side)) for side in (left, 1 - left)])
    dark = Light(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 1, 3), original_rgb=torch.ones(1, 3))
    (relit,) = both.relit([dark, dark])
    assert np.abs(both.image(relit) - photo).max() < 1e-5


def test_python_adds_lights_to_it() -> None:
    fitted = astronaut.person()
    person = facerf.Person(fitted.models, fitted.photo, fitted.head, fitted.reflectance)
    key = facerf.Light.single(40, 20)
    photo, half, lit = person.relight([facerf.Light.original(), 0.5 * facerf.Light.original() + key, key])
    assert np.abs(photo - astronaut.photo()).max() < 1e-5
    sure = person.matte == 1
    assert np.abs(half - lit - 0.5 * photo)[sure].max() < 1e-5


def test_python_refuses_what_it_has_not() -> None:
    fitted = astronaut.person()
    person = facerf.Person(fitted.models, fitted.photo, fitted.head, fitted.reflectance)
    light = facerf.Light.original() + facerf.Light.single(0, 0)
    refused(UsageError, "original light", light.to_envmap)
    refused(UsageError, "whole photo", person.relight, light, pose=(5.0, 0.0, 0.0))
    refused(TypeError, "directions", person.olat, light)


@pytest.mark.parametrize(
    "entry", ["delight", "from=delight", "name=delight;from=delight", "delight;stops=-1"]
)
def test_delight_is_a_uniform_light_of_that_name(entry: str) -> None:
    (image,) = lit_images([entry])
    (light,) = image.frames[0]
    assert image.names == (DELIGHT,) and light.delight and light.is_uniform
    assert light.stops == (-1.0 if "stops" in entry else 0.0)


def test_its_brightness_is_that_of_each_person_and_it_gets_no_ambient_fill() -> None:
    (setup,) = collect_setups(LightSources(light=["delight;rgb=1,.5,.5", "key=40,20"]), Path("out"))
    lit = with_ambient(set_ambient(setup.on_person(0, 3.0), None, False))
    assert [light.rgb for light in lit.lights] == [(3.0, 1.5, 1.5), (1.0, 1.0, 1.0)]
    assert lit.lights[0].is_uniform and not lit.lights[0].delight


def test_skin_is_as_bright_as_in_the_photo_and_the_original_adds_to_it(given: Path, tmp_path: Path) -> None:
    line = ["--light", "delight", "--light", "original;stops=-1", "--format", "exr"]
    assert relight(given, tmp_path, *line) == 0
    (ev,) = only_row(tmp_path)["exposure_ev"].values()
    assert ev == 0
    path, photo = tmp_path / "astronaut_light_delight+original.exr", astronaut.photo()
    channels = exr_layers(path)
    delight = np.stack([channels[f"delight.{c}"] for c in "RGB"], -1)
    skin = (astronaut.person().segmentation.layer("skin") > 0.9) & (channels["person.A"] == 1)
    shown, plate = (float(luminance(image)[skin].mean()) for image in (delight, photo))
    assert shown == pytest.approx(plate, rel=0.1)  # the intensity is that of the face field only
    mixed = read_image(path).pixels
    np.testing.assert_allclose(mixed[skin], (delight + 0.5 * photo)[skin], rtol=2e-3, atol=1e-3)


def test_python_has_it_of_a_person() -> None:
    fitted, field = astronaut.person(), astronaut.person().reflectance.field
    field = replace(field, balance=WhiteBalance(torch.ones(3), torch.zeros(2), 2.5))
    person = facerf.Person(fitted.models, fitted.photo, fitted.head, replace(fitted.reflectance, field=field))
    assert person.delight.weights == pytest.approx(2.5 * facerf.Light.uniform().weights)
