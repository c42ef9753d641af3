"""`facerf relight --reflectance`: the baselines from the command line."""

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from facerf_cli.baselines import prt
from facerf_cli.baselines.prt import TransferSettings
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.read import read_image
from facerf_cli.main import main
from facerf_cli.network.checkpoint import save_networks
from facerf_cli.network.diffuse_sh import DiffuseNetwork
from facerf_cli.network.files import SHIPPED
from tests.cli.lines import PHOTO, face_sides, relight


@pytest.fixture(autouse=True)
def _quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A coarse bake, and a cache of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    small = TransferSettings(order=4, side=32, lights=60, light_samples=1, bounce_samples=2)
    monkeypatch.setattr(prt, "BAKE", small)


def attribute(path: Path, name: str) -> str:
    stream = oiio.ImageInput.open(str(path))
    value = stream.spec().get_string_attribute(name)
    stream.close()
    return str(value)


def relight_by_shipped(given: Path, output: Path, *line: str) -> int:
    fixed = ["--landmarks", str(given / "astronaut.json"), "--lights", "12"]
    return main(["relight", str(PHOTO), "-o", str(output), *fixed, *line])


@pytest.mark.parametrize("kind", ["diffuse-sh", "specular-sh", "prt"])
def test_a_face_is_lit_from_where_the_lamp_is(given: Path, tmp_path: Path, kind: str) -> None:
    line = ["--light", "70,0", "--light", "-70,0", "--composite", "face", "--reflectance", kind]
    assert relight_by_shipped(given, tmp_path / "out", *line) == 0
    first = tmp_path / "out/astronaut_light_70_0.exr"
    left, right = face_sides(first)
    assert right > 1.5 * left
    left, right = face_sides(tmp_path / "out/astronaut_light_-70_0.exr")
    assert left > 1.5 * right
    assert attribute(first, "facerf:reflectance") == kind
    assert np.isfinite(read_image(first).pixels).all()


def test_a_turned_head(given: Path, tmp_path: Path) -> None:
    line = ["--light", "20,30", "--pose", "30,0,0", "--reflectance", "prt"]
    assert relight_by_shipped(given, tmp_path / "out", *line) == 0
    assert read_image(tmp_path / "out/astronaut_light_20_30.exr").pixels.max() > 0.01


def test_a_network_of_the_stage_diffuse_sh_is_taken_where_its_model_is_asked_for(
    given: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.manual_seed(0)
    save_networks(
        tmp_path / "mine.safetensors", {"diffuse_sh": DiffuseNetwork()}, {"layout_version": LAYOUT_VERSION}
    )
    fixed = ["--landmarks", str(given / "astronaut.json"), "--light", "70,0", "--composite", "face"]

    def relight(name: str, checkpoint: Path, *more: str) -> int:
        line = ["relight", str(PHOTO), "-o", str(tmp_path / name), *fixed, *more]
        return main(["--checkpoint", str(checkpoint), *line])

    for name, checkpoint in (("mine", tmp_path / "mine.safetensors"), ("shipped", SHIPPED["diffuse_sh"])):
        assert relight(name, checkpoint, "--reflectance", "diffuse-sh") == 0
    mine, shipped = (tmp_path / name / "astronaut_light_70_0.exr" for name in ("mine", "shipped"))
    assert not np.allclose(read_image(mine).pixels, read_image(shipped).pixels, rtol=0.1)
    assert attribute(mine, "facerf:checkpoint") == "mine"
    capsys.readouterr()
    assert relight("field", tmp_path / "mine.safetensors") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "mine.safetensors: contains network of diffuse-sh" in line
    assert relight("other", SHIPPED["light_features"], "--reflectance", "diffuse-sh") == 2
    assert "contains network S_f" in capsys.readouterr().err


def test_the_portrait_is_the_default(given: Path, tmp_path: Path) -> None:
    line = ["--light", "20,30", "--background", "none", "--exposure", "0"]
    images = {}
    for name, chosen in (("portrait", []), ("field", ["--reflectance", "field"])):
        assert relight(given, tmp_path / name, *line, *chosen) == 0
        path = tmp_path / name / "astronaut_light_20_30.exr"
        images[name] = read_image(path).pixels
        assert attribute(path, "facerf:reflectance") == ("field" if name == "field" else "")
        assert json.loads(attribute(path, "facerf:options"))["reflectance"] == name
    assert np.abs(images["portrait"] - images["field"]).max() > 0.05
