"""`--geometry network` of the verbs on photos: heads regressed without landmarks."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from facerf_cli.face.crop import from_box
from facerf_cli.face.fit import load_fit
from facerf_cli.files.read import read_image
from facerf_cli.main import main
from facerf_cli.network.checkpoint import load_checkpoint, save_checkpoint
from facerf_cli.network.files import SHIPPED
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Sides, load_models

PHOTO = Path(__file__).parents[2] / "examples/astronaut.jpg"


def fit(output: Path, *words: str) -> int:
    return main(["--device", "cpu", "fit-geometry", str(PHOTO), "-o", str(output), *words])


def is_regressed(output: Path) -> bool:
    """Tell whether the head was not fitted to landmarks, whose error would be known."""
    row = json.loads((output / "report.jsonl").read_text())
    return row["quality"] == "unknown" and "error_iod" not in row


def test_the_network_regresses_the_head_of_a_photo(tmp_path: Path) -> None:
    assert fit(tmp_path, "--geometry", "network") == 0
    found = load_fit(tmp_path / "astronaut_fit.npz")
    photo = read_image(PHOTO).pixels
    assert found.crop == from_box(find_faces(SHIPPED_NETWORKS.people, photo, "astronaut")[0].box_px, 512)
    models = load_models()
    crop = torch.from_numpy(found.crop.apply(photo)).permute(2, 0, 1)[None]
    with torch.no_grad():
        estimate = models.networks.geometry(crop)
    torch.testing.assert_close(found.rotation, estimate.rotation[0])
    torch.testing.assert_close(found.translation_m, estimate.translation_m[0])
    torch.testing.assert_close(found.alpha[: estimate.alpha.shape[1]], estimate.alpha[0])
    assert is_regressed(tmp_path)


def test_a_checkpoint_of_both_networks_regresses_by_default(tmp_path: Path) -> None:
    tensors, metadata = load_checkpoint(SHIPPED["reflectance"])
    joint = tmp_path / "joint.safetensors"
    save_checkpoint(joint, tensors, metadata | {"geometry": "network", "texture_side": 128, "crop_px": 192})
    assert fit(tmp_path / "out", "--checkpoint", str(joint)) == 0
    assert is_regressed(tmp_path / "out")
    assert load_fit(tmp_path / "out/astronaut_fit.npz").crop.size_px == 192
    texture = read_image(tmp_path / "out/astronaut_texture.exr").pixels
    assert texture.shape == (128, 128, 3)


@pytest.mark.parametrize("wrong", [{"texture_side": "128"}, {"crop_px": 10**9}, {"source_colours": 7}])
def test_a_checkpoint_that_expects_nonsense_is_refused(
    tmp_path: Path, wrong: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    tensors, metadata = load_checkpoint(SHIPPED["reflectance"])
    save_checkpoint(tmp_path / "wrong.safetensors", tensors, metadata | wrong)
    assert fit(tmp_path / "out", "--checkpoint", str(tmp_path / "wrong.safetensors")) == 1
    (line,) = [x for x in capsys.readouterr().err.splitlines() if "invalid" in x]
    assert next(iter(wrong)) in line and "train it again" in line


def test_sides_keep_the_proportion_of_training() -> None:
    models = replace(load_models(), trained_sides=Sides(128, 192))
    assert models.sides() == Sides(128, 192) and models.sides(256) == Sides(256, 384)
