"""A prepared dataset from arrays: people under single lights, seen by one camera or several."""

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
from facerf_cli.files.documents import checked, is_name, write_document
from facerf_cli.files.texts import file_sha256
from facerf_cli.relighting.models import Models

_CAMERA, _FOCAL = "camera", 4.0  # its name, and its focal length in units of the longer side
_UNIT = 1e-3  # a direction's length may differ from 1 by this
People = np.ndarray | Mapping[str, np.ndarray]  # images [L, H, W, 3] of a person, or of each camera


@dataclass(frozen=True, eq=False)
class _Arrays(Capture):
    """A capture whose frames are arrays in memory, [L, H, W, 3] of each subject, or of its cameras."""

    images: Mapping[str, People] = field(default_factory=dict)

    def has_frame(self, subject: str, camera: str, light: str) -> bool:
        """All frames are there."""
        return True

    def frame(self, subject: str, camera: str, light: int) -> np.ndarray:
        """A frame [H, W, 3]; FrameSizeError for one of another size than the first subject's."""
        given = self.images[subject]
        images = given if isinstance(given, np.ndarray) else given[camera]
        pixels = np.asarray(images[light], np.float32)
        posed = self.cameras[camera]
        wanted = (posed.height_px, posed.width_px, 3)
        if pixels.shape != wanted:
            raise FrameSizeError(f"{subject}: images of shape {list(pixels.shape)}, not {list(wanted)}")
        if not np.isfinite(pixels).all():
            raise FrameSizeError(
                f"{subject}: an image holds values that are NaN or infinite; give finite ones"
            )
        return pixels


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
    """Check the images, find and fit each face, and write what `facerf prepare-dataset` writes of a capture.

    Args:
        folder: Of the dataset; it must hold none.
        models: Their networks find the faces; the face model must be the built-in one.
        people: By name, images [L, H, W, 3] of each person under each light alone, scene-linear Rec.709, as
            under lights of rgb 1; with `cameras` such images by camera. A mapping may load each person when
            it is asked.
        directions: Unit vectors [L, 3] toward the lights, in camera space (x right, y up, z to the camera),
            or in the world of `cameras`.
        split: Counts or shares of people for training, validation and test.
        focal_px: Of the camera; by default 4 times the images' longer side.
        crop_px: Side of the crops, a multiple of 8; by default that of the face's pixels.
        seed: Of the split.
        cameras: By name, K [3, 3] in pixels and world_to_camera [3, 4] in metres, with OpenCV's axes, as in
            `stage.json`.
        checks: Check the images as `facerf prepare-dataset` does: frames that are broken are left out.

    Raises UsageError for arguments that do not fit, InputError where a face is not found, or where the
    checks stop a person, as of a mirrored rig.
    """
    folder = Path(folder)
    if (folder / DATASET_FILE).exists():
        raise UsageError(f"{folder}: holds a dataset already; give another folder")
    if models.face.name != BUILTIN:
        raise UsageError(f"models: have the face model {models.face.name}; load them with the built-in one")
    capture = _capture(folder, people, np.asarray(directions, np.float64), focal_px, cameras)
    parts, model, sha256 = Split.parse(split), load_face_model(), file_sha256(BUILTIN_PATH)
    parts.counts(len(capture.subjects))
    made_from = preparation(capture, sha256, crop_px, models.networks.sha256("parsing"))
    how = Preparation(model, models.networks, DatasetFolder(folder), crop_px, made_from)
    records = {}
    for name in capture.subjects:
        findings = check_subject(capture, name) if checks else []
        require_sound(name, findings, strict=False)
        records[name] = prepare_subject(capture, name, select_frames(capture, name, findings), how)
    write_document(folder / DATASET_FILE, describe_dataset(capture, records, parts, seed, model, sha256))
    return read_dataset(folder)


def _capture(
    folder: Path,
    people: Mapping[str, People],
    directions: np.ndarray,
    focal_px: float | None,
    cameras: Mapping[str, tuple[Any, Any]] | None,
) -> _Arrays:
    """Describe arrays as a capture; UsageError for names, shapes or directions that do not fit."""
    if wrong := [name for name in people if not is_name(name)] or ([] if people else ["none"]):
        raise UsageError(f"people: {wrong[0]!r} is no name of letters, digits, - and _")
    if directions.ndim != 2 or directions.shape[1] != 3 or not len(directions):
        raise UsageError(f"directions: have shape {list(directions.shape)}; give [lights, 3]")
    lengths = np.linalg.norm(directions, axis=1)
    if not (np.abs(lengths - 1) < _UNIT).all():
        raise UsageError(
            f"directions: have lengths of {lengths.min():g} to {lengths.max():g}; give unit vectors"
        )
    first = next(iter(people.values()))
    if isinstance(first, np.ndarray) == (cameras is not None) or (cameras and set(first) != set(cameras)):
        raise UsageError("people: give arrays of each person, or with `cameras` one array for each of these")
    posed = {}
    for name in cameras or (_CAMERA,):
        shape = (first if isinstance(first, np.ndarray) else first[name]).shape
        if len(shape) != 4 or shape[0] != len(directions) or shape[3] != 3:
            raise UsageError(
                f"people: images have shape {list(shape)}; give [{len(directions)}, height, width, 3]"
            )
        height_px, width_px = shape[1:3]
        f = focal_px or _FOCAL * max(height_px, width_px)
        k: Any = [[f, 0.0, width_px / 2], [0.0, f, height_px / 2], [0.0, 0.0, 1.0]]
        k, pose = cameras[name] if cameras else (k, FACING)
        entry = {"id": name, "width": width_px, "height": height_px}
        entry |= {"K": np.array(k).tolist(), "world_to_camera": np.array(pose).tolist()}
        try:
            posed[name] = checked(CameraEntry, entry, "cameras").posed()
        except InputError as error:
            raise UsageError(str(error)) from None
    return _Arrays(
        folder=folder,
        pattern="",
        colour_space="lin_rec709",
        black_level=0.0,
        light_ids=tuple(f"L{number:04d}" for number in range(len(directions))),
        directions_world=directions / lengths[:, None],
        intensities=np.ones((len(directions), 3)),
        cameras=posed,
        subjects={name: {} for name in sorted(people)},
        provenance={},
        images=people,
    )
