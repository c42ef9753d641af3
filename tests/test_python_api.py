"""The Python API: the page in the docs runs, and it gives what the command line gives."""

import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import facerf_cli as facerf
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.face.crop import from_landmarks
from facerf_cli.main import main
from facerf_cli.portrait.confidence import SCALES
from tests import astronaut
from tests.folders import only_row
from tests.refusals import refused

ROOT = Path(__file__).parents[1]
PHOTO = ROOT / "examples/astronaut.jpg"
KEY = facerf.Light.single(60, 30)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The names that the code of docs/python.md before Gradients leaves, with rigs of few lights."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "examples").symlink_to(ROOT / "examples")
    text = (ROOT / "docs/python.md").read_text().partition("\n## Gradients\n")[0]
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    assert len(blocks) >= 8
    names: dict[str, Any] = {"folder": folder}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        of_map, estimate = facerf.Light.from_envmap, facerf.Person.estimate_light
        few = lambda envmap, rotate_deg=0.0, lights=24, **more: of_map(envmap, rotate_deg, lights, **more)  # noqa: E731
        patch.setattr(facerf.Light, "from_envmap", staticmethod(few))
        patch.setattr(facerf.Person, "estimate_light", lambda person: estimate(person, lights=24))
        for block in blocks:
            exec(compile(block, "docs/python.md", "exec"), names)
    return names


@pytest.fixture(scope="module")
def person() -> facerf.Person:
    """The astronaut, with a small texture."""
    return facerf.fit(astronaut.models(), astronaut.photo(), reflectance="field", texture_side=64)


@pytest.mark.slow
def test_the_page_runs_and_its_shapes_are_true(page: dict[str, Any]) -> None:
    photo, size = page["photo"], page["photo"].shape[:2]
    for name in (
        "image",
        "together",
        "both",
        "key_alone",
        "in_the_sun",
        "before_map",
        "before_grey",
        "weighed",
    ):
        assert page[name].shape == photo.shape and np.isfinite(page[name]).all(), name
    assert page["images"].shape == (12, *photo.shape) and page["textures"].shape == (12, 256, 256, 3)
    assert page["cut_out"].shape == page["turned"].shape == page["face"].shape == (*size, 4)
    assert set(page["layers"]) == {"image", "person.A", "albedo", "specular", "shadow"}
    assert page["estimated_map"].shape == (128, 256, 3)
    assert sorted(path.name for path in page["folder"].glob("relit.*")) == ["relit.exr", "relit.png"]
    one = page["person"]
    assert one.albedo.shape == one.normals.shape == photo.shape
    assert one.depth.shape == one.matte.shape == page["hair"].shape == size and 0.1 < one.matte.mean() < 0.9
    np.testing.assert_allclose(sum(one.classes.values()), one.matte, atol=1e-5)
    assert one.texture.shape == (256, 256, 3) and one.uv.shape == (len(one.mesh.vertices), 2)
    inside = one.matte > 0.99
    np.testing.assert_allclose(np.linalg.norm(one.normals[inside], axis=-1), 1, atol=1e-3)
    assert one.depth[inside].min() > 0.3 and one.depth[inside].max() < 2


@pytest.mark.slow
def test_it_gives_what_the_command_line_gives(page: dict[str, Any], tmp_path: Path) -> None:
    line = ["relight", str(PHOTO), "--light", "60,30", "--ambient", "0.06", "--exposure", "0"]
    assert main([*line, "-o", str(tmp_path)]) == 0
    written = facerf.read_image(tmp_path / "astronaut_light_60_30.exr")
    relit = page["person"].relight(KEY, ambient=0.06)
    np.testing.assert_array_equal(written, relit.astype(np.float16).astype(np.float32))
    row = only_row(tmp_path)
    assert set(row["factors"]) == set(SCALES) - {"masked"}  # which judges a given matte
    assert row["certainty"] == "sure"


def test_a_group_is_of_one_photo(person: facerf.Person) -> None:
    other = replace(person, photo=person.photo[:, ::-1])
    for people, said in (([], "pass at least one"), ([person, other], "different photos")):
        refused(ValueError, said, facerf.Group, people)
    assert "box_px" in repr(astronaut.face()) and len(repr(astronaut.face())) < 200


@pytest.mark.slow
def test_lights_add_up_and_a_white_map_of_one_gives_the_face_its_brightness(page: dict[str, Any]) -> None:
    one, rim = page["person"], facerf.Light.single(-70, 0, (1, 0.1, 0.1))
    first, second, both = one.relight([KEY, rim, sum([KEY, 2 * rim])], background="none")
    scale = both[..., :3].mean()
    apart = first[..., :3] + 2 * second[..., :3]
    np.testing.assert_allclose(apart, both[..., :3], atol=1e-3 * scale, rtol=1e-3)
    np.testing.assert_allclose(one.relight(KEY, background="none"), first, atol=1e-5 * scale, rtol=1e-4)
    of_rig = facerf.Light(page["rig"], np.random.default_rng(1).random((12, 3), np.float32))
    weighed = (page["images"] * of_rig.weights[:, None, None]).sum(0)
    cut = one.relight(of_rig, background="none")
    np.testing.assert_allclose(weighed, cut[..., :3] * cut[..., 3:], atol=1e-3 * scale, rtol=1e-3)
    # Output is absolute in the light and relative to the photo's exposure (docs/design.md).
    head = page["person"].head
    white = facerf.Light.from_envmap(np.ones((32, 64, 3), np.float32), lights=60)
    own = head.face.texture.numpy()[:, head.face.visible.numpy() > 0.9].mean()
    alone, brighter = page["person"].relight([white, 3 * white], alone=True)
    of_face = alone[alone[..., 3] > 0.9][:, :3].mean()
    assert abs(of_face / own - 1) < 0.1
    np.testing.assert_allclose(brighter[..., :3], 3 * alone[..., :3], rtol=1e-3, atol=1e-4)
    one, pixels = page["person"], np.pad(page["pixels"], ((0, 0), (0, 1)))
    shown = one.models.face.landmarks(torch.from_numpy(pixels[None]).float())[0, :, :2].numpy()
    inner = slice(17, 68)  # the contour's landmarks slide
    size_px = from_landmarks(one.landmarks, 1).side_px
    assert np.linalg.norm(shown[inner] - one.landmarks[inner], axis=1).mean() < 0.02 * size_px


