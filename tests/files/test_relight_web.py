"""The web format of Relight is read back by a small decoder, written from the description of the format."""

import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from facerf_cli.files.relight_web import write_relight_web
from facerf_cli.light.sphere import rig_directions
from tests.kinds import Folders, Patch

HEIGHT, WIDTH = 48, 64


def front_lights() -> np.ndarray:
    rig = rig_directions(150).numpy()
    return rig[rig[:, 2] > 0.05]


def images(directions: np.ndarray) -> np.ndarray:
    """Display images [L, H, W, 3] in 0..255 of a coloured ball on black, by Lambert's law and a highlight."""
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5) / 32 - 1, 0.75 - (np.arange(HEIGHT) + 0.5) / 32)
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    normals = np.stack([x, y, z], -1) * (z > 0)[..., None]
    cosine = np.maximum(np.einsum("hwc,lc->lhw", normals, directions), 0)[..., None]
    colour = np.array([0.9, 0.6, 0.4]) * (0.6 + 0.4 * np.sin(9 * x))[..., None]
    half = directions + np.array([0, 0, 1])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shine = np.maximum(np.einsum("hwc,lc->lhw", normals, half), 0)[..., None] ** 20
    linear = 0.8 * colour * cosine + 0.15 * shine
    return np.round(255 * linear.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)


class Decoder:
    """A folder of the format: an image under any light from in front."""

    def __init__(self, folder: Path) -> None:
        self.info: dict[str, Any] = json.loads((folder / "info.json").read_text())
        assert (self.info["type"], self.info["colorspace"]) == ("rbf", "mrgb")
        count = self.info["nplanes"]
        files = [folder / f"plane_{k}.{self.info['format']}" for k in range(-(-count // 3))]
        planes = np.concatenate([np.asarray(Image.open(file)) for file in files], -1)[..., :count] / 255
        (material,) = self.info["materials"]
        self.weights = (planes - np.array(material["bias"])) * np.array(material["scale"])
        self.lights = np.array(self.info["lights"]).reshape(-1, 3)
        basis = np.array(self.info["basis"], float).reshape(count + 1, len(self.lights), 3)
        self.mean = basis[0] / 255
        self.components = (basis[1:] - 127) / np.array(material["range"])[:, None, None]

    def image(self, toward: np.ndarray) -> np.ndarray:
        near = np.exp(-((self.lights - toward) ** 2).sum(1) / self.info["sigma"] ** 2)
        near = near / near.sum() * (near / near.sum() > 0.001)
        near /= near.sum()
        mean, components = near @ self.mean, np.einsum("l,plc->pc", near, self.components)
        return np.asarray(255 * (mean + self.weights @ components).clip(0, 1))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: Folders) -> Path:
    """The ball, written in the format."""
    folder = tmp_path_factory.mktemp("ball") / "out"
    write_relight_web(folder, images(front_lights()), front_lights(), {"note": "ball"})
    return folder


def test_lights_of_the_rig_come_back_and_those_between_are_interpolated(folder: Path) -> None:
    directions = front_lights()
    truth, decoder = images(directions), Decoder(folder)
    assert decoder.info["note"] == "ball" and (decoder.info["width"], decoder.info["height"]) == (64, 48)
    assert sorted(path.name for path in folder.iterdir()) == [
        "info.json",
        *(f"plane_{k}.jpg" for k in range(6)),
    ]
    errors = [np.abs(decoder.image(light) - one) for light, one in zip(directions, truth, strict=True)]
    # A tenth of the weight is the neighbours', some 17 degrees away; the rest is 18 components and JPEG.
    assert np.mean(errors) < 5
    far = np.abs(truth.mean(0) - truth).mean()
    assert np.mean(errors) < far / 4  # the light is followed, not averaged
    toward = np.array([0.4, 0.3, np.sqrt(1 - 0.25)])
    error = np.abs(Decoder(folder).image(toward) - images(toward[None])[0])
    assert error.mean() < 7


def test_many_lights_take_no_more_memory_than_their_images(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("facerf_cli.files.relight_web._VALUES_AT_ONCE", 1 << 16)
    images = np.random.default_rng(0).integers(0, 255, (20, 160, 160, 3), np.uint8)
    tracemalloc.start()
    write_relight_web(tmp_path / "many", images, rig_directions(20).numpy())
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 2 * images.nbytes  # all values as floats would be four times as large
