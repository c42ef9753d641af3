"""The ComfyUI nodes by their interface, without ComfyUI: names, sockets, and one relit image."""

import importlib.util
import inspect
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from facerf_cli.files.read import read_image
from facerf_cli.light.sphere import azel_to_direction

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def package() -> ModuleType:
    """The package as ComfyUI loads it: by its path, under any name."""
    folder = ROOT / "examples/comfyui"
    spec = importlib.util.spec_from_file_location(
        "custom_facerf", folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["custom_facerf"] = module
    spec.loader.exec_module(module)
    return module


def test_every_node_has_what_comfyui_asks_for(package: ModuleType) -> None:
    assert set(package.NODE_CLASS_MAPPINGS) == set(package.NODE_DISPLAY_NAME_MAPPINGS)
    for node in package.NODE_CLASS_MAPPINGS.values():
        sockets: dict[str, Any] = node.INPUT_TYPES()
        wanted = inspect.signature(getattr(node, node.FUNCTION)).parameters
        assert list(wanted)[1:] == [*sockets["required"], *sockets.get("optional", {})]
        assert node.CATEGORY == "facerf" and isinstance(node.RETURN_TYPES, tuple)
        for name in sockets.get("optional", {}):
            assert wanted[name].default is None
        for kind, *options in sockets["required"].values():
            assert not options or options[0]["default"] is not None, kind


def test_lights_add_and_maps_are_read(package: ModuleType) -> None:
    nodes = package.NODE_CLASS_MAPPINGS
    (one,) = nodes["FacerfLight"]().make(40.0, 25.0, 1.0, 0.5, 0.25)
    (two,) = nodes["FacerfLight"]().make(-90.0, 0.0, 1.0, 1.0, 1.0, one)
    np.testing.assert_allclose(one.directions, azel_to_direction(40, 25)[None], atol=1e-6)
    assert two.weights.shape == (2, 3)
    (sky,) = nodes["FacerfEnvironment"]().read(str(ROOT / "examples/maps/studio.exr"), 30.0)
    assert sky.weights.shape == (150, 3) and sky.weights.max() > 0


def test_an_image_is_relit_with_its_matte(package: ModuleType) -> None:
    nodes = package.NODE_CLASS_MAPPINGS
    pixels = read_image(ROOT / "examples/astronaut.jpg").pixels[::2, ::2]
    photo = torch.from_numpy(pixels.clip(0, 1) ** (1 / 2.2))[None]
    (light,) = nodes["FacerfLight"]().make(-60.0, 10.0, 1.0, 1.0, 1.0)
    relit, matte = nodes["FacerfRelight"]().relight(photo, light, 0.5)
    assert relit.shape == photo.shape and matte.shape == photo.shape[:3]
    assert 0.2 < matte.mean() < 0.8 and relit.min() >= 0 and relit.max() <= 1
    face = relit[0, 35:85, 88:138].mean((0, 2))  # of the astronaut, whose middle is at 113
    assert face[:20].mean() > 1.5 * face[-20:].mean()
