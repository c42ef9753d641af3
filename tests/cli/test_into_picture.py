"""`facerf relight` before another picture: --light-wrap."""

from pathlib import Path

import numpy as np
import pytest

from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.image.colour import SOFT_VIEW, encode_display, linear_to_srgb
from facerf_cli.image.strips import covering
from facerf_cli.main import main
from tests.astronaut import PATH as PHOTO
from tests.exr_layers import exr_layers

HALF = 2.0**-11


def relit(given: Path, output: Path, *line: object) -> Path:
    """The EXR of the astronaut, whose face's field gives what surrounds it, too."""
    fixed = ["--checkpoint", given / "lambert.safetensors", "--landmarks", given / "astronaut.json"]
    more = ["--lights", "12", "--reflectance", "field", "--exposure", "0"]
    assert main(["relight", *map(str, [PHOTO, "-o", output, *fixed, *more, *line])]) == 0
    (path,) = output.glob("*.exr")
    return path


@pytest.fixture
def hazy(tmp_path: Path) -> Path:
    """A picture of .1 to .7, brighter to the right; its middle, of .2 to .6, covers the frame."""
    ramp = np.linspace(0.1, 0.7, 90, dtype=np.float32)[None, :, None]
    write_display(tmp_path / "hazy.png", np.broadcast_to(ramp, (60, 90, 3)))
    return tmp_path / "hazy.png"


@pytest.mark.parametrize("lights", [["key=40,25", "rim=-150,15"], ["key=40,25", "original"]])
def test_the_wrap_is_a_layer_that_adds_up(given: Path, tmp_path: Path, hazy: Path, lights: list[str]) -> None:
    line = ["--background", hazy, *(part for light in lights for part in ("--light", light))]
    path = relit(given, tmp_path / "wrapped", *line, "--light-wrap", "0.5", "--ambient", "0.1")
    channels = exr_layers(path)
    names = {name.partition(".")[0] for name in channels} - {"R", "G", "B", "person"}
    assert names == {"wrap", "ambient", *(light.partition(";")[0].partition("=")[0] for light in lights)}
    layers = {name: np.stack([channels[f"{name}.{c}"] for c in "RGB"], -1) for name in names}
    matte = channels["person.A"]
    image, behind = read_image(path).pixels, covering(read_image(hazy).pixels, *matte.shape)
    added_up = (1 - matte[..., None]) * behind + sum(layers.values())
    np.testing.assert_allclose(image, added_up, atol=4 * HALF * image.max())
    assert layers["wrap"].max() > 0.1 and (layers["wrap"][matte == 0] == 0).all()
    if "original" in layers:  # the soft view bends what is added to the photo
        added = sum(layer for name, layer in layers.items() if name != "original")
        shown = linear_to_srgb(read_image(path.with_suffix(".png")).pixels)
        np.testing.assert_allclose(shown, encode_display(image, SOFT_VIEW, added=added), atol=1.5 / 255)
