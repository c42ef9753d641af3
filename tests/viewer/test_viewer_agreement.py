"""A page agrees with `facerf relight`: at lights from all sides. Skipped without Chromium."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch

from facerf_cli.cli.items.view_photos import page_maps, portrait_field_of
from facerf_cli.colour import MOST_OVER_FRONT_EV, SOFT_VIEW, encode_display, most_exposure_ev
from facerf_cli.composite import Composition, Relit
from facerf_cli.face.head import Head
from facerf_cli.files.images import read_image
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.models import load_models
from facerf_cli.pipeline import composition_of, find_for, head_of, relit_by
from facerf_cli.portrait_field import PortraitField
from facerf_cli.resize import shrunk_photo
from facerf_cli.viewer.packing import packed
from facerf_cli.viewer.page import page
from tests.viewer.browser import chromium, drawn

ASTRONAUT = Path(__file__).parents[2] / "examples" / "astronaut.jpg"
MEAN, PERCENTILE_99 = 2.0, 8.0  # of 255, which the issue of the viewer asks for


@dataclass(frozen=True, eq=False)
class Shown:
    head: Head
    field: PortraitField
    whole: Composition
    text: str

    def relit(self, directions: torch.Tensor, weights: torch.Tensor) -> Relit:
        return next(relit_by(self.whole, self.head, self.field, directions, weights[None]))

    def truth(self, relit: Relit, ev: float) -> np.ndarray:
        """The PNG of `facerf relight` [H, W, 3]."""
        exposed = self.whole.image(relit, ev).pixels * np.float32(2.0**ev)
        return np.round(255 * encode_display(exposed, SOFT_VIEW, self.whole.matte))


@cache
def shown() -> Shown:
    models = load_models(None, "builtin", torch.device("cpu"))
    photo = read_image(ASTRONAUT).pixels
    face = find_for(models.default_geometry, photo, "astronaut")[0]
    photo, head = shrunk_photo(photo, head_of(models, photo, face), 384)
    photo = np.clip(photo, 0, 1)
    field = portrait_field_of(models, head, photo)
    whole = composition_of(models, photo, head, field)
    sun = [one for one in page_maps() if one.name == "sun"]
    return Shown(
        head, field, whole, page("me", "me.jpg", packed(photo, head.fit.crop, field, whole, sun), "")
    )


def towards(*lights: tuple[float, float]) -> torch.Tensor:
    return torch.stack([azel_to_direction(*light) for light in lights]).float()


def assert_agrees(found: np.ndarray, relit: Relit, ev: float) -> None:
    error = np.abs(shown().truth(relit, ev) - found[..., :3])
    inside = shown().whole.matte > 0.5
    assert inside.mean() > 0.2
    assert error[inside].mean() < MEAN and np.percentile(error[inside], 99) < PERCENTILE_99
    assert error.mean() < MEAN


def test_lights_from_all_sides_agree_at_the_automatic_exposure(tmp_path: Path) -> None:
    chromium()
    lights = [(40, 25), (0, 80), (-140, 20), (180, 10)]
    images = drawn(shown().text, [f"light={az},{el}" for az, el in lights], tmp_path)
    for light, image in zip(lights, images, strict=True):
        relit = shown().relit(towards(light), torch.ones(1, 3))
        ev = min(shown().whole.exposure_ev(relit, "auto"), most_exposure_ev("auto", 1.0))
        assert abs(image.ev - ev) < 0.02  # two decimals of the same percentile
        assert_agrees(image.pixels, relit, ev)
    assert images[-1].ev == MOST_OVER_FRONT_EV


def test_coloured_lights_add_up_at_a_given_exposure_and_without_background(tmp_path: Path) -> None:
    chromium()
    address = "light=75,20,1,0.5,0.25;-150,10&ev=-0.5"
    image, alone = drawn(shown().text, [address, address + "&background=none"], tmp_path)
    relit = shown().relit(towards((75, 20), (-150, 10)), torch.tensor([[1, 0.5, 0.25], [1, 1, 1]]))
    assert_agrees(image.pixels, relit, -0.5)
    assert "--exposure -0.5" in image.command and "--view" not in image.command
    assert np.abs(alone.pixels[..., 3] - 255 * shown().whole.matte).max() < 1
    assert "--background none" in alone.command


def test_a_rotated_map_agrees(tmp_path: Path) -> None:
    chromium()
    (image,) = drawn(shown().text, ["env=sun&rotate=50"], tmp_path)
    sun = next(one for one in page_maps() if one.name == "sun").pixels.astype(np.float16)
    rig = rig_directions()
    weights = envmap_weights(torch.from_numpy(sun.astype(np.float32)), rig, rotate_deg=50)
    relit = shown().relit(rig, weights)
    assert_agrees(image.pixels, relit, shown().whole.exposure_ev(relit, "auto"))


def test_without_webgl_the_photo_is_relit_by_the_same_formulas(tmp_path: Path) -> None:
    chromium()
    (image,) = drawn(shown().text, ["light=40,10&ev=0"], tmp_path, "--disable-3d-apis")
    relit = shown().relit(towards((40, 10)), torch.ones(1, 3))
    assert image.pixels.shape[:2] == shown().whole.matte.shape  # 384 pixels need no shrinking
    assert_agrees(image.pixels, relit, 0.0)
