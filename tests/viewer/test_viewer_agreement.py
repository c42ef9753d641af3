"""A page agrees with `facerf relight` at lights from all sides; its controls. Skipped without Chromium."""

import base64
import io
import json
import math
import shlex
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from facerf_cli.face.head import shrunk_photo
from facerf_cli.files.read import read_image
from facerf_cli.image.colour import (
    MOST_OVER_FRONT_EV,
    SOFT_VIEW,
    encode_display,
    linear_to_srgb,
    most_exposure_ev,
)
from facerf_cli.image.strips import resized
from facerf_cli.light.entries import StudioLight
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.light import Light, far_samples
from facerf_cli.light.over_rig import lights_over_rig, with_ambient
from facerf_cli.light.setups import LightSources, collect_setups, set_ambient
from facerf_cli.light.sphere import azel_to_direction, direction_to_azel, rig_directions
from facerf_cli.main import main
from facerf_cli.person import Person
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.fitting import head_of, reflectance_of
from facerf_cli.relighting.models import load_models
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.relighting.relightable import RenderRequest
from facerf_cli.viewer.page import packed, page
from facerf_cli.work.view import head_place, of_photo, page_maps
from tests.viewer.browser import Drawn, chromium, drawn, driven

pytestmark = pytest.mark.slow
ASTRONAUT = Path(__file__).parents[2] / "examples" / "astronaut.jpg"
MEAN, PERCENTILE_99 = (
    2.0,
    10.0,
)  # of 255, on the rig; rims of lights behind are thinner than the page's ratios
MEAN_BETWEEN, PERCENTILE_95 = 3.0, 10.0  # between its lights


@dataclass(frozen=True, eq=False)
class Shown:
    whole: PeopleInPhoto
    text: str

    def relit(self, directions: torch.Tensor, weights: torch.Tensor, ambient: float = 0.06) -> Any:
        """Under lights and their ambient fill."""
        around, shares = far_samples(StudioLight())
        sent = ambient * shares[:, None] * weights.sum(0)
        lights = Light(torch.cat([directions, around]), torch.cat([weights, sent])[None])
        return next(self.whole.relit(lights))

    def truth(self, relit: Any, ev: float) -> np.ndarray:
        """The PNG of `facerf relight` [H, W, 3]."""
        gain = np.float32(2.0**ev)
        added = None
        if relit[0].original_rgb is not None:
            added = gain * self.whole.light_layer([replace(relit[0], original_rgb=None)])
        exposed = gain * self.whole.rendered(RenderRequest(relit, ev=ev))["rgb"]
        return np.round(255 * encode_display(exposed, SOFT_VIEW, self.whole.matte, added))

    def errors(self, found: np.ndarray, relit: Any, ev: float) -> np.ndarray:
        """Of all values of the person."""
        return np.asarray(np.abs(self.truth(relit, ev) - found[..., :3])[self.whole.matte > 0.5])


@cache
def shown() -> Shown:
    models = load_models()
    photo = read_image(ASTRONAUT).pixels
    face = find_faces(models.networks.people, photo, "astronaut")[0]
    photo, head = shrunk_photo(photo, head_of(models, photo, face, sides=models.sides(128)), 384)
    photo = np.clip(photo, 0, 1)
    basis, plate = of_photo(models, photo, head)
    field = reflectance_of(models, head, "portrait", photo=photo)
    assert isinstance(field, PortraitField)
    sun = [one for one in page_maps() if one.name == "sun"]
    document = packed(basis, plate, head_place(head.fit.crop, plate.matte), sun)
    whole = PeopleInPhoto([Person(models, photo, head, field).in_photo()])
    return Shown(whole, page("me.jpg", ["me.jpg"], document, ""))


def photo_in(text: str) -> np.ndarray:
    """The photo [H, W, 3] of a page, in 0..255."""
    document = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(document["photo"])))).astype(np.float64)


def towards(*lights: tuple[float, float]) -> torch.Tensor:
    return torch.stack([azel_to_direction(*light) for light in lights]).float()


def on_rig(*lights: tuple[float, float]) -> torch.Tensor:
    """The lights of the rig nearest to some."""
    rig = rig_directions()
    return rig[(towards(*lights) @ rig.T).argmax(1)]


def text_of(light: torch.Tensor) -> str:
    return ",".join(f"{float(x):.4f}" for x in direction_to_azel(light))


