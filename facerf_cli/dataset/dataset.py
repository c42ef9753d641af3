"""Paths of a prepared dataset (docs/light-stage.md), and the model of its `dataset.json`.

    dataset.json               lights, cameras, normalisation, splits, subjects; written last
    findings.jsonl             findings of the capture's checks (`capture/findings.py`)
    olat/SUBJECT/CAMERA.exr    OLAT stack of the face's crop (`files/olat_stack.py`, kind 'image')
    fits/SUBJECT/CAMERA.npz    its fit (`face/fit.py`)
    fits/SUBJECT.json          record of the subject; written last of the subject's files
    sheets/SUBJECT.jpg, index.html

Lights and cameras in dataset.json are in the package's axes (x right, y up, z toward the camera) and the
capture's world space; each stack contains its lights in its own crop's camera space. A subject without some
of the lights lists the others (`lights`, in the order of its stacks' parts) and the reasons (`left_out`).
"""

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import AfterValidator, Field, model_validator

from facerf_cli._version import __version__
from facerf_cli.batch.recipe import Recipe
from facerf_cli.capture.capture import Capture
from facerf_cli.capture.stage_json import MOST_CAMERAS, MOST_LIGHTS, MOST_SUBJECTS
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import FaceFit, fit_from_arrays
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.documents import Document, Name, checked, digest, distinct
from facerf_cli.files.olat_stack import StackHeader, read_olat_header
from facerf_cli.files.texts import read_json
from facerf_cli.run.logs import LOGGER_NAME

Format = Literal["facerf-dataset-1"]
FORMAT: Format = "facerf-dataset-1"
DATASET_FILE = "dataset.json"
SPLITS = ("train", "validation", "test")
LARGEST_CROP_PX = 4096
PREPARE_AGAIN = "run prepare-dataset with --overwrite always"
_COLOUR_SPACE = "lin_rec709"
_UNIT_TOLERANCE = 1e-3
log = logging.getLogger(LOGGER_NAME)


class DatasetFolder(Document):
    """Paths of a dataset."""

    folder: Annotated[Path, Field(exclude=True)]

    def stack_path(self, subject: str, camera: str) -> Path:
        return self.folder / "olat" / subject / f"{camera}.exr"

    def fit_path(self, subject: str, camera: str) -> Path:
        """Return the path of the fit of a subject in a camera's crop."""
        return self.folder / "fits" / subject / f"{camera}.npz"

    def record_path(self, subject: str) -> Path:
        """Return the path of a subject's record; it exists once the subject is finished."""
        return self.folder / "fits" / f"{subject}.json"

    def sheet_path(self, subject: str) -> Path:
        """Return the path of a subject's contact sheet."""
        return self.folder / "sheets" / f"{subject}.jpg"


def _unit(direction: list[float]) -> list[float]:
    if len(direction) != 3 or not abs(np.linalg.norm(direction) - 1) < _UNIT_TOLERANCE:
        raise ValueError("a vector of length 1 is needed")
    return direction


class RigLight(Document):
    """Unit vector toward a light, and the position of a near one."""

    id: Name
    direction_world: Annotated[list[float], AfterValidator(_unit)]
    position_m: list[float] | None = None


class Rig(Document):
    """Lights of the capture."""

    lights: Annotated[list[RigLight], Field(min_length=1, max_length=MOST_LIGHTS)]


class _Subject(Document):
    """Entries that both descriptions of a prepared subject contain."""

    error_iod: float | None = None
    quality: str = ""
    faces_found: int = 0
    lights: Annotated[list[str], Field(max_length=MOST_LIGHTS)] | None = None  # None: all
    left_out: dict[str, str] = Field(default_factory=dict)  # reason by light
    dropped: dict[str, str] = Field(default_factory=dict)  # reason by camera
    ambient_kept: list[str] = Field(default_factory=list)  # cameras whose ambient image is missing


class SubjectEntry(_Subject):
    """Subject in `dataset.json`; it has stacks unless `status` is "failed"."""

    traits: dict[str, Any] = Field(default_factory=dict)
    status: str
    cameras: Annotated[list[Name], Field(max_length=MOST_CAMERAS)] = Field(default_factory=list)


class CameraRecord(Document):
    """Fit of a subject in one camera."""

    face_found: bool
    error_iod: float
    quality: str
    crop_px: int
    crop_off_iod: float


