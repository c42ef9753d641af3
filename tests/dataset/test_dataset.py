"""Prepared data: what is written is read, what is wrong is said in one line, and nobody is in two splits."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from facerf_cli.dataset.dataset import SPLITS, Split, read_dataset
from facerf_cli.dataset.prepare import constant_weights, stack_header
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import fit_from_arrays, load_fit
from facerf_cli.face.morphable import load_face_model
from facerf_cli.raster.camera import pose_to_rotation
from tests.dataset.dataset_fixture import write_small_dataset
from tests.refusals import refused
from tests.stacks import read_olat_stack


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_dataset(tmp_path_factory.mktemp("dataset"), (1, 1, 1), lights=12, crop_px=48).folder


def test_a_dataset_is_read_as_it_was_written(small: Path) -> None:
    dataset = read_dataset(small)
    assert dataset.subjects == ("0000", "0001", "0002") and dataset.crop_px == 48
    assert dataset.splits == {"train": ["0000"], "validation": ["0001"], "test": ["0002"]}
    assert dataset.split_of("0001") == "validation" and dataset.cameras["0002"] == ("C0", "C1")
    stack = read_olat_stack(dataset.stack_path("0001", "C1"))
    fit = load_fit(dataset.fit_path("0001", "C1"))
    vertices = fit.vertices_camera(load_face_model(dataset.face_model))
    assert torch.equal(vertices, fit_from_arrays(stack.header.fit).vertices_camera(load_face_model()))
    turned = dataset.directions_world @ fit.rotation.numpy().T  # the fixture's world is the head
    assert np.abs(turned - stack.header.directions).max() < 1e-6
    weights = constant_weights(stack.header.directions)
    lit = np.einsum("l,lchw->hwc", weights, stack.olats.float().numpy())
    assert weights.sum() == pytest.approx(4, rel=1e-3)  # 4 pi / pi
    assert np.abs(lit - stack.header.source).max() < 2e-3 * lit.max()


def test_a_camera_behind_the_head_does_not_see_the_face(small: Path) -> None:
    model = load_face_model()
    fit = load_fit(read_dataset(small).fit_path("0000", "C0"))
    turn = pose_to_rotation(180.0, 0.0, 0.0)
    source, inside = np.zeros((48, 48, 3), np.float32), np.ones((48, 48), bool)
    for rotation, sees in ((fit.rotation, True), (turn @ fit.rotation, False)):
        header = stack_header(model, replace(fit, rotation=rotation), np.eye(3), source, inside, {})
        assert (header.seen.mean() > 0.2) == sees
    assert header.seen.mean() < 0.01  # not the mask's inside


def changed(small: Path, folder: Path, change: dict[str, Any]) -> Path:
    """A copy of the dataset's description, with some of its entries replaced."""
    content = json.loads((small / "dataset.json").read_text()) | change
    (folder / "dataset.json").write_text(json.dumps(content))
    for name in ("olat", "fits"):
        (folder / name).symlink_to(small / name)
    return folder


def lights_said(lights: list[str]) -> dict[str, Any]:
    """A change: the lights that a subject is said to have."""
    subjects = {"0000": {"status": "done", "cameras": ["C0"], "lights": lights}}
    return {"subjects": subjects, "splits": {"train": [], "validation": [], "test": []}}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "other"}, "facerf-dataset-1"),
        ({"crop_px": 1e9}, "crop_px"),
        ({"rig": {"lights": []}}, "rig: lights: ... at least 1"),
        ({"rig": {"lights": [{"id": "L0", "direction_world": [1, 1, 1]}]}}, "length 1"),
        ({"rig": {"lights": [{"id": "L0", "direction_world": [float("nan"), 0, 0]}]}}, "finite"),
        ({"splits": {"train": ["0000"], "validation": ["0000"], "test": []}}, "one split only"),
        ({"splits": {"train": ["9999"], "validation": [], "test": []}}, "9999"),
        ({"subjects": {"../0000": {"status": "done", "cameras": []}}}, "a name"),
        ({"subjects": {"0000": {"status": "done", "cameras": []}}}, "at least one camera"),
        ({"subjects": []}, "an object"),
        (lights_said(["L001", "L000"]), "the rig's order"),
        (lights_said(["L099"]), "rig's lights"),
        (lights_said([]), "rig's lights"),
    ],
)
def test_what_is_wrong_is_said(small: Path, tmp_path: Path, change: dict[str, Any], said: str) -> None:
    refused(InputError, f"dataset.json ... {said}", read_dataset, changed(small, tmp_path, change))


def test_failed_subjects_are_left_out_and_a_stack_that_is_gone_is_named(small: Path, tmp_path: Path) -> None:
    subjects = {"0000": {"status": "done", "cameras": ["C0"]}, "0009": {"status": "failed"}}
    splits = {"train": ["0000"], "validation": [], "test": []}
    dataset = read_dataset(changed(small, tmp_path, {"subjects": subjects, "splits": splits}))
    assert dataset.subjects == ("0000",) and dataset.cameras["0000"] == ("C0",)
    subjects = {"0007": {"status": "done", "cameras": ["C0"]}}
    splits = {split: [] for split in SPLITS}
    (gone := tmp_path / "gone").mkdir()
    with pytest.raises(InputError, match=r"0007/C0\.exr: missing"):
        read_dataset(changed(small, gone, {"subjects": subjects, "splits": splits}))


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "\0"])
def test_what_is_no_json_is_said(tmp_path: Path, text: str) -> None:
    (tmp_path / "dataset.json").write_text(text)
    refused(InputError, "dataset.json: not JSON", read_dataset, tmp_path)
    refused(InputError, "prepare-dataset", read_dataset, tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("text", "subjects", "counts"),
    [
        ("300/10/40", 350, (300, 10, 40)),
        ("0.8/0.1/0.1", 40, (32, 4, 4)),
        ("0.8/0.1/0.1", 5, (3, 1, 1)),
        ("0.8/0.1/0.1", 2, (1, 1, 0)),
        ("0.5/0.5/0.0", 3, (2, 1, 0)),
        ("1/1/0", 5, (1, 1, 0)),
    ],
)
def test_counts_of_a_split(text: str, subjects: int, counts: tuple[int, int, int]) -> None:
    assert Split.parse(text).counts(subjects) == counts


@pytest.mark.parametrize("text", ["", "1/2", "a/b/c", "0.5/0.5/0.5", "-1/1/1", "nan/0.5/0.5", "0.2/0.9/-0.1"])
def test_a_split_that_is_none(text: str) -> None:
    refused(UsageError, "--split", Split.parse, text)


def test_splits_are_stable_disjoint_and_no_larger_than_the_dataset() -> None:
    refused(UsageError, "has 40", Split.parse("300/10/40").counts, 40)
    names: dict[str, dict[str, str]] = {f"{index:04d}": {} for index in range(200)}
    split = Split.parse("0.8/0.1/0.1")
    fewer = dict(list(names.items())[:-1])
    before, after, other = split.of(names, 0), split.of(fewer, 0), split.of(names, 1)
    assert sorted(name for part in before.values() for name in part) == [*names]
    assert before == split.of(dict(reversed(names.items())), 0) and before != other
    moved = sum(len(set(before[part]) ^ set(after[part])) for part in SPLITS)
    assert moved <= 5  # of a subject more: itself, and one over each border
    takes = {name: {"person": name[:3]} for name in names}  # ten of each person
    for part in split.of(takes, 0).values():
        assert len(part) == 10 * len({name[:3] for name in part})