RIG = on_rig((40, 25), (0, 80), (-140, 20), (180, 10))
BETWEEN = [(40, 25), (-70, 10), (0, -40), (110, 20), (-30, 50)]
ORIGINAL_LIGHT = Light(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 1, 3), original_rgb=torch.ones(1, 3))
PAIR = on_rig((75, 20), (-150, 10))
COLOURED = f"light=a={text_of(PAIR[0])};rgb=1,0.5,0.25&light=b={text_of(PAIR[1])}&ev=-0.5"
ALONE, MAP = COLOURED + "&background=none", "env=sun&rotate=50"
BOTH = f"{MAP}&mapstops=-2&ambient=0.2&{COLOURED}"
SOFT = "light=key=40,25;kelvin=3200;size_deg=40&light=fill=left;stops=-2;rgb=0.5,0.7,1"
PRESET = "light=key=loop;stops=-1&light=ambient=uniform;stops=-4"
MAP_WITH_AMBIENT = f"{MAP}&ambient=0.3"
ORIGINAL, DIMMED = "light=original", "light=original;stops=-1&ev=1"  # as bright as the photo, both
RIM = "light=original&light=rim=-150,15,2"
ORIGINAL_WITH_AMBIENT = (
    f"light=name=day;from=original;stops=-1;kelvin=5000&light=40,25&{MAP}&ambient=0.2&ev=-0.5"
)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Drawn]:
    """What the page draws at each address."""
    chromium()
    addresses = [f"light={text_of(light)}" for light in RIG]
    addresses += [f"light={az},{el}&ev=1" for az, el in BETWEEN]
    addresses += [COLOURED, ALONE, MAP, BOTH, SOFT, PRESET, MAP_WITH_AMBIENT, RIM, ORIGINAL_WITH_AMBIENT]
    addresses += [f"{ORIGINAL}{more}" for more in ("", "&background=none", "&env=sun")] + [DIMMED]
    found = drawn(shown().text, addresses, tmp_path_factory.mktemp("page"))
    return dict(zip(addresses, found, strict=True))


def assert_agrees(found: np.ndarray, relit: Any, ev: float) -> None:
    error = shown().errors(found, relit, ev)
    assert (shown().whole.matte > 0.5).mean() > 0.2
    assert error.mean() < MEAN and np.percentile(error, 99) <= PERCENTILE_99
    assert np.abs(shown().truth(relit, ev) - found[..., :3]).mean() < MEAN


def test_lights_of_the_rig_and_between_agree_at_given_and_automatic_exposure(
    images: dict[str, Drawn],
) -> None:
    for light in RIG:
        image = images[f"light={text_of(light)}"]
        relit = shown().relit(light[None], torch.ones(1, 3))
        ev = min(shown().whole.exposure_ev(relit, "auto"), most_exposure_ev("auto", 1.24))
        assert abs(image.ev - ev) < 0.03
        assert_agrees(image.pixels, relit, image.ev)
    assert image.ev == round(MOST_OVER_FRONT_EV - math.log2(1.24), 2)  # of the light behind and the fill
    errors = [
        shown().errors(
            images[f"light={az},{el}&ev=1"].pixels, shown().relit(towards((az, el)), torch.ones(1, 3)), 1.0
        )
        for az, el in BETWEEN
    ]
    together = np.concatenate(errors)
    assert together.mean() < MEAN_BETWEEN and np.percentile(together, 95) < PERCENTILE_95
    image, alone = images[COLOURED], images[ALONE]
    relit = shown().relit(PAIR, torch.tensor([[1, 0.5, 0.25], [1, 1, 1]]))
    assert_agrees(image.pixels, relit, -0.5)
    assert "--exposure -0.5" in image.command and "--view" not in image.command
    assert np.abs(alone.pixels[..., 3] - 255 * shown().whole.matte).max() < 1
    assert "--background none" in alone.command
    image = images[MAP]
    sun = next(one for one in page_maps() if one.name == "sun").pixels.astype(np.float32)
    rig = rig_directions()
    relit = shown().relit(rig, envmap_weights(torch.from_numpy(sun), rig, rotate_deg=50), ambient=0)
    assert_agrees(image.pixels, relit, image.ev)
    assert abs(image.ev - shown().whole.exposure_ev(relit, "auto")) < 0.03


