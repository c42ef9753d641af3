"""A page's lights are those of `--light`: their grammar, colours and samples. Needs Chromium."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facerf_cli import viewer
from facerf_cli.light.entries import DELIGHT, ORIGINAL, WORDS, StudioLight, lit_images
from facerf_cli.light.light import far_samples, intensity_of
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.viewer.page import packed_lights
from tests.viewer.browser import chromium, driven

SCRIPTS = ("light.js", "lights.js")
_SCRIPT = """
  const known = %s;
  return %s.map((text) => {
    try {
      const lights = lightsOf(text, known);
      const samples = lights.map((light) => samplesOf(light).map(([at, share]) => [...at, share]));
      return { lights, samples, rgb: lights.map(rgbOf), texts: textsOf(lights) };
    } catch (error) {
      return { error: error.message };
    }
  });
"""
ONE = [
    "40,25",
    "40,25,2",
    "-30,10;rgb=1,0.5,0.25",
    "from=75,20;kelvin=1800",
    "from=75,20;kelvin=3200;stops=-1.5;rgb=1,0.8,0.6",
    "from=120,-30;kelvin=12000;size_deg=5",
    "from=0,90;size_deg=60",
    "0,89.9;size_deg=3",
    "from=-140,40;size_deg=120",
    "from=uniform;stops=-5;kelvin=4000",
    "original",
    "original;stops=-1.5;kelvin=5000",
    "name=day;from=original;rgb=1,0.9,0.8",
]
MANY = ["40,25;-60,10,2", "key=40,20;rim=160,10,0.5", *("beauty", "rembrandt", "rim")]
FREE = {  # forms that are one with others
    "key=40,20;stops=-1": "name=key;from=40,20;stops=-1",
    "left": "-90,0",
    "right;kelvin=3200": "from=90,0;kelvin=3200",
    "key=above": "key=0,90",
    "below": "0,-90",
    "behind": "180,0",
    "from=front;size_deg=20": "from=0,0;size_deg=20",
    "uniform": "from=uniform",
    "at=0.6,0.8,1;size=0.5": "from=30.9637565321,34.4499019880;size_deg=20.0499757242",
    "at=0,0,-2": "180,0",
}
WRONG = {
    "foo": "light foo: foo is no direction; give AZ,EL, left, right",
    "40,100": "40,100 is no direction",
    "from=40,20;kelvin=900": "kelvin 900: give a number from 1667 to 25000",
    "key=40,20;rim=160,10;stops=1": "keys are of one light",
    "from=40,20;at=1,1,1": "give one direction",
    "map=sky.exr": "map= is not shown in a page",
    "1st=40,20": "1st is no name",
    "from=1=2": "give ; between keys",
}


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the scripts make of each text."""
    chromium()
    texts = [
        *ONE,
        *MANY,
        *FREE,
        *FREE.values(),
        *WRONG,
        "key=rembrandt;stops=-1;rgb=1,0.5,0.5",
        "rim;kelvin=3200",
    ]
    parts = [(Path(viewer.__file__).parent / name).read_text(encoding="utf-8") for name in SCRIPTS]
    page = f'<html><body data-settled="true"><script>{"".join(parts)}</script></body></html>'
    script = _SCRIPT % (json.dumps(packed_lights(True)), json.dumps(texts))
    return dict(zip(texts, driven(page, script, tmp_path_factory.mktemp("lights")), strict=True))


def assert_is(given: dict[str, Any], lights: tuple[StudioLight, ...]) -> None:
    """Each light's colour and samples; a near one has the direction of its middle."""
    assert len(given["lights"]) == len(lights)
    for one, samples, rgb, light in zip(given["lights"], given["samples"], given["rgb"], lights, strict=True):
        np.testing.assert_allclose(rgb, intensity_of(light), rtol=2e-4, atol=1e-6)
        assert one["uniform"] == light.is_uniform and one["original"] == light.original
        if light.at_m is not None:
            toward = np.array(light.at_m) / np.linalg.norm(light.at_m)
            np.testing.assert_allclose(azel_to_direction(one["azimuth"], one["elevation"]), toward, atol=1e-6)
        elif light.azel_deg is not None:
            directions, shares = far_samples(light)
            truth = np.concatenate([directions, shares[:, None]], 1)
            np.testing.assert_allclose(samples, truth, atol=2e-6)


@pytest.mark.parametrize("text", [*ONE, *MANY])
def test_a_light_has_the_colour_and_the_samples_that_relight_gives_it(
    text: str, found: dict[str, Any]
) -> None:
    (image,) = lit_images([text])
    assert_is(found[text], image.frames[0])
    assert [light["name"] for light in found[text]["lights"] if light["name"]] == list(image.names)


@pytest.mark.parametrize("text", [*ONE, *MANY, *FREE])
def test_the_text_of_lights_gives_them_again(text: str, found: dict[str, Any]) -> None:
    (image,) = lit_images(found[text]["texts"])
    given = found[text]
    for one, rgb, light in zip(given["lights"], given["rgb"], image.frames[0], strict=True):
        where = (
            None
            if one["uniform"] or one["original"]
            else pytest.approx((one["azimuth"], one["elevation"]), abs=6e-3)
        )
        assert light.azel_deg == where and light.original == one["original"]  # texts have two decimals
        assert light.size_deg == pytest.approx(one["size"], abs=6e-3)
        np.testing.assert_allclose(intensity_of(light), rgb, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("original", "original"),
        ("original;stops=-1.5;kelvin=5000", "original;kelvin=5000;stops=-1.5"),
        (ONE[-1], ONE[-1]),
    ],
)
def test_the_original_light_is_written_by_its_word(text: str, written: str, found: dict[str, Any]) -> None:
    assert found[text]["texts"] == [written]


def test_every_word_is_packed_and_keys_of_a_preset_act_on_all_of_its_lights(found: dict[str, Any]) -> None:
    assert set(packed_lights(True)["words"]) == set(WORDS)
    assert set(WORDS) - set(packed_lights(False)["words"]) == {ORIGINAL, DELIGHT}
    assert packed_lights(True, 1.5)["words"][DELIGHT]["rgb"] == (1.5, 1.5, 1.5)
    lights = found["key=rembrandt;stops=-1;rgb=1,0.5,0.5"]["lights"]
    assert [(one["name"], one["stops"]) for one in lights] == [("key_key", -1), ("key_fill", -8.5)]
    assert all(one["rgb"] == [1, 0.5, 0.5] for one in lights)
    warm = found["rim;kelvin=3200"]["lights"]
    assert [(one["name"], one["kelvin"]) for one in warm] == [("right", 3200), ("left", 3200), ("fill", 3200)]


@pytest.mark.parametrize("text", FREE)
def test_words_names_and_near_lights_stand_for_directions(text: str, found: dict[str, Any]) -> None:
    for one, other in zip(found[text]["lights"], found[FREE[text]]["lights"], strict=True):
        for key in ("azimuth", "elevation", "size", "stops", "kelvin"):
            assert one[key] == pytest.approx(other[key], abs=1e-4), key
        assert one["name"] == other["name"]


@pytest.mark.parametrize("text", WRONG)
def test_what_is_no_light_is_said_in_a_line(text: str, found: dict[str, Any]) -> None:
    assert WRONG[text] in found[text]["error"]
