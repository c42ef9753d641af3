"""The prepared dataset on disk (DESIGN, 'Files'): its paths, and reading and writing `dataset.json`.

    dataset.json               lights, cameras, normalisation, splits, subjects; written last
    findings.jsonl             findings of the capture's checks (`capture/findings.py`)
    olat/SUBJECT/CAMERA.exr    OLAT stack of the face's crop (`files/olat_stack.py`, kind 'image')
    fits/SUBJECT/CAMERA.npz    its fit (`face/fit.py`)
    fits/SUBJECT.json          record of the subject; written last of the subject's files
    sheets/SUBJECT.jpg, index.html

Lights and cameras in dataset.json are in DESIGN's axes (x right, y up, z toward the camera) and the capture's
world space; each stack holds its lights in its own crop's camera space. A subject that lacks lights lists
those it has (`lights`, in the order of its stacks' parts) and why the others are missing (`left_out`).
"""

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, model_validator

from facerf_cli._version import __version__
from facerf_cli.batch.recipe import Recipe
from facerf_cli.capture.capture import Capture
from facerf_cli.capture.stage_json import MOST_CAMERAS, MOST_LIGHTS, MOST_SUBJECTS
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import FaceFit, fit_from_arrays
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.documents import Direction, Document, Name, digest, distinct, read_document
from facerf_cli.files.olat_stack import StackHeader, read_olat_header
from facerf_cli.run.logs import LOGGER_NAME

Format = Literal["facerf-dataset-1"]
FORMAT: Format = "facerf-dataset-1"
DATASET_FILE = "dataset.json"
SPLITS = ("train", "validation", "test")
LARGEST_CROP_PX = 4096
PREPARE_AGAIN = "run prepare-dataset with --overwrite always"
_COLOUR_SPACE = "lin_rec709"
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class DatasetFolder:
    """Paths of a dataset."""

    folder: Path

    def stack_path(self, subject: str, camera: str) -> Path:
        return self.folder / "olat" / subject / f"{camera}.exr"

    def fit_path(self, subject: str, camera: str) -> Path:
        """Path of the fit of a subject in a camera's crop."""
        return self.folder / "fits" / subject / f"{camera}.npz"

    def record_path(self, subject: str) -> Path:
        """Path of a subject's record; it exists once the subject is finished."""
        return self.folder / "fits" / f"{subject}.json"

    def sheet_path(self, subject: str) -> Path:
        """Path of a subject's contact sheet."""
        return self.folder / "sheets" / f"{subject}.jpg"


@dataclass(frozen=True, eq=False)
class Dataset(DatasetFolder):
    """The content of `dataset.json`, without failed subjects."""

    face_model: str  # name of the fitted model
    crop_px: int  # side of the largest crop
    light_ids: tuple[str, ...]
    directions_world: np.ndarray  # [L, 3] unit, toward the lights
    splits: dict[str, tuple[str, ...]]  # by 'train', 'validation' and 'test'
    cameras: dict[str, tuple[str, ...]]  # of each subject, in a split or not
    provenance: dict[str, Any]
    traits: dict[str, dict[str, Any]] = field(default_factory=dict)  # by subject; {} where there are none
    # Lights of subjects that lack some: indices into light_ids, ascending, of the parts of their stacks.
    fewer_lights: dict[str, tuple[int, ...]] = field(default_factory=dict)

    @property
    def subjects(self) -> tuple[str, ...]:
        """All prepared subjects, sorted."""
        return tuple(self.cameras)

    def lights_of(self, subject: str) -> tuple[int, ...]:
        """Lights of a subject's stacks, in the order of the parts, as indices into `light_ids`."""
        return self.fewer_lights.get(subject) or tuple(range(len(self.light_ids)))

    def split_of(self, subject: str) -> str:
        """Split of a subject: 'train', 'validation', 'test', or '' for none."""
        return self._split_by_subject.get(subject, "")

    @cached_property
    def _split_by_subject(self) -> dict[str, str]:
        return {subject: split for split, members in self.splits.items() for subject in members}