@pytest.mark.parametrize("address", [BOTH, SOFT, PRESET, MAP_WITH_AMBIENT, RIM, ORIGINAL_WITH_AMBIENT])
def test_the_command_makes_the_same_image(
    address: str, images: dict[str, Drawn], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    *draw, line = images[address].command.splitlines()
    assert all(main(shlex.split(one)[1:]) == 0 for one in draw)
    words = shlex.split(line)
    options = ("--light", "--ambient", "--envmap", "--rotate")
    lights, ambients, maps, turns = (
        [words[i + 1] for i, word in enumerate(words) if word == name] for name in options
    )
    sources = LightSources(light=lights, envmap=maps, rotate=next(iter(turns), None))
    (setup,) = collect_setups(sources, tmp_path / "out")
    setup = with_ambient(set_ambient(setup, next(iter(ambients), None), False))
    relit = next(shown().whole.relit(lights_over_rig((setup,), "150", "cell")))
    pixels, ev = images[address].pixels, images[address].ev
    error = shown().errors(pixels, relit, ev)
    assert error.mean() < MEAN_BETWEEN and np.percentile(error, 95) < PERCENTILE_95
    if setup.has_original:
        assert ("--exposure" in line) == ("ev=" in address) and bool(ambients) == ("ambient=" in address)
    elif "ev=" not in address:
        (strength,) = lights_over_rig((setup,), "150", "cell").strengths()
        truth = min(shown().whole.exposure_ev(relit, "auto"), most_exposure_ev("auto", strength))
        assert abs(ev - truth) < 0.05


def test_the_photo_s_own_light_alone_gives_the_photo(images: dict[str, Drawn]) -> None:
    photo = 255 * linear_to_srgb(shown().whole.image(next(shown().whole.relit(ORIGINAL_LIGHT))))
    matte, kept = shown().whole.matte, photo_in(shown().text)
    assert np.abs(kept - photo).mean() < 1.5  # a JPEG of a grainy film
    for address in (ORIGINAL, DIMMED):
        pixels = images[address].pixels[..., :3]
        assert np.abs(pixels - kept)[matte > 0.01].max() <= 1
        assert np.abs(pixels - photo)[matte == 0].max() <= 1
    alone = images[f"{ORIGINAL}&background=none"].pixels
    assert np.abs(alone[..., 3] - 255 * matte).max() < 1
    assert np.abs(alone[..., :3] - kept)[matte == 1].max() <= 1
    assert "--light original -o out" in images[ORIGINAL].command
    under_both = images[f"{ORIGINAL}&env=sun"].command
    assert "--envmap envmap=maps/00000_sun.exr --light original -o out" in under_both
    assert "--light 'original;stops=-1' --exposure 1 " in images[DIMMED].command
    assert "--light 'name=rim;from=-150,15;rgb=2,2,2' --light original -o out" in images[RIM].command


def test_without_webgl_a_smaller_image_follows_the_same_formulas(tmp_path: Path) -> None:
    chromium()
    addresses = ["light=40,10&ev=0", "light=original;stops=1&light=40,10&ambient=0.06"]
    relit = shown().relit(towards((40, 10)), torch.ones(1, 3))
    for image, factor in zip(
        drawn(shown().text, addresses, tmp_path, "--disable-3d-apis"), (0.0, 2.0), strict=True
    ):
        size = image.pixels.shape[:2]
        assert size == (320, 320)
        lit = [replace(relit[0], original_rgb=torch.full((3,), factor))] if factor else relit
        error = np.abs(resized(shown().truth(lit, 0.0), *size) - image.pixels[..., :3])
        assert error[resized(shown().whole.matte, *size) > 0.99].mean() < MEAN_BETWEEN


_ACTIONS = """
    const command = () => byId("command").textContent;
    const marks = () => [...byId("marks").children];
    const act = async (id, apply) => (apply(byId(id)), await frames(3), command());
    const click = (id) => act(id, (one) => one.click());
    const input = (id, to) => act(id, (one) => Object.assign(one, to).dispatchEvent(new Event("input")));
    const type = (id, value) => input(id, { value });
    const send = (on, Kind, name, values) => on.dispatchEvent(new Kind(name, { bubbles: true, ...values }));
    const press = (key) => act("view", (one) => send(one, KeyboardEvent, "keydown", { key }));
    const middle = (one) => {
      const { left, top, width, height } = one.getBoundingClientRect();
      return [left + width / 2, top + height / 2];
    };
    // A drag of what is at a place of the picture, by so many pixels, or a click.
    const drag = (target, [x, y], by) => act("marks", (pad) => {
      pad.setPointerCapture = () => {};
      const at = (dx, dy) => ({ pointerId: 7, clientX: x + dx, clientY: y + dy });
      send(target, PointerEvent, "pointerdown", at(0, 0));
      if (by) send(pad, PointerEvent, "pointermove", at(...by));
      send(pad, PointerEvent, "pointerup", at(0, 0));
    });
"""
_FIRST_LOOK = (
    _ACTIONS
    + """
    const seen = { first: command(), message: byId("message").textContent };
    seen.titles = [document.title, document.querySelector("h1").textContent];
    for (let i = 0; i < 12; i++) seen.most = await click("add");
    const box = byId("view").getBoundingClientRect();
    seen.size = [box.width, box.height];
    seen.gap = document.querySelector("aside").getBoundingClientRect().left - box.right;
    await drag(byId("marks"), [box.right - 1, box.top + box.height / 2]);
    seen.dragged = [Number(byId("azimuth").value), Number(byId("elevation").value)];
    for (let i = 0; i < 10; i++) seen.dark = await click("remove");
    await click("compare");
    seen.before = [byId("before").hidden, byId("before").naturalWidth];
    await type("split", 25);
    seen.clip = byId("before").style.clipPath;
    return seen;
"""
)
_BY_HAND = (
    _ACTIONS
    + """
    const [seen, [mark]] = [{}, marks()];
    const box = byId("marks").getBoundingClientRect();
    const [headX, headY, headRadius] = JSON.parse(byId("data").textContent).head;
    const radius = headRadius * Math.min(box.width, box.height);
    const head = [box.left + box.width * headX, box.top + box.height * headY];
    seen.place = middle(mark).map((value, i) => (value - head[i]) / radius);
    seen.clicked = await drag(mark, middle(mark).map((value) => value + 4));
    seen.moved = await drag(mark, middle(mark).map((value) => value + 4), [-radius * 0.5, 0]);
    seen.kept = mark === marks()[0];
    seen.typed = await type("azimuthTyped", "-33.5");
    await type("kelvinTyped", "3200");
    await type("sizeTyped", "500");
    seen.soft = await type("stopsTyped", "-1.25");
    seen.idle = await type("elevationTyped", "");
    seen.named = await type("name", "key");
    seen.badName = [await type("name", "map"), byId("name").checkValidity()];
    seen.goodName = await act("name", (one) => one.blur()).then(() => byId("name").value);
    seen.arrow = await press("ArrowLeft");
    await press("a");
    await press("1");
    seen.focused = await act("marks", (pad) => pad.children[1].focus()).then(() => byId("name").placeholder);
    seen.digits = await press("1").then(() => byId("name").value);
    seen.mirrored = await press("m");
    seen.marks = marks().map((one) => [one.ariaLabel, one.ariaPressed]);
    seen.uniform = await input("uniform", { checked: true });
    seen.ambientIsIdle = byId("ambient").disabled;
    seen.preset = await type("presets", "split");
    seen.exposure = await type("exposureTyped", "0.5");
    seen.originalIsIdle = byId("originalStops").disabled;
    await click("auto");
    seen.original = await click("original");
    seen.dimmed = await type("originalStopsTyped", "-1.5");
    seen.lone = [await type("presets", "split"), byId("original").checked];
    await click("original");
    seen.reset = [await click("reset"), byId("message").textContent];
    const controls = [...document.querySelectorAll("button, input:not([type=file]), select")];
    const hasLabel = (one) => one.ariaLabel || one.labels?.length || one.textContent.trim();
    seen.unlabelled = controls.filter((one) => !hasLabel(one)).map((one) => one.id);
    return seen;
"""
)


def test_a_page_begins_with_a_light_and_takes_nine(tmp_path: Path) -> None:
    chromium()
    seen = driven(shown().text, _FIRST_LOOK, tmp_path)
    assert "--light 40,25 " in seen["first"] and seen["message"] == ""
    assert seen["titles"] == ["me.jpg · facerf", "me.jpg"]
    lights = seen["most"].split("'")[1].split(";")
    assert len(lights) == 9 == len(set(lights))  # none on another
    width, height = seen["size"]
    assert seen["gap"] >= 0 and abs(width - height) < 1  # square, and not over the panel
    azimuth, elevation = seen["dragged"]
    assert azimuth > 60 and abs(elevation) < 40  # the picture's right side
    assert seen["dark"].startswith("# add a light")
    assert seen["before"] == [False, 384]
    assert seen["clip"] == "inset(0px 75% 0px 0px)"


def test_lights_are_moved_by_hand_and_by_numbers(tmp_path: Path) -> None:
    chromium()
    seen = driven(shown().text, _BY_HAND, tmp_path)
    toward = azel_to_direction(40, 25).numpy()
    ring = math.degrees(math.acos(toward[2])) / 90  # radii of the head, of which 1 is beside it
    np.testing.assert_allclose(
        seen["place"], ring * toward[:2] * [1, -1] / np.linalg.norm(toward[:2]), atol=0.01
    )
    assert "--light 40,25 " in seen["clicked"]  # a click on a mark moves nothing
    place = ring * toward[:2] / np.linalg.norm(toward[:2]) - [0.5, 0]
    angle = math.radians(90 * float(np.linalg.norm(place)))
    aside, up = math.sin(angle) * place / np.linalg.norm(place)
    azimuth, elevation = math.degrees(math.atan2(aside, math.cos(angle))), math.degrees(math.asin(up))
    moved = [float(value) for value in seen["moved"].split("--light ")[1].split(" ")[0].split(",")]
    np.testing.assert_allclose(moved, [azimuth, elevation], atol=1)
    assert seen["kept"]  # what is dragged is not made again
    assert f"--light -33.5,{moved[1]:g} " in seen["typed"]
    soft = f"from=-33.5,{moved[1]:g};kelvin=3200;stops=-1.25;size_deg=120"
    assert f"--light '{soft}'" in seen["soft"] and seen["idle"] == seen["soft"]
    assert f"--light 'name=key;{soft}'" in seen["named"]
    assert seen["badName"] == [seen["named"], False] and seen["goodName"] == "key"
    assert f"from=-38.5,{moved[1]:g};" in seen["arrow"] and seen["digits"] == "key"
    assert seen["focused"] == "light2"
    assert f"from=38.5,{moved[1]:g};" in seen["mirrored"] and "light2=60,10" in seen["mirrored"]
    assert seen["marks"] == [
        [f"Light 1, key: azimuth 39, elevation {moved[1]:g} degrees", "true"],
        ["Light 2: azimuth 60, elevation 10 degrees", "false"],
    ]
    assert "name=key;from=uniform;kelvin=3200;stops=-1.25'" in seen["uniform"] and seen["ambientIsIdle"]
    assert "--light 'name=key;from=82.15,9.69;size_deg=11.54'" in seen["preset"]
    assert "--exposure 0.5 " in seen["exposure"]
    assert seen["originalIsIdle"] and seen["original"].endswith(" --light original -o out")
    assert seen["dimmed"].endswith(" --light 'original;stops=-1.5' -o out")
    assert "original" not in seen["lone"][0] and not seen["lone"][1]
    assert "--light 40,25 " in seen["reset"][0] and "original" not in seen["reset"][0]
    assert "--exposure 0.5" not in seen["reset"][0]
    assert seen["reset"][1] == "" and seen["unlabelled"] == []


def test_an_address_that_cannot_be_shown_says_so(tmp_path: Path) -> None:
    chromium()
    script = (
        _ACTIONS
        + """
    const seen = [];
    const [many, twice] = ["light=" + "1,1;".repeat(12), "light=original&light=from=original"];
    for (const address of ["light=foo", "light=at=0,0,1", "env=moon", many, twice, "light=key=40,20"]) {
      document.body.dataset.settled = "";
      location.hash = address;
      await settled();
      seen.push([byId("message").textContent, command()]);
    }
    return seen;
"""
    )
    found = driven(shown().text, script, tmp_path)
    wanted = [
        ("light foo: foo is no direction", "--light 40,25"),
        ("A near light is shown as a far one", "--light 0,0"),
        ("env=moon: give sun", "--light 40,25"),
        ("The first 9 of 12 lights", "--light '1,1;1,1;1,1;"),
        ("The original light occurs twice", "--light original -o"),
        ("", "--light key=40,20"),
    ]
    for (message, command), (said, line) in zip(found, wanted, strict=True):
        assert message.startswith(said) and bool(message) == bool(said) and line in command
