"""Prepared light-stage data on disk (DESIGN, 'Files'): what is where, and reading what is said of it.

    dataset.json               lights, cameras, normalisation, splits, subjects; written last
    findings.jsonl             what the checks of the capture found (`capture/checks/findings.py`)
    olat/SUBJECT/CAMERA.exr    an OLAT stack of the face's crop (`files/olat_stack.py`, kind 'image')
    fits/SUBJECT/CAMERA.npz    its fit (`face/fit.py`)
    fits/SUBJECT.json          what is known of the subject's fit; written last of its files
    sheets/SUBJECT.jpg, index.html, report.jsonl

Lights and cameras in dataset.json are in DESIGN's axes (x right, y up, z toward the camera), the world as the
capture has it; each stack holds its lights in its own crop's camera space. A subject that lacks lights says
which it has (`lights`, in the order of its stacks' parts) and why not the others (`left_out`).

Who is trained on, validated with and tested with: subjects drawn by their names.

What `prepare-dataset` writes of a dataset as a whole: `dataset.json`, and the key that one run goes by.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from facerf_cli import __version__
from facerf_cli.capture.capture import Capture
from facerf_cli.capture.stage_json import MOST_CAMERAS, MOST_LIGHTS, MOST_SUBJECTS
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.files.documents import Node, digest, read_document, unique_ids

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
    traits: dict[str, dict[str, Any]] = field(default_factory=dict)  # of a subject, where the capture has any
    # Of the subjects that lack some: which lights (places in light_ids, ascending) their stacks hold.
    fewer_lights: dict[str, tuple[int, ...]] = field(default_factory=dict)

    @property
    def subjects(self) -> tuple[str, ...]:
        """All subjects that were prepared, sorted."""
        return tuple(self.cameras)

    def lights_of(self, subject: str) -> tuple[int, ...]:
        """The lights in a subject's stacks, in the order of the parts: places in `light_ids`."""
        return self.fewer_lights.get(subject) or self._all_lights

    @cached_property
    def _all_lights(self) -> tuple[int, ...]:
        return tuple(range(len(self.light_ids)))

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
    cameras, light_ids = _prepared_cameras(root), unique_ids(lights)
    dataset = Dataset(
        folder=folder,
        face_model=root["face_model"].text(),
        crop_px=root["crop_px"].whole(1, LARGEST_CROP_PX),
        light_ids=tuple(light_ids),
        directions_world=directions,
        splits=_read_splits(root["splits"], set(cameras)),
        cameras=cameras,
        normalisation=root["normalisation"].table(),
        provenance=root["provenance"].table(),
        traits=_read_traits(root, cameras),
        fewer_lights=_read_lights(root, cameras, light_ids),
    )
    for subject, ids in cameras.items():
        for camera in ids:
            for path in (dataset.stack_path(subject, camera), dataset.fit_path(subject, camera)):
                if not path.is_file():
                    raise InputError(f"{path}: missing from the dataset; run prepare-dataset again")
    return dataset


def _read_traits(root: Node, subjects: Iterable[str]) -> dict[str, dict[str, Any]]:
    """What the capture says of subjects, as it stands."""
    nodes = root["subjects"].entries(MOST_SUBJECTS)
    found = {subject: nodes[subject].get("traits") for subject in subjects}
    return {subject: traits.table() if traits else {} for subject, traits in found.items()}


def _read_lights(root: Node, subjects: Iterable[str], light_ids: list[str]) -> dict[str, tuple[int, ...]]:
    """The lights of the subjects that lack some; entries without `lights` have all."""
    nodes = root["subjects"].entries(MOST_SUBJECTS)
    places = {name: place for place, name in enumerate(light_ids)}
    lights = {}
    for subject in subjects:
        if found := nodes[subject].get("lights"):
            named = [node.text() for node in found.items(MOST_LIGHTS)]
            if not named or [name for name in light_ids if name in named] != named:
                raise found.wrong("some of the rig's lights, in its order")
            lights[subject] = tuple(places[name] for name in named)
    return lights


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


_COLOUR_SPACE = "lin_rec709"


def preparation_key(capture: Capture, face_model_sha256: str, crop_px: int) -> str:
    """What a subject's files depend on besides its pictures, as a short digest."""
    content = [FORMAT, capture.pattern, face_model_sha256, crop_px, _calibration(capture)]
    return digest(json.dumps(content, sort_keys=True).encode())


def describe_dataset(
    capture: Capture,
    records: Mapping[str, Mapping[str, Any]],
    split: Split,
    seed: int,
    model: MorphableModel,
    face_model_sha256: str,
    crop_px: int,
) -> dict[str, Any]:
    """The content of `dataset.json`; subjects without a record are those that failed."""
    splits = split.of(capture.subjects, seed)
    return {
        "format": FORMAT,
        "capture": capture.folder.resolve().name,
        "face_model": model.name,
        "crop_px": crop_px,
        "colour_space": _COLOUR_SPACE,
        "axes": "x right, y up, z toward the camera; metres; pixel centres at index + 0.5",
        **_calibration(capture),
        "splits": {name: [subject for subject in splits[name] if subject in records] for name in SPLITS},
        "subjects": {
            subject: {"traits": traits, **_status(records.get(subject))}
            for subject, traits in capture.subjects.items()
        },
        "provenance": {
            "software": f"facerf {__version__}",
            "face_model_licence": model.licence,
            "face_model_sha256": face_model_sha256,
            "split_seed": seed,
            "capture": capture.provenance,
        },
    }


def _status(record: Mapping[str, Any] | None) -> dict[str, Any]:
    if record is None:
        return {"status": "failed"}
    known = {name: record[name] for name in ("error_iod", "quality", "faces_found")}
    less = {
        name: record[name] for name in ("lights", "left_out", "dropped", "ambient_kept") if name in record
    }
    return {"status": "done", **known, "cameras": list(record["cameras"]), **less}


def _calibration(capture: Capture) -> dict[str, Any]:
    """Lights, cameras and what was done to the pictures' values."""
    lights = zip(capture.light_ids, capture.directions_world.tolist(), strict=True)
    gains = zip(capture.light_ids, (1 / capture.intensities).tolist(), strict=True)
    return {
        "rig": {"lights": [{"id": name, "direction_world": direction} for name, direction in lights]},
        "cameras": [
            {
                "id": name,
                "width": posed.width_px,
                "height": posed.height_px,
                "focal_px": posed.focal_px,
                "centre_px": posed.centre_px,
                "world_to_camera": torch.cat([posed.rotation, posed.translation_m[:, None]], 1).tolist(),
            }
            for name, posed in capture.cameras.items()
        ],
        "normalisation": {
            "from": capture.colour_space,
            "to": _COLOUR_SPACE,
            "black_level": capture.black_level,
            **({"ambient": "subtracted where there is a image of it"} if capture.subtract_ambient else {}),
            **({"head_motion": "frames shifted back, by fits/SUBJECT.json"} if capture.align else {}),
            "gain": dict(gains),
            **({"colour_charts": [chart.record() for chart in capture.charts]} if capture.charts else {}),
            "non_finite": "set to 0",
            "negative": "set to 0 after the crop",
        },
    }


def sha256_of(path: Path) -> str:
    """The digest of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