class SubjectRecord(_Subject):
    """Content of a finished subject's fits/SUBJECT.json."""

    prepared: Recipe = Field(default_factory=dict)  # what the subject was prepared from
    cameras: dict[Name, CameraRecord]
    missing: list[str] = Field(default_factory=list)  # "camera/light" of frames that do not exist


class Dataset(DatasetFolder):
    """Folder of a prepared dataset, and the content of its `dataset.json`."""

    format: Format
    capture: Any = ""  # name of the capture's folder
    face_model: str  # name of the fitted model
    crop_px: Annotated[int, Field(ge=1, le=LARGEST_CROP_PX)]  # side of the largest crop
    colour_space: str = _COLOUR_SPACE
    axes: str = ""
    rig: Rig
    calibrations: list[dict[str, Any]] = Field(default_factory=list, alias="cameras")
    normalisation: dict[str, Any] = Field(default_factory=dict)
    splits: dict[str, Annotated[list[Name], Field(max_length=MOST_SUBJECTS)]]
    entries: Annotated[dict[Name, SubjectEntry], Field(max_length=MOST_SUBJECTS, alias="subjects")]
    provenance: dict[str, Any]

    @model_validator(mode="after")
    def _is_consistent(self) -> "Dataset":
        light_ids, done = distinct(self.light_ids, "the light"), self._done
        for name, subject in done.items():
            if not distinct(subject.cameras, f"in {name}, the camera"):
                raise ValueError(f"subject {name} needs at least one camera")
            lights = light_ids if subject.lights is None else subject.lights
            if not lights or [light for light in light_ids if light in set(lights)] != lights:
                raise ValueError(f"subject {name} needs some of the rig's lights, in the rig's order")
        if missing := [split for split in SPLITS if split not in self.splits]:
            raise ValueError(f"the split {missing[0]} is missing")
        members = [name for split in SPLITS for name in self.splits[split]]
        for name in distinct(members, "in the splits, one split only may hold a subject:"):
            if name not in done:
                raise ValueError(f"the splits name {name}, but there is no such prepared subject")
        return self

    @property
    def _done(self) -> dict[str, SubjectEntry]:
        """Subjects that did not fail, sorted."""
        return {name: entry for name, entry in sorted(self.entries.items()) if entry.status == "done"}

    @cached_property
    def cameras(self) -> dict[str, tuple[str, ...]]:
        """Cameras of each prepared subject, in a split or not, sorted by subject."""
        return {name: tuple(entry.cameras) for name, entry in self._done.items()}

    @property
    def subjects(self) -> tuple[str, ...]:
        """Names of the prepared subjects, sorted."""
        return tuple(self.cameras)

    @property
    def light_ids(self) -> list[str]:
        return [light.id for light in self.rig.lights]

    @cached_property
    def directions_world(self) -> np.ndarray:
        """Unit vectors [L, 3] toward the lights."""
        directions = [np.array(light.direction_world) for light in self.rig.lights]
        return np.array([direction / np.linalg.norm(direction) for direction in directions])

    def lights_of(self, subject: str) -> tuple[int, ...]:
        """Return the lights of a subject's stacks, in the order of the parts, as indices into `light_ids`."""
        lights = self.entries[subject].lights
        if lights is None:
            return tuple(range(len(self.rig.lights)))
        places = {name: place for place, name in enumerate(self.light_ids)}
        return tuple(places[light] for light in lights)

    @cached_property
    def _split_by_subject(self) -> dict[str, str]:
        return {subject: split for split, members in self.splits.items() for subject in members}

    def split_of(self, subject: str) -> str:
        """Return the split of a subject: 'train', 'validation', 'test', or '' for none."""
        return self._split_by_subject.get(subject, "")

    def content(self) -> dict[str, Any]:
        """Return the content of `dataset.json`."""
        return self.model_dump(by_alias=True, exclude_unset=True)


def people_of(dataset: Dataset, split: str) -> list[str]:
    """Return the subjects of a split, to train on ('train') or to validate on ('validation').

    If a dataset has only one person, they are used for both, and a warning is logged. Raises InputError for
    an empty split.
    """
    if split == "validation" and len(dataset.subjects) == 1 and dataset.splits["train"]:
        log.warning("%s: only one person: validating on the training data", dataset.folder)
        return dataset.splits["train"]
    if not dataset.splits[split]:
        advice = "run prepare-dataset with another --split"
        raise InputError(f"{dataset.folder}: no subject in the split {split}; {advice}")
    return dataset.splits[split]


