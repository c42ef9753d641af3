"""Blender's world is turned as facerf's map, and its image has no layers."""

import importlib.util
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import OpenImageIO as oiio
import pytest

from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.light.sphere import azel_to_direction, direction_to_uv

ROOT = Path(__file__).parents[2]


def module_of(path: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (90, 0), (-37, 20), (170, -60)])
@pytest.mark.parametrize("rotate", [0.0, 55.0])
def test_blender_looks_where_facerf_looks(azimuth: float, elevation: float, rotate: float) -> None:
    x, y, z = azel_to_direction(azimuth, elevation).tolist()
    turn = math.radians(module_of("examples/blender/facerf_scene.py").world_turn_deg(rotate))
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
    scene = module_of("examples/blender/facerf_scene.py")
    random = np.random.default_rng(1)
    image, matte = random.random((8, 6, 3)).astype(np.float32), np.ones((8, 6), np.float32)
    write_exr(tmp_path / "me.exr", image, matte, {"albedo": image, "person.A": matte})
    alone = scene.image_alone(tmp_path / "me.exr")
    assert alone.name == "me_rgba.exr" and oiio.ImageBuf(str(alone)).nsubimages == 1
    np.testing.assert_allclose(read_image(alone).pixels, image, atol=1e-3)
    assert scene.image_alone(alone) == alone


def test_a_scene_is_built_where_blender_is_installed(tmp_path: Path) -> None:
    bpy = pytest.importorskip("bpy", reason="Blender's bpy is not installed")
    scene = module_of("examples/blender/facerf_scene.py")
    image, matte = np.ones((8, 6, 3), np.float32), np.ones((8, 6), np.float32)
    write_exr(tmp_path / "me.exr", image, matte, {"albedo": image})
    scene.add_world(bpy, ROOT / "examples/maps/studio.exr", 30.0)
    portrait = scene.add_portrait(bpy, tmp_path / "me.exr", 0.5)
    bpy.context.view_layer.update()
    assert tuple(portrait.dimensions[:2]) == pytest.approx((0.375, 0.5))
