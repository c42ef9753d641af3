"""A page agrees with `facerf relight` at lights from all sides; its controls. Skipped without Chromium."""

import math
import shlex
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.face.head import shrunk_photo
from facerf_cli.files.images import read_image
from facerf_cli.image.colour import MOST_OVER_FRONT_EV, SOFT_VIEW, encode_display, most_exposure_ev
from facerf_cli.image.strips import resized
from facerf_cli.light.entries import StudioLight
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sphere import azel_to_direction, direction_to_azel, rig_directions
from facerf_cli.light.studio_points import Lights, far_samples
from facerf_cli.main import main
from facerf_cli.pipeline import FittedPerson, find_for, head_of, reflectance_of
from facerf_cli.relighting.composition import Composition, Relit
from facerf_cli.relighting.models import load_models
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.viewer.page import packed, page
from facerf_cli.work.light_setups import LightSources, collect_setups, in_room
from facerf_cli.work.lights import lights_over_rig, with_room
from facerf_cli.work.view_photos import head_place, of_photo, page_maps
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
    whole: Composition
    text: str

    def relit(self, directions: torch.Tensor, weights: torch.Tensor, room: float = 0.06) -> Relit:
        """Under lights and what a room sends of them."""
        around, shares = far_samples(StudioLight())
        sent = room * shares[:, None] * weights.sum(0)
        lights = Lights(torch.cat([directions, around]), torch.cat([weights, sent])[None])
        return next(self.whole.relit(lights))

    def truth(self, relit: Relit, ev: float) -> np.ndarray:
        """The PNG of `facerf relight` [H, W, 3]."""
        exposed = self.whole.image(relit, ev).pixels * np.float32(2.0**ev)
        return np.round(255 * encode_display(exposed, SOFT_VIEW, self.whole.matte))

    def errors(self, found: np.ndarray, relit: Relit, ev: float) -> np.ndarray:
        """Of all values of the person."""
        return np.asarray(np.abs(self.truth(relit, ev) - found[..., :3])[self.whole.matte > 0.5])


@cache
def shown() -> Shown:
    models = load_models()
    photo = read_image(ASTRONAUT).pixels
    face = find_for(models.networks.people, models.default_geometry, photo, "astronaut")[0]
    photo, head = shrunk_photo(photo, head_of(models, photo, face, models.sides(128)), 384)
    photo = np.clip(photo, 0, 1)
    basis, plate = of_photo(models, photo, head)
    field = reflectance_of(models, head, "portrait", photo=photo)
    assert isinstance(field, PortraitField)
    sun = [one for one in page_maps() if one.name == "sun"]
    document = packed(basis, plate, head_place(head.fit.crop, plate.matte), sun)
    whole = FittedPerson(models, photo, head, field).composed()
    return Shown(whole, page("me", ["me.jpg"], document, ""))


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
PAIR = on_rig((75, 20), (-150, 10))
COLOURED = f"light={text_of(PAIR[0])},1,0.5,0.25;{text_of(PAIR[1])}&ev=-0.5"
ALONE, MAP = COLOURED + "&background=none", "env=sun&rotate=50"
BOTH = f"{MAP}&mapstops=-2&room=0.2&{COLOURED}"


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Drawn]:
    """What the page draws at each address."""
    chromium()
    addresses = [f"light={text_of(light)}" for light in RIG]
    addresses += [f"light={az},{el}&ev=1" for az, el in BETWEEN]
    addresses += [COLOURED, ALONE, MAP, BOTH]
    found = drawn(shown().text, addresses, tmp_path_factory.mktemp("page"))
    return dict(zip(addresses, found, strict=True))


def assert_agrees(found: np.ndarray, relit: Relit, ev: float) -> None:
    error = shown().errors(found, relit, ev)
    assert (shown().whole.matte > 0.5).mean() > 0.2
    assert error.mean() < MEAN and np.percentile(error, 99) <= PERCENTILE_99
    assert np.abs(shown().truth(relit, ev) - found[..., :3]).mean() < MEAN


def test_lights_of_the_rig_agree_at_the_automatic_exposure(images: dict[str, Drawn]) -> None:
    for light in RIG:
        image = images[f"light={text_of(light)}"]
        relit = shown().relit(light[None], torch.ones(1, 3))
        ev = min(shown().whole.exposure_ev(relit, "auto"), most_exposure_ev("auto", 1.24))
        assert abs(image.ev - ev) < 0.03
        assert_agrees(image.pixels, relit, image.ev)
    assert image.ev == round(MOST_OVER_FRONT_EV - math.log2(1.24), 2)  # of the light from behind, and a room


