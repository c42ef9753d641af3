"""The Nuke group of a stack names its layers; Blender's world is turned as facerf's map."""

import importlib.util
import math
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from facerf_cli.files.olat_stack import write_olat_stack
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.light.sphere import azel_to_direction, direction_to_uv, rig_directions
from tests.stacks import header_of

ROOT = Path(__file__).parents[2]


def module_of(path: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def stack(path: Path, lights: int = 4) -> None:
    """A stack of flat images."""
    header = header_of(rig_directions(lights), np.zeros((6, 8), np.float32))
    write_olat_stack(path, header, iter([torch.rand(lights, 3, 6, 8)]))


def nodes_of(text: str) -> list[str]:
    """The classes of a Nuke script's nodes."""
    return re.findall(r"^ (\w+) \{$", text, re.M)


def test_a_group_weighs_every_light_of_a_stack(tmp_path: Path) -> None:
    stack(tmp_path / "me_olat.exr")
    script = ROOT / "integrations/nuke/make_gizmo.py"
    command = [sys.executable, str(script), str(tmp_path / "me_olat.exr"), str(tmp_path / "me.nk")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "4 layers" in done.stdout
    text = (tmp_path / "me.nk").read_text()
    assert text.count("{") == text.count("}")
    nodes = nodes_of(text)
    assert nodes.count("Shuffle") == nodes.count("Multiply") == 4 and nodes.count("Merge2") == 3
    assert text.count("push $stack") == 3  # the first takes the input itself
    for number in range(4):
        layer = f"light{number:03d}"
        assert f"in {layer}\n" in text and f"{{18 {layer} R 0 4}}" in text
        assert f"{{parent.{layer}.r}} {{parent.{layer}.g}} {{parent.{layer}.b}}" in text
    subprocess.run([*command, "--every", "2"], check=True, capture_output=True)
    assert nodes_of((tmp_path / "me.nk").read_text()).count("Shuffle") == 2


@pytest.mark.parametrize("alpha", [None, np.ones((4, 5), np.float32)])
def test_named_lights_of_one_image_are_layers_too(tmp_path: Path, alpha: np.ndarray | None) -> None:
    image = np.ones((4, 5, 3), np.float32)
    layers = {"key": image, "fill": image, "albedo": image, "person.A": image[..., 0]}
    write_exr(tmp_path / "me.exr", image, alpha, layers)
    assert module_of("integrations/nuke/make_gizmo.py").layers_of(tmp_path / "me.exr") == ["key", "fill"]


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (90, 0), (-37, 20), (170, -60)])
@pytest.mark.parametrize("rotate", [0.0, 55.0])
def test_blender_looks_where_facerf_looks(azimuth: float, elevation: float, rotate: float) -> None:
    x, y, z = azel_to_direction(azimuth, elevation).tolist()
    turn = math.radians(module_of("integrations/blender/facerf_scene.py").world_turn_deg(rotate))
    right, away = x, -z  # Blender's x and y; up is its z
    east = math.cos(turn) * right - math.sin(turn) * away
    north = math.sin(turn) * right + math.cos(turn) * away
    u = (0.5 - math.atan2(north, east) / (2 * math.pi)) % 1  # Blender's equirectangular mapping
    v = 0.5 - math.asin(y) / math.pi  # from above
    wanted = direction_to_uv(azel_to_direction(azimuth, elevation)[None].double())[0]
    assert abs((u - float(wanted[0]) - rotate / 360 + 0.5) % 1 - 0.5) < 1e-6
    assert abs(v - float(wanted[1])) < 1e-6


def test_blender_is_given_the_image_without_its_layers(tmp_path: Path) -> None:
    """Of an EXR with several parts Blender has an image of 0 x 0 pixels, which shows nothing."""
    scene = module_of("integrations/blender/facerf_scene.py")
    random = np.random.default_rng(1)
    image, matte = random.random((8, 6, 3)).astype(np.float32), np.ones((8, 6), np.float32)
    write_exr(tmp_path / "me.exr", image, matte, {"albedo": image, "person.A": matte})
    alone = scene.image_alone(tmp_path / "me.exr")
    assert alone.name == "me_rgba.exr" and oiio.ImageBuf(str(alone)).nsubimages == 1
    np.testing.assert_allclose(read_image(alone).pixels, image, atol=1e-3)
    assert scene.image_alone(alone) == alone


def test_a_scene_is_built_where_blender_is_installed(tmp_path: Path) -> None:
    bpy = pytest.importorskip("bpy", reason="Blender's bpy is not installed")
    scene = module_of("integrations/blender/facerf_scene.py")
    image, matte = np.ones((8, 6, 3), np.float32), np.ones((8, 6), np.float32)
    write_exr(tmp_path / "me.exr", image, matte, {"albedo": image})
    scene.add_world(bpy, ROOT / "examples/maps/studio.exr", 30.0)
    portrait = scene.add_portrait(bpy, tmp_path / "me.exr", 0.5)
    bpy.context.view_layer.update()
    assert tuple(portrait.dimensions[:2]) == pytest.approx((0.375, 0.5))