def people_of(dataset: Dataset, split: str) -> tuple[str, ...]:
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


class _RigLight(Document):
    id: Name
    direction_world: Direction


class _Rig(Document):
    lights: Annotated[list[_RigLight], Field(min_length=1, max_length=MOST_LIGHTS)]


class _SubjectEntry(Document):
    status: str
    cameras: Annotated[list[Name], Field(max_length=MOST_CAMERAS, default_factory=list)]
    lights: Annotated[list[str], Field(max_length=MOST_LIGHTS)] | None = None  # None: all
    traits: dict[str, Any] = Field(default_factory=dict)


_Members = Annotated[list[Name], Field(max_length=MOST_SUBJECTS)]


class _SplitLists(Document):
    train: _Members
    validation: _Members
    test: _Members


class _DatasetDocument(Document):
    format: Format
    face_model: str
    crop_px: Annotated[int, Field(ge=1, le=LARGEST_CROP_PX)]
    rig: _Rig
    subjects: Annotated[dict[Name, _SubjectEntry], Field(max_length=MOST_SUBJECTS)]
    splits: _SplitLists
    provenance: dict[str, Any]

    @property
    def done(self) -> dict[str, _SubjectEntry]:
        """The subjects that did not fail, sorted."""
        return {name: entry for name, entry in sorted(self.subjects.items()) if entry.status == "done"}

    @model_validator(mode="after")
    def _is_consistent(self) -> "_DatasetDocument":
        light_ids = distinct([light.id for light in self.rig.lights], "the light")
        for name, subject in self.done.items():
            if not distinct(subject.cameras, f"in {name}, the camera"):
                raise ValueError(f"subject {name} needs at least one camera")
            lights = light_ids if subject.lights is None else subject.lights
            if not lights or [light for light in light_ids if light in set(lights)] != lights:
                raise ValueError(f"subject {name} needs some of the rig's lights, in the rig's order")
        members = self.splits.train + self.splits.validation + self.splits.test
        for name in distinct(members, "in the splits, one split only may hold a subject:"):
            if name not in self.done:
                raise ValueError(f"the splits name {name}, which is no prepared subject")
        return self


def read_dataset(folder: Path) -> Dataset:
    """Read and check `dataset.json`; raise InputError where a stack or fit that it lists is missing."""
    advice = "make it with `facerf prepare-dataset CAPTURE -o DATASET`"
    content = read_document(folder / DATASET_FILE, _DatasetDocument, advice)
    light_ids = tuple(light.id for light in content.rig.lights)
    places = {name: place for place, name in enumerate(light_ids)}
    dataset = Dataset(
        folder=folder,
        face_model=content.face_model,
        crop_px=content.crop_px,
        light_ids=light_ids,
        directions_world=np.array([light.direction_world for light in content.rig.lights]),
        splits={split: tuple(getattr(content.splits, split)) for split in SPLITS},
        cameras={name: tuple(subject.cameras) for name, subject in content.done.items()},
        provenance=content.provenance,
        traits={name: subject.traits for name, subject in content.done.items()},
        fewer_lights={
            name: tuple(places[light] for light in subject.lights)
            for name, subject in content.done.items()
            if subject.lights is not None
        },
    )
    for subject, ids in dataset.cameras.items():
        for camera in ids:
            for path in (dataset.stack_path(subject, camera), dataset.fit_path(subject, camera)):
                if not path.is_file():
                    raise InputError(f"{path}: missing from the dataset; run prepare-dataset again")
    return dataset


