"""Prepared light-stage data on disk (DESIGN, 'Files'): what is where, the splits, reading and writing.

    dataset.json               lights, cameras, normalisation, splits, subjects; written last
    olat/SUBJECT/CAMERA.exr    an OLAT stack of the face's crop (`files/olat_stack.py`, kind 'image')
    fits/SUBJECT/CAMERA.npz    its fit (`face/fit.py`)
    fits/SUBJECT.json          what is known of the subject's fit; written last of its files
    sheets/SUBJECT.jpg, index.html, report.jsonl

Lights and cameras in dataset.json are in DESIGN's axes (x right, y up, z toward the camera), the world as the
capture has it; each stack holds its lights in its own crop's camera space.
"""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import FaceFit, fit_to_arrays
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import LAYOUT_VERSION, grid_triangles
from facerf_cli.files.olat_stack import StackHeader
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.raster.rasterize import front_facing, interpolate, rasterize
from facerf_cli.raster.texture import vertex_normals
from facerf_cli.stage.data.documents import Node, read_document, unique_ids
from facerf_cli.stage.data.layouts import MOST_CAMERAS, MOST_LIGHTS, MOST_SUBJECTS

FORMAT = "facerf-dataset-1"
DATASET_FILE = "dataset.json"
SPLITS = ("train", "validation", "test")
LARGEST_CROP_PX = 4096


@dataclass(frozen=True, eq=False)
class Dataset:
    """A prepared dataset as `dataset.json` describes it; failed subjects are left out."""

    folder: Path
    face_model: str  # the name of the model that was fitted
    crop_px: int
    light_ids: tuple[str, ...]
    directions_world: np.ndarray  # [L, 3] unit, toward the lights
    splits: dict[str, tuple[str, ...]]  # subjects of 'train', 'validation' and 'test'
    cameras: dict[str, tuple[str, ...]]  # of each subject, split or not
    normalisation: dict[str, Any]  # colour space from and to, black level, gain of each light
    provenance: dict[str, Any]

    @property
    def subjects(self) -> tuple[str, ...]:
        """All subjects that were prepared, sorted."""
        return tuple(self.cameras)

    def split_of(self, subject: str) -> str:
        """'train', 'validation', 'test', or '' for a subject that is in none."""
        return self._split_by_subject.get(subject, "")

    @cached_property
    def _split_by_subject(self) -> dict[str, str]:
        return {subject: split for split, members in self.splits.items() for subject in members}

    def stack_path(self, subject: str, camera: str) -> Path:
        """The OLAT stack of a subject seen by a camera."""
        return stack_path(self.folder, subject, camera)

    def fit_path(self, subject: str, camera: str) -> Path:
        """The fit of a subject in that camera's crop."""
        return fit_path(self.folder, subject, camera)


def stack_path(folder: Path, subject: str, camera: str) -> Path:
    """Where a dataset keeps a stack."""
    return folder / "olat" / subject / f"{camera}.exr"


def fit_path(folder: Path, subject: str, camera: str) -> Path:
    """Where a dataset keeps a fit."""
    return folder / "fits" / subject / f"{camera}.npz"


def record_path(folder: Path, subject: str) -> Path:
    """Where a dataset keeps what is known of a subject's fit; there once the subject is finished."""
    return folder / "fits" / f"{subject}.json"


def sheet_path(folder: Path, subject: str) -> Path:
    """Where a dataset keeps a subject's contact sheet."""
    return folder / "sheets" / f"{subject}.jpg"


def read_dataset(folder: Path) -> Dataset:
    """Read and check `dataset.json`, and see that every stack and fit it speaks of is there."""
    advice = "make it with `facerf prepare-dataset CAPTURE -o DATASET`"
    root = read_document(folder / DATASET_FILE, advice)
    if root["format"].value != FORMAT:
        raise root["format"].wrong(f"'{FORMAT}'")
    lights = root["rig"]["lights"].items(MOST_LIGHTS)
    directions = np.array([light["direction_world"].unit() for light in lights]).reshape(-1, 3)
    if not lights:
        raise root["rig"]["lights"].wrong("a light at least")
    cameras = _prepared_cameras(root)
    dataset = Dataset(
        folder=folder,
        face_model=root["face_model"].text(),
        crop_px=root["crop_px"].whole(1, LARGEST_CROP_PX),
        light_ids=tuple(unique_ids(lights)),
        directions_world=directions,
        splits=_read_splits(root["splits"], set(cameras)),
        cameras=cameras,
        normalisation=root["normalisation"].table(),
        provenance=root["provenance"].table(),
    )
    for subject, ids in cameras.items():
        for camera in ids:
            for path in (dataset.stack_path(subject, camera), dataset.fit_path(subject, camera)):
                if not path.is_file():
                    raise InputError(f"{path}: missing from the dataset; run prepare-dataset again")
    return dataset


