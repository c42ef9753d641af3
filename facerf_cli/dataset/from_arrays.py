"""Write a prepared dataset from arrays: people under single lights, from one camera or several."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.capture.capture import Capture, FrameSizeError
from facerf_cli.capture.checks.subject import check_subject
from facerf_cli.capture.findings import require_sound, select_frames
from facerf_cli.capture.stage_json import FACING, CameraEntry
from facerf_cli.dataset.dataset import (
    DATASET_FILE,
    Dataset,
    DatasetFolder,
    Split,
    describe_dataset,
    preparation,
    read_dataset,
)
from facerf_cli.dataset.prepare import Preparation, prepare_subject
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.morphable import BUILTIN, BUILTIN_PATH, load_face_model
from facerf_cli.files.documents import Direction, Name, checked, write_document
from facerf_cli.files.texts import file_sha256
from facerf_cli.relighting.models import Models

_CAMERA, _FOCAL = "camera", 4.0  # its name, and its focal length in units of the longer side
People = np.ndarray | Mapping[str, np.ndarray]  # images [L, H, W, 3] of a person, or of each camera


@dataclass(frozen=True, eq=False)
class _Arrays(Capture):
    """Capture whose frames are arrays in memory, [L, H, W, 3] of each subject, or of its cameras."""

    images: Mapping[str, People] = field(default_factory=dict)

    def has_frame(self, subject: str, camera: str, light: str) -> bool:
        return True

    def frame(self, subject: str, camera: str, light: int) -> np.ndarray:
        """Return a frame [H, W, 3]; raise FrameSizeError if its size is not the camera's."""
        pixels = np.asarray(_images_of(self.images[subject], camera)[light], np.float32)
        posed = self.cameras[camera]
        if pixels.shape != (shape := (posed.height_px, posed.width_px, 3)):
            raise FrameSizeError(f"{subject}: images of shape {list(pixels.shape)}, not {list(shape)}")
        if not np.isfinite(pixels).all():
            raise FrameSizeError(f"{subject}: an image contains NaN or infinite values; use finite ones")
        return pixels


def _images_of(person: People, camera: str) -> np.ndarray:
    return person if isinstance(person, np.ndarray) else person[camera]


def write_dataset(
    folder: Path | str,
    models: Models,
    people: Mapping[str, People],
    directions: np.ndarray,
    split: str = "0.8/0.1/0.1",
    focal_px: float | None = None,
    crop_px: int | None = None,
    seed: int = 0,
    cameras: Mapping[str, tuple[Any, Any]] | None = None,
    checks: bool = True,
) -> Dataset:
    """Check the images, find and fit each face, and write a dataset like `facerf prepare-dataset`.

    Args:
        folder: Folder of the dataset; it must not contain one yet.
        models: Networks that find the faces; the face model must be the built-in one.
        people: By name, images [L, H, W, 3] of each person under one light at a time, scene-linear Rec.709,
            as under lights of rgb 1; with `cameras`, such images by camera. A mapping may load each person
            on access.
        directions: Unit vectors [L, 3] toward the lights, in camera space (x right, y up, z to the camera),
            or in the world of `cameras`.
        split: Counts or fractions of people for training, validation and test.
        focal_px: Focal length of the camera; by default 4 times the images' longer side.
        crop_px: Side of the crops, a multiple of 8; by default chosen from the pixels of the face.
        seed: Seed of the split.
        cameras: By name, K [3, 3] in pixels and world_to_camera [3, 4] in metres, with OpenCV's axes, as in
            `stage.json`.
        checks: Check the images as `facerf prepare-dataset` does: broken frames are left out.

    Raises UsageError or InputError for arguments that do not fit, InputError if a face is not found or the
    checks stop a person, for example because the rig is mirrored.
    """
    folder = Path(folder)
    if (folder / DATASET_FILE).exists():
        raise UsageError(f"{folder}: already contains a dataset; use another folder")
    if models.face.name != BUILTIN:
        raise UsageError(f"models: their face model is {models.face.name}; load them with the built-in one")
    capture = _capture(folder, people, np.asarray(directions, np.float64), focal_px, cameras)
    parts, model, sha256 = Split.parse(split), load_face_model(), file_sha256(BUILTIN_PATH)
    parts.counts(len(capture.subjects))
    made_from = preparation(capture, sha256, crop_px, models.networks.sha256("parsing"))
    how = Preparation(model, models.networks, DatasetFolder(folder=folder), crop_px, made_from)
    records = {}
    for name in capture.subjects:
        findings = check_subject(capture, name) if checks else []
        require_sound(name, findings, strict=False)
        records[name] = prepare_subject(capture, name, select_frames(capture, name, findings), how)
    dataset = describe_dataset(folder, capture, records, parts, seed, model, sha256)
    write_document(folder / DATASET_FILE, dataset.content())
    return read_dataset(folder)


def _capture(
    folder: Path,
    people: Mapping[str, People],
    directions: np.ndarray,
    focal_px: float | None,
    cameras: Mapping[str, tuple[Any, Any]] | None,
) -> _Arrays:
    """Describe arrays as a capture; InputError for names, shapes or directions that do not fit."""
    subjects = checked(list[Name], sorted(people), "people")
    units = np.array(checked(list[Direction], directions.tolist(), "directions"))
    first = people[subjects[0]] if subjects else {}
    if isinstance(first, np.ndarray) == (cameras is not None) or (cameras and set(first) != set(cameras)):
        raise InputError("people: use one array per person or, with `cameras`, one per camera of each person")
    posed = {}
    for name in cameras or (_CAMERA,):
        shape = _images_of(first, name).shape
        if len(shape) != 4 or shape[0] != len(units) or shape[3] != 3:
            raise InputError(f"people: shape is {list(shape)}; use [{len(units)}, height, width, 3]")
        height_px, width_px = shape[1:3]
        f = focal_px or _FOCAL * max(height_px, width_px)
        k: Any = [[f, 0.0, width_px / 2], [0.0, f, height_px / 2], [0.0, 0.0, 1.0]]
        k, pose = cameras[name] if cameras else (k, FACING)
        entry = {"id": name, "width": width_px, "height": height_px}
        entry |= {"K": np.array(k).tolist(), "world_to_camera": np.array(pose).tolist()}
        posed[name] = checked(CameraEntry, entry, f"cameras: {name}").posed()
    return _Arrays(
        folder=folder,
        pattern="",
        colour_space="lin_rec709",
        black_level=0.0,
        light_ids=tuple(f"L{number:04d}" for number in range(len(units))),
        directions_world=units,
        intensities=np.ones((len(units), 3)),
        cameras=posed,
        subjects={name: {} for name in subjects},
        provenance={},
        images=people,
    )
