"""Even light that is as bright as the photo."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import facerf_cli as facerf
from facerf_cli.files.read import read_image
from facerf_cli.image.colour import luminance
from facerf_cli.light.entries import EVEN, lit_images
from facerf_cli.relighting.white import Balance
from facerf_cli.work.light_setups import LightSources, collect_setups, in_room
from facerf_cli.work.lights import as_in_photo, with_room
from tests import astronaut
from tests.cli.test_relight import relight
from tests.exr_layers import exr_layers


@pytest.mark.parametrize("entry", ["even", "from=even", "name=even;from=even", "even;stops=-1"])
def test_even_is_a_light_of_that_name_from_all_around(entry: str) -> None:
    (image,) = lit_images([entry])
    (light,) = image.frames[0]
    assert image.names == (EVEN,) and light.even and light.is_around
    assert light.stops == (-1.0 if "stops" in entry else 0.0)


def test_its_brightness_is_that_of_each_person_and_it_is_its_own_room() -> None:
    (setup,) = collect_setups(LightSources(light=["even;rgb=1,.5,.5", "key=40,20"]), Path("out"))
    lit = with_room(in_room(as_in_photo(setup, 3.0), None, False))
    assert [light.rgb for light in lit.lights] == [(3.0, 1.5, 1.5), (1.0, 1.0, 1.0)]
    assert lit.lights[0].is_around and not lit.lights[0].even


def test_skin_is_as_bright_as_in_the_photo_at_0_ev_and_own_adds_to_it(given: Path, tmp_path: Path) -> None:
    line = ["--light", "even", "--light", "own;stops=-1", "--format", "exr"]
    assert relight(given, tmp_path, *line) == 0
    (ev,) = json.loads((tmp_path / "report.jsonl").read_text())["exposure_ev"].values()
    assert ev == 0
    path, photo = tmp_path / "astronaut_light_even+own.exr", astronaut.photo()
    channels = exr_layers(path)
    even = np.stack([channels[f"even.{c}"] for c in "RGB"], -1)
    skin = (astronaut.person().segmentation.layer("skin") > 0.9) & (channels["person.A"] == 1)
    shown, plate = (float(luminance(image)[skin].mean()) for image in (even, photo))
    assert shown == pytest.approx(
        plate, rel=0.1
    )  # that of the face's field alone, which is part of the image
    mixed = read_image(path).pixels
    np.testing.assert_allclose(mixed[skin], (even + 0.5 * photo)[skin], rtol=2e-3, atol=1e-3)


def test_python_has_it_of_a_person() -> None:
    fitted, field = astronaut.person(), astronaut.person().reflectance.field
    field = replace(field, balance=Balance(torch.ones(3), torch.zeros(2), 2.5))
    person = facerf.Person(fitted.models, fitted.photo, fitted.head, replace(fitted.reflectance, field=field))
    assert person.even.weights == pytest.approx(2.5 * facerf.Light.around().weights)
