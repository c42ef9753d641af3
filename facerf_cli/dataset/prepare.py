"""A dataset's OLAT stacks: what goes into one beside its lights' pictures.

From a capture to prepared data, a subject at a time: landmarks, one head, crops, OLAT stacks, a sheet.

Pictures are read one by one, twice: once for the fully lit sum that the face is found on, once for the stack.
Never more than one camera's sum is held. What goes in is a `Selection`; a camera that turns out not to see
the face is left out, too.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.select import Selection
from facerf_cli.dataset.dataset import fit_path, record_path, sheet_path, stack_path
from facerf_cli.dataset.pages import lights_shown, sheet_tiles
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit, fit_to_arrays, quality_of, save_fit
from facerf_cli.face.joint_fit import JointFit, fit_in_crop, fit_views
from facerf_cli.face.landmarks import choose_face, detect_landmarks, to_display
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import LAYOUT_VERSION, grid_triangles
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import read_document, write_document
from facerf_cli.files.drawings import contact_sheet
from facerf_cli.files.images import HALF_MAX, write_display
from facerf_cli.files.olat_stack import StackHeader, write_olat_stack
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.logs import COMPUTER_GRAPHICS_SOURCE_TYPE, LOGGER_NAME, Provenance
from facerf_cli.raster.rasterize import front_facing, interpolate, rasterize
from facerf_cli.raster.texture import vertex_normals


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


_DIMMEST = 1e-3  # what a picture under a constant map of radiance 1 may be; halves hold little below
log = logging.getLogger(LOGGER_NAME)


def subject_outputs(capture: Capture, subject: str, folder: Path) -> list[Path]:
    """All files of a subject, by its record if it has one; the last of them is written last."""
    record = record_path(folder, subject)
    cameras = read_document(record, "")["cameras"].table() if record.exists() else capture.cameras
    paths = [place(folder, subject, camera) for camera in cameras for place in (stack_path, fit_path)]
    return [*paths, sheet_path(folder, subject), record]


def prepare_subject(
    capture: Capture,
    subject: str,
    chosen: Selection,
    model: MorphableModel,
    folder: Path,
    crop_px: int,
    key: str,
    strict: bool = False,
) -> dict[str, Any]:
    """Write a subject's stacks, fits, sheet and record; give the record. `key` is of `preparation_key`.

    With `strict` a camera that does not see the face is an error.
    """
    record_path(folder, subject).unlink(missing_ok=True)
    view = _Subject(capture, subject, chosen.lights, model)
    landmarks = [_find_landmarks(view, camera) for camera in chosen.cameras]
    with _concerning(subject):
        joint = fit_views(model, [capture.cameras[camera] for camera in chosen.cameras], landmarks)
    cameras, rows, dropped = {}, [], dict(chosen.dropped)
    for camera, landmarks_px, error_iod in zip(chosen.cameras, landmarks, joint.error_iod, strict=True):
        seen_px = None if error_iod is None else landmarks_px  # lost ones are as good as none
        error_iod = joint.mean_error_iod if error_iod is None else error_iod
        try:
            fit, off_iod = fit_in_crop(model, joint, capture.cameras[camera], seen_px, error_iod, crop_px)
            header = _header(view, camera, joint, fit)
        except InputError as error:
            dropped[camera] = str(error)
            continue
        rows.append(_write_camera(view, camera, fit, header, folder))
        cameras[camera] = _camera_record(fit, seen_px is not None, off_iod)
    chosen = replace(chosen, dropped=dropped)
    _settle_dropped(subject, chosen, folder, bool(cameras), strict)
    sheet = contact_sheet(np.concatenate(rows), len(rows[0]))
    write_display(sheet_path(folder, subject), sheet, metadata=view.provenance())
    record = {
        "prepared": key,
        "error_iod": round(joint.mean_error_iod, 5),
        "quality": quality_of(joint.mean_error_iod),
        "faces_found": sum(entry["face_found"] is True for entry in cameras.values()),
        "cameras": cameras,
        **_record_besides(view, chosen),
    }
    write_document(record_path(folder, subject), record)
    return record


def _camera_record(fit: FaceFit, face_found: bool, off_iod: float) -> dict[str, Any]:
    """What a record says of a camera."""
    return {
        "face_found": face_found,
        "error_iod": round(fit.error_iod, 5),
        "quality": fit.quality,
        "crop_off_iod": round(off_iod, 5),
    }


@dataclass(frozen=True, eq=False)
class _Subject:
    """Whom the work is about, the lights of their stacks (places in the capture's), and the face model."""

    capture: Capture
    name: str
    lights: tuple[int, ...]
    model: MorphableModel

    @property
    def directions_world(self) -> np.ndarray:
        """Toward the lights [L, 3]."""
        return self.capture.directions_world[list(self.lights)]

    def provenance(self, *camera: str) -> dict[str, str | int]:
        """Metadata of what is made of their pictures; synthetic where the capture says that it is."""
        synthetic = self.capture.provenance.get("synthetic") is True
        source_type = COMPUTER_GRAPHICS_SOURCE_TYPE if synthetic else ""
        name = "/".join([self.name, *camera])
        return Provenance(name, **self.model.stamp, source_type=source_type).attributes()


def _settle_dropped(subject: str, chosen: Selection, folder: Path, any_left: bool, strict: bool) -> None:
    """Say what is left out, and remove what an earlier run wrote of it; raise where that cannot be."""
    if chosen.dropped and (strict or not any_left):
        reasons = "; ".join(f"{camera}: {why}" for camera, why in chosen.dropped.items())
        advice = "without --strict the others would do" if any_left else "no camera is left"
        raise InputError(f"{subject}: {reasons}; {advice}")
    if words := chosen.in_words():
        log.warning("%s: %s", subject, words)
    for camera in chosen.dropped:
        stack_path(folder, subject, camera).unlink(missing_ok=True)
        fit_path(folder, subject, camera).unlink(missing_ok=True)


def _record_besides(view: _Subject, chosen: Selection) -> dict[str, Any]:
    """What a record says besides: the lights there are (ids) and what is lacking, moved or not subtracted."""
    capture = view.capture
    entries: dict[str, Any] = {"dropped": chosen.dropped, "missing": list(chosen.missing)}
    if chosen.left_out:
        entries |= {"lights": [capture.light_ids[light] for light in chosen.lights]}
        entries |= {"left_out": chosen.left_out}
    entries |= {"shifts_px": {"/".join(key[1:]): list(by) for key, by in capture.shifts.items()}}
    entries |= {"ambient_kept": _ambient_kept(view, chosen.cameras)}
    return {name: entry for name, entry in entries.items() if entry}


def _ambient_kept(view: _Subject, cameras: Iterable[str]) -> list[str]:
    """The cameras, with a warning, whose ambient picture should be subtracted but is not there."""
    if not view.capture.subtract_ambient:
        return []
    without = [camera for camera in cameras if view.capture.ambient(view.name, camera) is None]
    if without:
        words = "no ambient picture of the camera's size; nothing is subtracted"
        log.warning("%s/%s: %s", view.name, ", ".join(without), words)
    return without


@contextmanager
def _concerning(name: str) -> Iterator[None]:
    """Say of whom an error within the block speaks."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _find_landmarks(view: _Subject, camera: str) -> np.ndarray | None:
    """Landmarks [68, 2] on the fully lit sum, in the camera's pixels; None where there is no face."""
    weights = constant_weights(view.directions_world)
    posed = view.capture.cameras[camera]
    lit = np.zeros((posed.height_px, posed.width_px, 3), np.float32)
    for light, weight in zip(view.lights, weights, strict=True):
        lit += weight * view.capture.frame(view.name, camera, light)
    faces = detect_landmarks(to_display(lit))
    return choose_face(faces, "largest", camera)[0].landmarks_px if faces else None


def _header(view: _Subject, camera: str, joint: JointFit, fit: FaceFit) -> StackHeader:
    """The header of a camera's stack, its source still black; an InputError where it sees no face."""
    posed = view.capture.cameras[camera]
    # Through the head, so that lights turn with the normals.
    world_to_crop = fit.rotation.double() @ joint.rotation.mT
    directions = view.directions_world @ world_to_crop.numpy().T
    source = np.zeros((fit.crop.size_px, fit.crop.size_px, 3), np.float32)
    inside = fit.crop.valid(posed.height_px, posed.width_px)
    header = stack_header(view.model, fit, directions, source, inside, view.provenance(camera))
    if not header.seen.any():
        raise InputError("the camera does not see the face")
    complete = len(view.lights) == len(view.capture.light_ids)
    return header if complete else replace(header, rig_lights=view.lights)


def _write_camera(view: _Subject, camera: str, fit: FaceFit, header: StackHeader, folder: Path) -> np.ndarray:
    """Write a camera's stack and fit; give its tiles [6, h, w, 3] of the sheet."""
    shown: dict[int, np.ndarray] = dict.fromkeys(lights_shown(header.directions), header.source)
    crops = _crops(view, camera, fit.crop, header, shown)
    write_olat_stack(stack_path(folder, view.name, camera), header, crops)
    with atomic_path(fit_path(folder, view.name, camera)) as temporary:
        save_fit(temporary, fit, header.metadata)
    return sheet_tiles(header, fit, view.model, shown)


def _crops(
    view: _Subject, camera: str, crop: Crop, header: StackHeader, shown: dict[int, np.ndarray]
) -> Iterator[Tensor]:
    """A camera's pictures in the crop [1, 3, S, S], one by one; `shown` keeps those whose places it has.

    The header's source fills up on the way; `write_olat_stack` writes it last. Only here, where the crop has
    averaged noise, do values below the black level become 0.
    """
    clipped = 0
    for place, weight in enumerate(constant_weights(header.directions)):
        image = np.maximum(crop.apply(view.capture.frame(view.name, camera, view.lights[place])), 0)
        np.add(header.source, weight * image, out=header.source)
        if place in shown:
            shown[place] = image
        clipped += int((image > HALF_MAX).any(-1).sum())
        yield torch.from_numpy(image).permute(2, 0, 1)[None]
    _say_what_halves_lose(f"{view.name}/{camera}", clipped, float(header.source.max()))


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
