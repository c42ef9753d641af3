"""The code of docs/training.md runs, and a dataset from arrays is what prepare-dataset writes."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facerf_cli.capture.layouts import read_capture
from facerf_cli.dataset.dataset import read_dataset, read_stack
from facerf_cli.dataset.from_arrays import write_dataset
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.network.checkpoint import save_networks
from facerf_cli.network.files import read_metadata
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from tests import astronaut
from tests.refusals import refused
from tests.worlds import write_capture

ROOT = Path(__file__).parents[2]
FRONT = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The names that the page's code leaves, run from top to bottom."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "examples").symlink_to(ROOT / "examples")
    names: dict[str, Any] = {"folder": folder}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in re.findall(r"```python\n(.*?)```", (ROOT / "docs/training.md").read_text(), re.S):
            exec(compile(block, "docs/training.md", "exec"), names)
    return names


def test_the_page_trains_by_a_loss_of_its_own(page: dict[str, Any]) -> None:
    rows = (page["folder"] / "run/log.jsonl").read_text().splitlines()
    assert len(rows) == 20 and all('"l2"' in row for row in rows)
    assert read_metadata(page["folder"] / "run/best.safetensors")["training"]
    assert page["mine"].models.checkpoint_name() == "best"
    assert page["image"].shape == page["photo"].shape and np.isfinite(page["image"]).all()


def test_a_dataset_holds_the_arrays_in_the_crop_of_the_face(page: dict[str, Any]) -> None:
    dataset, rig = read_dataset(page["folder"] / "dataset"), page["rig"]
    assert dataset.subjects == ("anna", "bo", "cy")
    assert all(len(members) == 1 for members in dataset.splits.values())
    path = dataset.stack_path("anna", "camera")
    header, fit = read_stack(path)
    # Lights turn with the fitted head, so they are those that were given, in the crop's camera.
    np.testing.assert_allclose(header.directions @ header.directions.T, rig @ rig.T, atol=1e-6)
    assert np.degrees(np.arccos((header.directions * rig).sum(1).clip(-1, 1))).max() < 5
    expected = fit.crop.apply(page["olats"][3]).clip(min=0)
    stored = read_olats(path, slice(3, 4))[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(stored, expected, atol=1e-3, rtol=1e-3)
    own = page["mine"].landmarks
    crop_px = fit.crop.to_crop(own) - fit.landmarks_px.numpy()
    assert np.abs(crop_px).mean() < 0.03 * fit.crop.size_px


@pytest.mark.parametrize(
    ("people", "directions", "said"),
    [
        ({}, FRONT, "people"),
        ({"a/b": np.zeros((2, 8, 8, 3))}, FRONT, "people[0]: use a name"),
        ({"a": np.zeros((2, 8, 8))}, FRONT, "use [2, height, width, 3]"),
        ({"a": np.zeros((3, 8, 8, 3))}, FRONT, "[3, 8, 8, 3]"),
        ({"a": np.zeros((2, 8, 8, 3))}, FRONT[0], "directions[0]"),
        ({"a": np.zeros((2, 8, 8, 3))}, 2 * FRONT, "directions[0] ... length 1"),
    ],
)
def test_arrays_that_do_not_fit(people: Any, directions: np.ndarray, said: str, tmp_path: Path) -> None:
    refused(InputError, said, write_dataset, tmp_path / "out", astronaut.models(), people, directions)


def test_cameras_of_a_stage_and_a_mirrored_rig(tmp_path: Path) -> None:
    write_capture(tmp_path / "stage", subjects=1, lights=12)
    stage, flip = read_capture(tmp_path / "stage"), np.diag([1.0, -1.0, -1.0])
    cameras, images = {}, {}
    for name, posed in stage.cameras.items():
        (fx, fy), (cx, cy) = posed.focal_px, posed.centre_px
        pose = flip @ np.c_[posed.rotation.numpy(), posed.translation_m.numpy()]
        cameras[name] = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pose
        images[name] = np.stack([stage.frame("0000", name, light) for light in range(12)])
    models, rig = astronaut.models(), stage.directions_world
    given: dict[str, Any] = {"split": "1/0/0", "crop_px": 64, "cameras": cameras}
    made = write_dataset(tmp_path / "made", models, {"0000": images}, rig, **given)
    assert made.cameras == {"0000": ("C0", "C1", "C2")}
    with pytest.raises(InputError, match="0000/C0: rig: the lights are turned sideways"):
        write_dataset(tmp_path / "mirrored", models, {"0000": images}, rig * [-1, 1, 1], **given)
    with pytest.raises(InputError, match="one per camera"):
        write_dataset(tmp_path / "one", models, {"0000": images["C0"]}, rig, **given)


def test_people_of_two_sizes_and_no_face(page: dict[str, Any], tmp_path: Path) -> None:
    models = astronaut.models()
    one = {"a": np.zeros((2, 64, 48, 3), np.float32)}
    refused(InputError, "a: no camera", write_dataset, tmp_path / "out", models, one, FRONT, checks=False)
    refused(InputError, "a/camera: black: most frames", write_dataset, tmp_path / "out", models, one, FRONT)
    two = {"a": page["olats"], "b": page["olats"][:, 1:]}
    with pytest.raises(InputError, match=r"b: images of shape \[511, 512, 3\], not \[512, 512, 3\]"):
        write_dataset(tmp_path / "two", models, two, page["rig"], split="1/0/0")
    refused(UsageError, "contains a dataset", write_dataset, page["folder"] / "dataset", models, one, FRONT)
    assert not (tmp_path / "two" / "dataset.json").exists()


def test_a_network_without_a_name_is_not_saved_as_another(tmp_path: Path) -> None:
    class Unnamed(DefaultReflectanceNetwork):
        pass

    small = DefaultReflectanceSettings(32, (4, 8, 8), (4, 8, 8), rig_lights=8)
    with pytest.raises(UsageError, match=r"Unnamed: .*use_form"):
        save_networks(tmp_path / "x.safetensors", {"reflectance": Unnamed(small)}, {})