def _prepared_cameras(root: Node) -> dict[str, tuple[str, ...]]:
    """The cameras of every subject that did not fail."""
    known = set(unique_ids(root["cameras"].items(MOST_CAMERAS)))
    cameras = {}
    for subject, node in sorted(root["subjects"].entries(MOST_SUBJECTS).items()):
        if node["status"].text() == "done":
            nodes = node["cameras"].items(MOST_CAMERAS)
            cameras[subject] = tuple(camera.name() for camera in nodes)
            if not nodes:
                raise node["cameras"].wrong("a camera at least")
            for camera in nodes:
                if camera.value not in known or cameras[subject].count(camera.value) > 1:
                    raise camera.wrong("one of the dataset's cameras, once")
    return cameras


def _read_splits(node: Node, subjects: set[str]) -> dict[str, tuple[str, ...]]:
    splits: dict[str, tuple[str, ...]] = {}
    placed: set[str] = set()
    for split in SPLITS:
        members = node[split].items(MOST_SUBJECTS)
        for member in members:
            if member.name() not in subjects:
                raise member.wrong("a subject that was prepared")
            if member.name() in placed:
                raise member.wrong("a subject that is in no split yet")
            placed.add(member.name())
        splits[split] = tuple(member.name() for member in members)
    return splits


@dataclass(frozen=True)
class Split:
    """How many subjects go to training, validation and test: counts, or shares of all that sum to 1."""

    parts: tuple[float, float, float]
    are_shares: bool

    @staticmethod
    def parse(text: str) -> "Split":
        """`300/10/40` or `0.8/0.1/0.1`."""
        words = text.split("/")
        advice = f"--split {text!r}: give counts of subjects such as 300/10/40, or shares such as 0.8/0.1/0.1"
        if len(words) == 3 and all(word.isascii() and word.isdecimal() for word in words):
            train, validation, test = (float(word) for word in words)
            return Split((train, validation, test), are_shares=False)
        try:
            train, validation, test = (float(word) for word in words)
        except ValueError:
            raise UsageError(advice) from None
        if not (min(train, validation, test) >= 0 and abs(train + validation + test - 1) < 1e-6):
            raise UsageError(f"{advice} (shares are not negative and sum to 1)")
        return Split((train, validation, test), are_shares=True)

    def counts(self, subjects: int) -> tuple[int, int, int]:
        """How many of so many subjects go where; of shares, none but 0 goes without one if that can be."""
        if not self.are_shares:
            train, validation, test = (int(part) for part in self.parts)
            if train + validation + test > subjects:
                wanted = "/".join(str(int(part)) for part in self.parts)
                raise UsageError(
                    f"--split {wanted}: {train + validation + test} subjects, but the capture has "
                    f"{subjects}; give shares such as 0.8/0.1/0.1"
                )
            return train, validation, test
        exact = np.array(self.parts) * subjects
        counts = np.floor(exact + 1e-9).astype(int)
        order = np.argsort(counts - exact, kind="stable")
        counts[order[: subjects - counts.sum()]] += 1  # the largest remainders
        for part in np.flatnonzero((counts == 0) & (np.array(self.parts) > 0)):
            if counts.max() > 1:
                counts[counts.argmax()] -= 1
                counts[part] = 1
        train, validation, test = counts.tolist()
        return train, validation, test

    def of(self, subjects: Iterable[str], seed: int) -> dict[str, tuple[str, ...]]:
        """The subjects of each split, sorted.

        They are cut from an order that depends on each subject's name and the seed alone, so that a subject
        more or less moves few of the others.
        """
        order = sorted(subjects, key=lambda name: hashlib.sha256(f"{seed}/{name}".encode()).digest())
        ends = np.cumsum([0, *self.counts(len(order))]).tolist()
        parts = (order[first:last] for first, last in pairwise(ends))
        return {split: tuple(sorted(part)) for split, part in zip(SPLITS, parts, strict=True)}


def constant_weights(directions: np.ndarray) -> np.ndarray:
    """Weights [L] of lights [L, 3] under a map of radiance 1: the solid angle of each one's cell over pi."""
    white = torch.ones(2, 4, 3)
    return envmap_weights(white, torch.from_numpy(directions).float())[:, 0].numpy()


def stack_header(
    model: MorphableModel,
    fit: FaceFit,
    directions: np.ndarray,
    source: np.ndarray,
    inside: np.ndarray,
    metadata: Mapping[str, Any],
) -> StackHeader:
    """The header of a stack of pictures [S, S, 3] in a fit's crop, lit from camera-space directions [L, 3].

    `source` [S, S, 3] is the crop under a constant map of radiance 1; `inside` [S, S] tells which of its
    pixels the photo holds. The face is seen where the front of the fitted mesh covers those.
    """
    vertices, triangles = fit.vertices_camera(model), grid_triangles()
    fragments = rasterize(vertices, triangles, fit.camera)
    front = front_facing(vertices, triangles)[fragments.triangle] & fragments.covered
    normals = interpolate(vertex_normals(vertices, triangles), triangles, fragments)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    return StackHeader(
        kind="image",
        directions=directions,
        rotation=fit.rotation.double().numpy(),
        source=source,
        seen=(front.numpy() & inside).astype(np.float32),
        normals=normals.numpy(),
        layout_version=LAYOUT_VERSION,
        fit=fit_to_arrays(fit),
        metadata=dict(metadata),
    )