def read_stack(path: Path) -> tuple[StackHeader, FaceFit]:
    """Read the header and the fit of a stack; raise InputError where they are no face crop's."""
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
    """Sizes of training, validation and test: counts of subjects, or shares of all that sum to 1."""

    parts: tuple[float, float, float]
    are_shares: bool

    @staticmethod
    def parse(text: str) -> "Split":
        """Parse `300/10/40` or `0.8/0.1/0.1`; raise UsageError for anything else."""
        words = text.split("/")
        advice = f"--split {text!r}: give counts of subjects such as 300/10/40, or shares such as 0.8/0.1/0.1"
        try:
            train, validation, test = (float(word) for word in words)
        except ValueError:
            raise UsageError(advice) from None
        parts, are_shares = (train, validation, test), not all(map(str.isdecimal, words))
        if are_shares and not (min(parts) >= 0 and abs(sum(parts) - 1) < 1e-6):
            raise UsageError(f"{advice} (shares are not negative and sum to 1)")
        return Split(parts, are_shares)

    def counts(self, subjects: int) -> tuple[int, int, int]:
        """Split a number of subjects; where it is large enough, every share above 0 gets at least one."""
        if not self.are_shares:
            train, validation, test = (int(part) for part in self.parts)
            if (wanted := train + validation + test) > subjects:
                raise UsageError(
                    f"--split {train}/{validation}/{test}: {wanted} subjects, but the capture has "
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

    def of(self, subjects: Mapping[str, Mapping[str, Any]], seed: int) -> dict[str, tuple[str, ...]]:
        """Assign subjects, with their traits, to splits, each sorted; those of one "person" stay together.

        The order that is cut into splits depends on each subject's name and the seed alone, so that adding or
        removing a subject moves few of the others.
        """
        people: dict[str, list[str]] = {}
        for name, traits in subjects.items():
            people.setdefault(str(traits.get("person", name)), []).append(name)
        order = sorted(people, key=lambda name: hashlib.sha256(f"{seed}/{name}".encode()).digest())
        ends = np.cumsum([0, *self.counts(len(order))]).tolist()
        parts = (order[first:last] for first, last in pairwise(ends))
        return {
            split: tuple(sorted(name for person in part for name in people[person]))
            for split, part in zip(SPLITS, parts, strict=True)
        }


def preparation(capture: Capture, face_model_sha256: str, crop_px: int | None, network_sha256: str) -> Recipe:
    """List all that a subject's files depend on besides its images, by the names of options."""
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
    capture: Capture,
    records: Mapping[str, Mapping[str, Any]],
    split: Split,
    seed: int,
    model: MorphableModel,
    face_model_sha256: str,
) -> dict[str, Any]:
    """Make the content of `dataset.json`; subjects without a record are marked as failed."""
    splits = split.of(capture.subjects, seed)
    return {
        "format": FORMAT,
        "capture": capture.folder.resolve().name,
        "face_model": model.name,
        "crop_px": max(entry["crop_px"] for one in records.values() for entry in one["cameras"].values()),
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
    optional = ("lights", "left_out", "dropped", "ambient_kept")
    less = {name: record[name] for name in optional if name in record}
    return {"status": "done", **known, "cameras": list(record["cameras"]), **less}


def _calibration(capture: Capture) -> dict[str, Any]:
    """Lights, cameras and the normalisation of the images' values.

    `preparation` compares all of it: another word here prepares every dataset again.
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
    """Provenance of a dataset, for a checkpoint that was trained on it."""
    name = dataset.folder.resolve().name
    return {
        "trained_on": f"{name}, {len(dataset.splits['train'])} subjects",
        "dataset": dataset.provenance,
        "fitted_with": model.credit,
        "licence": _licence(dataset.provenance, name),
    }


def _licence(provenance: dict[str, Any], name: str) -> str:
    """Licence that the dataset or its capture states, or a reference to the dataset."""
    found = provenance.get("capture")
    capture = found if isinstance(found, dict) else {}
    if words := provenance.get("licence") or capture.get("licence"):
        return str(words)
    if capture.get("synthetic") is True and "face_model_licence" in capture:  # by `facerf synth-stage`
        return f"MIT; the heads' shapes: {capture['face_model_licence']}"
    return f"that of the dataset {name}"
