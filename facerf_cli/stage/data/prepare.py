"""From a capture to prepared data, a subject at a time: landmarks, one head, crops, OLAT stacks, a sheet.

Pictures are read one by one, twice: once for the fully lit sum that the face is found on, once for the stack.
Never more than one camera's sum is held.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli import __version__
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop
from facerf_cli.face.crop_pose import fit_in_crop
from facerf_cli.face.fit import FaceFit, quality_of, save_fit
from facerf_cli.face.joint_fit import JointFit, fit_views
from facerf_cli.face.landmarks import choose_face, detect_landmarks, to_display
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.images import HALF_MAX, write_display
from facerf_cli.files.olat_stack import StackHeader, write_olat_stack
from facerf_cli.records import LOGGER_NAME
from facerf_cli.report import contact_sheet
from facerf_cli.stage.data.dataset import fit_path, record_path, sheet_path, stack_path
from facerf_cli.stage.data.documents import read_document, write_document
from facerf_cli.stage.data.layouts import Capture
from facerf_cli.stage.data.sheets import lights_shown, sheet_tiles
from facerf_cli.stage.data.stacks import constant_weights, stack_header

_DIMMEST = 1e-3  # what a picture under a constant map of radiance 1 may be; halves hold little below
log = logging.getLogger(LOGGER_NAME)


def subject_outputs(capture: Capture, subject: str, folder: Path) -> list[Path]:
    """All files of a subject; the last of them is written last."""
    paths = [place(folder, subject, camera) for camera in capture.cameras for place in (stack_path, fit_path)]
    return [*paths, sheet_path(folder, subject), record_path(folder, subject)]


def prepare_subject(
    capture: Capture, subject: str, model: MorphableModel, folder: Path, crop_px: int, key: str
) -> dict[str, Any]:
    """Write a subject's stacks, fits, sheet and record; give the record. `key` is of `preparation_key`."""
    record_path(folder, subject).unlink(missing_ok=True)
    landmarks = [_find_landmarks(capture, subject, camera) for camera in capture.cameras]
    with _concerning(subject):
        joint = fit_views(model, list(capture.cameras.values()), landmarks)
    cameras, rows = {}, []
    for camera, landmarks_px, error_iod in zip(capture.cameras, landmarks, joint.error_iod, strict=True):
        seen_px = None if error_iod is None else landmarks_px  # lost ones are as good as none
        error_iod = joint.mean_error_iod if error_iod is None else error_iod
        posed = capture.cameras[camera]
        with _concerning(f"{subject}/{camera}"):
            fit, off_iod = fit_in_crop(model, joint, posed, seen_px, error_iod, crop_px)
        rows.append(_write_camera(capture, subject, camera, model, joint, fit, folder))
        cameras[camera] = {
            "face_found": seen_px is not None,
            "error_iod": round(error_iod, 5),
            "quality": fit.quality,
            "crop_off_iod": round(off_iod, 5),
        }
    write_display(sheet_path(folder, subject), contact_sheet(np.concatenate(rows), len(rows[0])))
    record = {
        "prepared": key,
        "error_iod": round(joint.mean_error_iod, 5),
        "quality": quality_of(joint.mean_error_iod),
        "faces_found": sum(entry["face_found"] is True for entry in cameras.values()),
        "cameras": cameras,
    }
    write_document(record_path(folder, subject), record)
    return record


@contextmanager
def _concerning(name: str) -> Iterator[None]:
    """Say of whom an error within the block speaks."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _find_landmarks(capture: Capture, subject: str, camera: str) -> np.ndarray | None:
    """Landmarks [68, 2] on the fully lit sum, in the camera's pixels; None where there is no face."""
    weights = constant_weights(capture.directions_world)
    posed = capture.cameras[camera]
    lit = np.zeros((posed.height_px, posed.width_px, 3), np.float32)
    for light, weight in enumerate(weights):
        lit += weight * capture.frame(subject, camera, light)
    faces = detect_landmarks(to_display(lit))
    return choose_face(faces, "largest", camera)[0].landmarks_px if faces else None


def _write_camera(
    capture: Capture,
    subject: str,
    camera: str,
    model: MorphableModel,
    joint: JointFit,
    fit: FaceFit,
    folder: Path,
) -> np.ndarray:
    """Write a camera's stack and fit; give its tiles [6, h, w, 3] of the sheet."""
    posed = capture.cameras[camera]
    # Through the head, so that lights turn with the normals.
    world_to_crop = fit.rotation.double() @ joint.rotation.mT
    directions = capture.directions_world @ world_to_crop.numpy().T
    source = np.zeros((fit.crop.size_px, fit.crop.size_px, 3), np.float32)
    inside = fit.crop.valid(posed.height_px, posed.width_px)
    metadata = {
        "Software": f"facerf {__version__}",
        "facerf:version": __version__,
        "facerf:input": f"{subject}/{camera}",
        "facerf:face_model": model.name,
        "facerf:face_model_licence": model.licence,
    }
    header = stack_header(model, fit, directions, source, inside, metadata)
    if not header.seen.any():
        raise InputError(f"{subject}/{camera}: the camera does not see the face; take it out of stage.json")
    shown: dict[int, np.ndarray] = dict.fromkeys(lights_shown(directions), source)
    crops = _crops(capture, subject, camera, fit.crop, header, shown)
    write_olat_stack(stack_path(folder, subject, camera), header, crops)
    with atomic_path(fit_path(folder, subject, camera)) as temporary:
        save_fit(temporary, fit)
    return sheet_tiles(header, fit, model, shown)


def _crops(
    capture: Capture, subject: str, camera: str, crop: Crop, header: StackHeader, shown: dict[int, np.ndarray]
) -> Iterator[Tensor]:
    """A camera's pictures in the crop [1, 3, S, S], one by one; `shown` keeps those whose numbers it has.

    The header's source fills up on the way; `write_olat_stack` writes it last. Only here, where the crop has
    averaged noise, do values below the black level become 0.
    """
    clipped = 0
    for light, weight in enumerate(constant_weights(header.directions)):
        picture = np.maximum(crop.apply(capture.frame(subject, camera, light)), 0)
        np.add(header.source, weight * picture, out=header.source)
        if light in shown:
            shown[light] = picture
        clipped += int((picture > HALF_MAX).any(-1).sum())
        yield torch.from_numpy(picture).permute(2, 0, 1)[None]
    _say_what_halves_lose(f"{subject}/{camera}", clipped, float(header.source.max()))


def _say_what_halves_lose(name: str, clipped: int, lit: float) -> None:
    """Warn of intensities that are far from DESIGN's unit: a face under a constant map of 1 is below 1."""
    if clipped:
        advice = "the lamps' intensities in stage.json are too small for these pictures"
        log.warning("%s: %d pixels are beyond %g and were clipped; %s", name, clipped, HALF_MAX, advice)
    elif lit < _DIMMEST:
        advice = "the lamps' intensities in stage.json are too large for these pictures"
        log.warning("%s: a map of radiance 1 would light it to %.2g at most; %s", name, lit, advice)


def prepared_subjects(capture: Capture, folder: Path) -> dict[str, dict[str, Any]]:
    """The records of the subjects that are finished, by subject; 'prepared' is the key they were given."""
    return {
        subject: read_document(record_path(folder, subject), "").table()
        for subject in capture.subjects
        if all(path.exists() for path in subject_outputs(capture, subject, folder))
    }