def read_dataset(folder: Path) -> Dataset:
    """Read and check `dataset.json`; raise InputError if a stack or fit that it lists is missing."""
    path = folder / DATASET_FILE
    content = read_json(path, "make it with `facerf prepare-dataset CAPTURE -o DATASET`")
    if isinstance(content, dict):
        content |= {"folder": folder}
    dataset = checked(Dataset, content, str(path))
    for subject, ids in dataset.cameras.items():
        for camera in ids:
            for path in (dataset.stack_path(subject, camera), dataset.fit_path(subject, camera)):
                if not path.is_file():
                    raise InputError(f"{path}: missing from the dataset; run prepare-dataset again")
    return dataset


def read_stack(path: Path) -> tuple[StackHeader, FaceFit]:
    """Read the header and the fit of a stack; raise InputError if it is not a stack of a face crop."""
    header = read_olat_header(path)
    try:
        if header.layout_version != LAYOUT_VERSION or header.kind != "image":
            raise ValueError("another UV layout, or not a stack of images")
        fit = fit_from_arrays(header.fit)
        if header.seen.shape != (fit.crop.size_px, fit.crop.size_px):
            raise ValueError("the images have another size")
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: invalid fit ({error}); {PREPARE_AGAIN}") from None
    return header, fit


@dataclass(frozen=True)
class Split:
    """Sizes of training, validation and test: counts of subjects, or fractions that sum to 1."""

    parts: tuple[float, float, float]
    are_shares: bool

    @staticmethod
    def parse(text: str) -> "Split":
        """Parse `300/10/40` or `0.8/0.1/0.1`; raise UsageError for anything else."""
        words = text.split("/")
        advice = f"--split {text!r}: use counts such as 300/10/40, or fractions such as 0.8/0.1/0.1"
        try:
            train, validation, test = (float(word) for word in words)
        except ValueError:
            raise UsageError(advice) from None
        parts, are_shares = (train, validation, test), not all(map(str.isdecimal, words))
        if are_shares and not (min(parts) >= 0 and abs(sum(parts) - 1) < 1e-6):
            raise UsageError(f"{advice} (fractions that are not negative and sum to 1)")
        return Split(parts, are_shares)

    def counts(self, subjects: int) -> tuple[int, int, int]:
        """Split a number of subjects; if it is large enough, every fraction above 0 gets at least one."""
        if not self.are_shares:
            train, validation, test = (int(part) for part in self.parts)
            if (wanted := train + validation + test) > subjects:
                raise UsageError(
                    f"--split {train}/{validation}/{test}: {wanted} subjects, but the capture has "
                    f"{subjects}; use fractions such as 0.8/0.1/0.1"
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

    def of(self, subjects: Mapping[str, Mapping[str, Any]], seed: int) -> dict[str, list[str]]:
        """Assign subjects, with their traits, to splits, each sorted; takes of one "person" stay together.

        The order that is cut into splits depends only on each subject's name and the seed, so that adding or
        removing a subject moves few of the others.
        """
        people: dict[str, list[str]] = {}
        for name, traits in subjects.items():
            people.setdefault(str(traits.get("person", name)), []).append(name)
        order = sorted(people, key=lambda name: hashlib.sha256(f"{seed}/{name}".encode()).digest())
        ends = np.cumsum([0, *self.counts(len(order))]).tolist()
        parts = (order[first:last] for first, last in pairwise(ends))
        return {
            split: sorted(name for person in part for name in people[person])
            for split, part in zip(SPLITS, parts, strict=True)
        }


def preparation(capture: Capture, face_model_sha256: str, crop_px: int | None, network_sha256: str) -> Recipe:
    """List everything that a subject's files depend on besides its images, by the names of options."""
    calibration = _calibration(capture)
    contents = {
        "face_model": face_model_sha256,
        "checkpoint": network_sha256,  # of the Parsing Network
        "stage_lights": calibration["rig"],
        "stage_cameras": calibration["cameras"],
        "stage_values": calibration["normalisation"],
    }
    digests = {name: f"sha256:{digest(json.dumps(content).encode())}" for name, content in contents.items()}
    return {"dataset_format": FORMAT, "pattern": capture.pattern, "crop": crop_px, **digests}


def describe_dataset(
    folder: Path,
    capture: Capture,
    records: Mapping[str, SubjectRecord],
    split: Split,
    seed: int,
    model: MorphableModel,
    face_model_sha256: str,
) -> Dataset:
    """Describe a dataset in a folder; subjects without a record are marked as failed."""
    splits = split.of(capture.subjects, seed)
    entries: dict[str, dict[str, Any]] = {}
    for subject, traits in capture.subjects.items():
        entries[subject] = {"traits": traits, "status": "failed"}
        if record := records.get(subject):
            known = record.model_dump(exclude={"prepared", "missing"}, exclude_defaults=True)
            entries[subject] |= {"status": "done", **known, "cameras": list(record.cameras)}
    content = {
        "folder": folder,
        "format": FORMAT,
        "capture": capture.folder.resolve().name,
        "face_model": model.name,
        "crop_px": max(camera.crop_px for record in records.values() for camera in record.cameras.values()),
        "colour_space": _COLOUR_SPACE,
        "axes": "x right, y up, z toward the camera; metres; pixel centres at index + 0.5",
        **_calibration(capture),
        "splits": {name: [subject for subject in splits[name] if subject in records] for name in SPLITS},
        "subjects": entries,
        "provenance": {
            "software": f"facerf {__version__}",
            "face_model_licence": model.licence,
            "face_model_sha256": face_model_sha256,
            "split_seed": seed,
            "capture": capture.provenance,
        },
    }
    return checked(Dataset, content, str(folder / DATASET_FILE))


def _calibration(capture: Capture) -> dict[str, Any]:
    """Describe lights, cameras and the normalisation of the images' values.

    `preparation` compares all of it: if a word here changes, every dataset has to be prepared again.
    """
    lights = [
        {"id": name, "direction_world": direction}
        for name, direction in zip(capture.light_ids, capture.directions_world.tolist(), strict=True)
    ]
    for light, place in zip(lights, [] if capture.positions_m is None else capture.positions_m, strict=False):
        if np.isfinite(place).all():
            light["position_m"] = place.tolist()
    gains = zip(capture.light_ids, (1 / capture.intensities).tolist(), strict=True)
    return {
        "rig": {"lights": lights},
        "cameras": [
            {
                "id": name,
                "width": posed.width_px,
                "height": posed.height_px,
                "focal_px": posed.focal_px,
                "centre_px": posed.centre_px,
                "world_to_camera": torch.cat([posed.rotation, posed.translation_m[:, None]], 1).tolist(),
                **({"undistorted": capture.distortion[name]} if name in capture.distortion else {}),
            }
            for name, posed in capture.cameras.items()
        ],
        "normalisation": {
            "from": capture.colour_space,
            "to": _COLOUR_SPACE,
            "black_level": capture.black_level,
            **({} if capture.colour_matrix is None else {"colour_matrix": capture.colour_matrix.tolist()}),
            **({"exposure_stops": dict(capture.stops)} if capture.stops else {}),
            **({"ambient": "subtracted where there is a picture of it"} if capture.subtract_ambient else {}),
            "gain": dict(gains),
            **({"colour_charts": [chart.record for chart in capture.charts]} if capture.charts else {}),
            "non_finite": "set to 0",
            "negative": "set to 0 after the crop",
        },
    }


def provenance_of(dataset: Dataset, model: MorphableModel) -> dict[str, Any]:
    """Return the provenance of a dataset, for a checkpoint that was trained on it."""
    name = dataset.folder.resolve().name
    return {
        "trained_on": f"{name}, {len(dataset.splits['train'])} subjects",
        "dataset": dataset.provenance,
        "fitted_with": model.credit,
        "licence": _licence(dataset.provenance, name),
    }


def _licence(provenance: dict[str, Any], name: str) -> str:
    """Return the licence that the dataset or its capture states, or a reference to the dataset."""
    capture = provenance.get("capture")
    capture = capture if isinstance(capture, dict) else {}
    if words := provenance.get("licence") or capture.get("licence"):
        return str(words)
    if capture.get("synthetic") is True and "face_model_licence" in capture:  # by `facerf synth-stage`
        return f"MIT; the heads' shapes: {capture['face_model_licence']}"
    return f"that of the dataset {name}"