def test_lights_between_those_of_the_rig_agree(images: dict[str, Drawn]) -> None:
    errors = [
        shown().errors(
            images[f"light={az},{el}&ev=1"].pixels,
            shown().relit(towards((az, el)), torch.ones(1, 3)),
            1.0,
        )
        for az, el in BETWEEN
    ]
    together = np.concatenate(errors)
    assert together.mean() < MEAN_BETWEEN and np.percentile(together, 95) < PERCENTILE_95


def test_coloured_lights_add_up_at_a_given_exposure_and_without_background(images: dict[str, Drawn]) -> None:
    image, alone = images[COLOURED], images[ALONE]
    relit = shown().relit(PAIR, torch.tensor([[1, 0.5, 0.25], [1, 1, 1]]))
    assert_agrees(image.pixels, relit, -0.5)
    assert "--exposure -0.5" in image.command and "--view" not in image.command
    assert np.abs(alone.pixels[..., 3] - 255 * shown().whole.matte).max() < 1
    assert "--background none" in alone.command


def test_a_rotated_map_agrees(images: dict[str, Drawn]) -> None:
    image = images[MAP]
    sun = next(one for one in page_maps() if one.name == "sun").pixels.astype(np.float32)
    rig = rig_directions()
    relit = shown().relit(rig, envmap_weights(torch.from_numpy(sun), rig, rotate_deg=50), room=0)
    assert_agrees(image.pixels, relit, image.ev)
    assert abs(image.ev - shown().whole.exposure_ev(relit, "auto")) < 0.03


def test_the_command_of_a_map_with_lights_in_a_room_makes_the_same_image(
    images: dict[str, Drawn], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    draw, line = images[BOTH].command.splitlines()
    assert main(shlex.split(draw)[1:]) == 0
    words = shlex.split(line)
    lights, (room,) = (
        [words[i + 1] for i, word in enumerate(words) if word == name] for name in ("--light", "--room")
    )
    (setup,) = collect_setups(LightSources(light=lights), tmp_path / "out")
    rig = lights_over_rig((with_room(in_room(setup, room, False)),), "150", "cell")
    assert_agrees(images[BOTH].pixels, next(shown().whole.relit(rig)), images[BOTH].ev)


def test_without_webgl_a_smaller_image_follows_the_same_formulas(tmp_path: Path) -> None:
    chromium()
    (image,) = drawn(shown().text, ["light=40,10&ev=0"], tmp_path, "--disable-3d-apis")
    size = image.pixels.shape[:2]
    assert size == (320, 320)
    relit = shown().relit(towards((40, 10)), torch.ones(1, 3))
    error = np.abs(resized(shown().truth(relit, 0.0), *size) - image.pixels[..., :3])
    assert error[resized(shown().whole.matte, *size) > 0.99].mean() < MEAN_BETWEEN


_FIRST_LOOK = """
    const command = () => byId("command").textContent;
    const seen = { first: command(), message: byId("message").textContent };
    for (let i = 0; i < 12; i++) {
      byId("add").click();
      await frames(3);
    }
    seen.most = command();
    const box = byId("view").getBoundingClientRect();
    seen.size = [box.width, box.height];
    seen.room = document.querySelector("aside").getBoundingClientRect().left - box.right;
    const press = { bubbles: true, pointerId: 1, clientX: box.right - 1, clientY: box.top + box.height / 2 };
    byId("view").setPointerCapture = () => {};
    byId("view").dispatchEvent(new PointerEvent("pointerdown", press));
    await frames(3);
    seen.dragged = [Number(byId("azimuth").value), Number(byId("elevation").value)];
    for (let i = 0; i < 10; i++) {
      byId("remove").click();
      await frames(3);
    }
    seen.dark = command();
    byId("compare").click();
    await frames(3);
    seen.before = [byId("before").hidden, byId("before").naturalWidth];
    return seen;
"""


def test_a_page_begins_with_a_light_and_takes_nine(tmp_path: Path) -> None:
    chromium()
    seen = driven(shown().text, _FIRST_LOOK, tmp_path)
    assert "--light '40,25'" in seen["first"] and seen["message"] == ""
    lights = seen["most"].split("'")[1].split(";")
    assert len(lights) == 9 == len(set(lights))  # none on another
    width, height = seen["size"]
    assert seen["room"] >= 0 and abs(width - height) < 1  # square, and not over the panel
    azimuth, elevation = seen["dragged"]
    assert azimuth > 60 and abs(elevation) < 40  # the picture's right side
    assert seen["dark"].startswith("# add a light")
    assert seen["before"] == [False, 384]
