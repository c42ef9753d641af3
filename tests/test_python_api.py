"""The Python API: the page in the docs runs, and it gives what the command line gives."""

import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import facerf_cli as facerf
from facerf_cli.errors import InputError
from facerf_cli.main import main
from facerf_cli.portrait.confidence import SCALES

ROOT = Path(__file__).parents[1]
PHOTO = ROOT / "examples/astronaut.jpg"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The names that the code of docs/python.md leaves, run from top to bottom, with rigs of few lights."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "examples").symlink_to(ROOT / "examples")
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/python.md").read_text(), re.S)
    assert len(blocks) >= 6
    names: dict[str, Any] = {"folder": folder}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        of_map, estimate = facerf.Light.from_envmap, facerf.estimate_light
        few = lambda envmap, rotate_deg=0.0, lights=24: of_map(envmap, rotate_deg, lights)  # noqa: E731
        patch.setattr(facerf.Light, "from_envmap", staticmethod(few))
        patch.setattr(facerf, "estimate_light", lambda models, head: estimate(models, head, lights=24))
        for block in blocks:
            exec(compile(block, "docs/python.md", "exec"), names)
    return names


def test_the_page_runs_and_its_shapes_are_true(page: dict[str, Any]) -> None:
    photo = page["photo"]
    assert page["image"].shape == photo.shape and np.isfinite(page["image"]).all()
    assert page["envmap"].shape == (256, 512, 3)
    assert page["olats"].shape == (24, 256, 256, 3) and page["directions"].shape == (24, 3)
    assert page["matte"].shape == page["hair"].shape == photo.shape[:2] and 0.1 < page["matte"].mean() < 0.9
    assert page["turned"].shape == page["alone"].shape == (*photo.shape[:2], 4)
    assert sorted(path.name for path in page["folder"].glob("relit.*")) == ["relit.exr", "relit.png"]


def test_it_gives_what_the_command_line_gives(page: dict[str, Any], tmp_path: Path) -> None:
    line = ["relight", str(PHOTO), "--light", "60,30", "--room", "none", "--exposure", "0"]
    assert main([*line, "-o", str(tmp_path)]) == 0
    written = facerf.read_image(tmp_path / "astronaut_light_60_30.exr")
    np.testing.assert_array_equal(written, page["image"].astype(np.float16).astype(np.float32))
    row = json.loads((tmp_path / "report.jsonl").read_text())
    assert set(row["factors"]) == set(SCALES)  # of the face, its fit and the matte
    assert row["certainty"] == "sure" and set(row["touches_frame"]) == {"bottom"}


def test_sums_of_lights(page: dict[str, Any]) -> None:
    first, second = facerf.Light.single(60, 30), facerf.Light.single(-70, 0, (1, 0.1, 0.1))
    models, photo, head = page["models"], page["photo"], page["head"]
    apart = sum(facerf.relight(models, photo, head, light, background="none") for light in (first, second))
    both = facerf.relight(models, photo, head, page["two"], background="none")
    np.testing.assert_allclose(apart[..., :3], both[..., :3], atol=1e-3 * both[..., :3].mean(), rtol=1e-3)


def test_a_white_map_of_one_gives_the_face_as_bright_as_its_photo(page: dict[str, Any]) -> None:
    """Output is absolute in the light and relative to the photo's exposure (docs/design.md)."""
    models, photo, head = page["models"], page["photo"], page["head"]
    white = facerf.Light.from_envmap(np.ones((32, 64, 3), np.float32), lights=60)
    seen = head.face.visible.numpy() > 0.9
    own = head.face.texture.numpy()[:, seen].mean()
    alone = facerf.relight(models, photo, head, white, alone=True)
    of_face = alone[alone[..., 3] > 0.9][:, :3].mean()
    assert abs(of_face / own - 1) < 0.1
    brighter = facerf.relight(
        models, photo, head, facerf.Light(white.directions, 3 * white.weights), alone=True
    )
    np.testing.assert_allclose(brighter[..., :3], 3 * alone[..., :3], rtol=1e-3, atol=1e-4)


def test_what_cannot_be_used_is_said(page: dict[str, Any]) -> None:
    models = page["models"]
    with pytest.raises(InputError, match="no face found"):
        facerf.fit_photo(models, np.full((200, 300, 3), 0.3, np.float32))
    with pytest.raises(ValueError, match="200, 300"):
        facerf.fit_photo(models, np.zeros((200, 300), np.float32))
    with pytest.raises(InputError):
        facerf.Light.from_envmap(np.ones((30, 40, 3), np.float32))
    with pytest.raises(ValueError, match="uint8"):
        facerf.fit_photo(models, np.zeros((200, 300, 3), np.uint8))
    with pytest.raises(ValueError, match="not finite"):
        facerf.segment(np.full((200, 300, 3), np.nan, np.float32))


@pytest.mark.parametrize(
    ("light", "said"),
    [
        (facerf.Light(np.ones((2, 3)), np.ones((3, 3))), "not \\[L, 3\\]"),
        (facerf.Light(np.ones((2, 3)), np.ones((2, 3))), "length 1"),
        (facerf.Light(np.eye(3), np.full((3, 3), np.nan)), "not all finite"),
    ],
)
def test_lights_that_are_none(page: dict[str, Any], light: facerf.Light, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        facerf.relight(page["models"], page["photo"], page["head"], light)
    with pytest.raises(ValueError, match=said):
        light.to_envmap(16)


@pytest.mark.parametrize("wrong", [(math.nan, 0), (0, 300), (0, 0, (1, -1, 1))])
def test_a_single_light_that_is_none(wrong: Any) -> None:
    with pytest.raises(ValueError, match="no light from"):
        facerf.Light.single(*wrong)


def test_words_and_photos_that_do_not_fit(page: dict[str, Any]) -> None:
    models, photo, head, light = (page[name] for name in ("models", "photo", "head", "two"))
    with pytest.raises(ValueError, match="not one of photo, none"):
        facerf.relight(models, photo, head, light, background="nonne")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="not one of portrait, field"):
        facerf.relight(models, photo, head, light, reflectance="foo")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="not one of field"):
        facerf.estimate_light(models, head, reflectance="portrait")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="fit it again"):
        facerf.relight(models, photo[::2, ::2], head, light)
    with pytest.raises(ValueError, match="length 1"):
        facerf.predict_olat(models, head, np.ones((2, 3)))


def test_the_person_is_read_once_for_all_lights(
    page: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    models, photo, head = (page[name] for name in ("models", "photo", "head"))
    facerf.relight(models, photo, head, facerf.Light.single(0, 0), reflectance="field")

    def read_again(*given: object, **more: object) -> None:
        raise AssertionError("read again")

    monkeypatch.setattr("facerf_cli.api.reflectance_of", read_again)
    image = facerf.relight(models, photo.copy(), head, facerf.Light.single(20, 0), reflectance="field")
    assert np.isfinite(image).all()
    with pytest.raises(AssertionError, match="read again"):  # of another photo, if only a little
        facerf.relight(models, photo * np.float32(1.0005), head, page["two"], reflectance="field")


def test_importing_it_loads_nothing_heavy() -> None:
    code = "import sys, facerf_cli; print('torch' in sys.modules, 'numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.split() == ["False", "False"], done.stderr