def test_a_given_matte_says_who_is_relit() -> None:
    photo = astronaut.photo()
    matte = np.zeros(photo.shape[:2], np.float32)
    matte[:300, 130:330] = 1
    one = facerf.fit(astronaut.models(), photo, matte=matte, reflectance="field", texture_side=64)
    relit = one.relight(KEY)
    np.testing.assert_array_equal(relit[300:], photo[300:])
    assert abs(relit - photo)[:300].mean() > 0.01


def test_what_cannot_be_used_is_said(person: facerf.Person) -> None:
    models, photo = astronaut.models(), astronaut.photo()
    refused(InputError, "photo: no face found", facerf.fit, models, np.full((200, 300, 3), 0.3, np.float32))
    refused(ValueError, "photo has shape ... 200, 300", facerf.fit, models, np.zeros((200, 300), np.float32))
    refused(ValueError, "uint8", facerf.fit, models, np.zeros((200, 300, 3), np.uint8))
    refused(ValueError, "not finite", facerf.fit, models, np.full((200, 300, 3), np.nan, np.float32))
    refused(TypeError, "read a file with read_image", facerf.fit, models, str(PHOTO))
    refused(InputError, "twice as wide as high", person.relight, np.ones((30, 40, 3), np.float32))
    refused(ValueError, "ambient is 'none', not a fraction from 0 to 1", person.relight, KEY, ambient="none")
    refused(ValueError, "pose is", person.relight, KEY, pose=(math.nan, 0, 0))
    with pytest.raises(ValueError, match=r"not a list of some of normal, position, depth, uv, face$"):
        person.relight(KEY, layers=["albedo"])
    refused(ValueError, "texture_side is 7, not 16 to", facerf.fit, models, photo, texture_side=7)
    refused(ValueError, "pixels have shape ... 4, 4", facerf.write_image, "x.png", np.ones((4, 4)))
    refused(TypeError, "photo is list, not an array", facerf.fit, models, [photo, photo])
    refused(TypeError, "light has shape ... not a facerf.Light", person.relight, np.array([60.0, 30.0, 1.0]))
    refused(TypeError, "light is tuple, not a facerf", person.relight, [(60, 30)])
    refused(ValueError, "background has shape ... 4, 4", person.relight, KEY, background=np.ones((4, 4)))
    refused(ValueError, "not one of photo, none", person.relight, KEY, background="nonne")
    refused(ValueError, "not a list of some of normal", person.relight, KEY, layers=["depht"])
    refused(ValueError, "not one of portrait, field", facerf.fit, models, photo, reflectance="foo")
    refused(ValueError, "matte has shape", facerf.fit, models, photo, matte=np.ones((3, 3)))
    refused(UsageError, "albedo: ... fit with reflectance='portrait'", lambda: person.albedo)
    refused(UsageError, "device abacus: ... use cpu", facerf.load_models, device="abacus")
    refused(ValueError, "length 1", person.olat, np.ones((2, 3)))


@pytest.mark.parametrize(
    ("light", "said"),
    [
        (facerf.Light(np.ones((2, 3)), np.ones((2, 3))), "length 1"),
        (facerf.Light(np.eye(3), np.full((3, 3), np.nan)), "not all finite"),
        (facerf.Light(np.eye(3), np.ones((2, 3, 3))), "not [L, 3]"),
    ],
)
def test_lights_that_are_none(person: facerf.Person, light: facerf.Light, said: str) -> None:
    refused(ValueError, said, person.relight, light)
    refused(ValueError, said, light.to_envmap, 16)


@pytest.mark.parametrize(
    "shapes", [([12, 3], [12]), ([12, 3], [12, 1]), ([3, 3], [2, 3]), ([3], [3]), ([2, 2], [2, 2])]
)
def test_a_light_of_other_shapes_says_those_that_it_takes(shapes: tuple[list[int], list[int]]) -> None:
    said = "shapes {} and {}; use [L, 3] and [L, 3]".format(*shapes)
    with pytest.raises(ValueError, match=re.escape(said)):
        facerf.Light(*map(np.ones, shapes))


@pytest.mark.parametrize("wrong", [(math.nan, 0), (0, 300), (0, 0, (1, -1, 1))])
def test_a_single_light_that_is_none(wrong: Any) -> None:
    refused(ValueError, "invalid light", facerf.Light.single, *wrong)


def test_choices_that_do_not_go_together() -> None:
    for choice in (
        {"network_alone": True, "reflectance": "prt"},
        {"geometry": "network", "landmarks_px": np.zeros((68, 2))},
    ):
        refused(FacerfError, "remove", facerf.fit, astronaut.models(), astronaut.photo(), **choice)


def test_importing_it_loads_nothing_heavy() -> None:
    code = "import sys, facerf_cli; print('torch' in sys.modules, 'numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.split() == ["False", "False"], done.stderr
