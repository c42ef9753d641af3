"""Prepare one subject of a capture: landmarks, one head fit, crops, OLAT stacks and a contact sheet.

Images are read one at a time, twice: for the fully lit sum that the face is detected in, and for the stack.
At most one camera's sum is in memory. A `Selection` lists the lights and cameras to use; a camera that does
not see the face is also left out.
"""

import logging
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.batch.recipe import Recipe
from facerf_cli.capture.capture import Capture
from facerf_cli.capture.findings import Selection
from facerf_cli.dataset.dataset import CameraRecord, DatasetFolder, SubjectRecord
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import (
    FaceFit,
    Heads,
    fit_in_crop,
    fit_to_arrays,
    fit_views,
    quality_of,
    save_fit,
)
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import LAYOUT_VERSION, grid_triangles
from facerf_cli.face.view import draw_fit
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import read_document, write_document
from facerf_cli.files.image_metadata import COMPUTER_GRAPHICS_SOURCE_TYPE, Provenance
from facerf_cli.files.olat_stack import StackHeader, write_olat_stack
from facerf_cli.files.sheets import contact_sheet, mark_light
from facerf_cli.files.write import HALF_MAX, write_display
from facerf_cli.image.colour import auto_exposure_ev, to_display
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.portrait.find import choose_face, detect_faces
from facerf_cli.raster.rasterize import front_facing, interpolate, rasterize
from facerf_cli.raster.texture import vertex_normals
from facerf_cli.relighting.models import Networks
from facerf_cli.run.logs import LOGGER_NAME

_TILE_PX = 192
_SHEET_AZEL_DEG = ((0.0, 15.0), (-60.0, 20.0), (60.0, 20.0))  # front, left and right, in camera space
_DIMMEST = 1e-3  # largest radiance under a constant map of 1 below which half floats lose precision
log = logging.getLogger(LOGGER_NAME)


def subject_outputs(capture: Capture, subject: str, dataset: DatasetFolder) -> list[Path]:
    """List all files of a subject, from its record if it has one; the last one is written last."""
    record = dataset.record_path(subject)
    cameras = read_document(record, SubjectRecord, "").cameras if record.exists() else capture.cameras
    paths = [of(subject, camera) for camera in cameras for of in (dataset.stack_path, dataset.fit_path)]
    return [*paths, dataset.sheet_path(subject), record]


@dataclass(frozen=True, eq=False)
class Preparation:
    """Settings that all subjects are prepared with; `networks` find the faces."""

    model: MorphableModel
    networks: Networks
    dataset: DatasetFolder
    crop_px: int | None  # None: by the pixels of the face
    made_from: Recipe  # of `preparation`
    strict: bool = False  # a camera that does not see the face is an error


def prepare_subject(capture: Capture, subject: str, chosen: Selection, how: Preparation) -> SubjectRecord:
    """Write a subject's stacks, fits, sheet and record, and return the record."""
    how.dataset.record_path(subject).unlink(missing_ok=True)
    person = _Subject(capture, subject, chosen.lights, how)
    landmarks = [_find_landmarks(person, camera) for camera in chosen.cameras]
    try:
        posed = [capture.cameras[camera] for camera in chosen.cameras]
        head, errors_iod = fit_views(how.model, posed, landmarks)
    except InputError as error:
        raise InputError(f"{subject}: {error}") from None
    middle_m = head.vertices(how.model)[0].mean(0).numpy()
    person = replace(person, capture=capture.about(middle_m))
    mean_error_iod = float(np.nanmean(errors_iod))
    cameras: dict[str, CameraRecord] = {}
    rows, dropped = [], dict(chosen.dropped)
    for camera, landmarks_px, error_iod in zip(chosen.cameras, landmarks, errors_iod.tolist(), strict=True):
        lost = math.isnan(error_iod)  # landmarks are missing or rejected
        seen_px, error_iod = (None, mean_error_iod) if lost else (landmarks_px, error_iod)
        try:
            fit, off_iod = fit_in_crop(
                how.model, head, capture.cameras[camera], seen_px, error_iod, how.crop_px
            )
            header = _header(person, camera, head, fit)
        except InputError as error:
            dropped[camera] = str(error)
            continue
        rows.append(_write_camera(person, camera, fit, header))
        cameras[camera] = CameraRecord(
            face_found=seen_px is not None,
            error_iod=round(fit.error_iod, 5),
            quality=fit.quality,
            crop_px=fit.crop.size_px,
            crop_off_iod=round(off_iod, 5),
        )
    chosen = replace(chosen, dropped=dropped)
    _remove_dropped(subject, chosen, how, bool(cameras))
    sheet = contact_sheet(np.concatenate(rows), len(rows[0]))
    write_display(how.dataset.sheet_path(subject), sheet, metadata=person.provenance())
    record = SubjectRecord(
        prepared=how.made_from,
        error_iod=round(mean_error_iod, 5),
        quality=quality_of(mean_error_iod),
        faces_found=sum(entry.face_found for entry in cameras.values()),
        cameras=cameras,
        dropped=chosen.dropped,
        missing=list(chosen.missing),
        lights=[capture.light_ids[light] for light in chosen.lights] if chosen.left_out else None,
        left_out=chosen.left_out,
        ambient_kept=_ambient_kept(person, chosen.cameras),
    )
    write_document(how.dataset.record_path(subject), record.model_dump(exclude_defaults=True))
    return record


def prepared_subjects(capture: Capture, dataset: DatasetFolder) -> dict[str, SubjectRecord]:
    """Read the records of the finished subjects, by subject."""
    return {
        subject: read_document(dataset.record_path(subject), SubjectRecord, "")
        for subject in capture.subjects
        if all(path.exists() for path in subject_outputs(capture, subject, dataset))
    }


@dataclass(frozen=True, eq=False)
class _Subject:
    """Subject of a capture, and the lights of their stacks (indices into the capture's)."""

    capture: Capture
    name: str
    lights: tuple[int, ...]
    how: Preparation

    @property
    def directions_world(self) -> np.ndarray:
        """Unit vectors [L, 3] toward the lights."""
        return self.capture.directions_world[list(self.lights)]

    def provenance(self, *camera: str) -> dict[str, str | int]:
        """Return metadata for files made from their images, marked as synthetic if the capture is."""
        synthetic = self.capture.provenance.get("synthetic") is True
        source_type = COMPUTER_GRAPHICS_SOURCE_TYPE if synthetic else ""
        name = "/".join([self.name, *camera])
        return Provenance(name, **self.how.model.stamp, source_type=source_type).attributes()


def _remove_dropped(subject: str, chosen: Selection, how: Preparation, any_left: bool) -> None:
    """Log what is left out and delete its files of an earlier run; raise InputError if not allowed."""
    if chosen.dropped and (how.strict or not any_left):
        reasons = "; ".join(f"{camera}: {why}" for camera, why in chosen.dropped.items())
        advice = "without --strict the other cameras are used" if any_left else "no camera is left"
        raise InputError(f"{subject}: {reasons}; {advice}")
    if words := chosen.in_words():
        log.warning("%s: %s", subject, words)
    for camera in chosen.dropped:
        how.dataset.stack_path(subject, camera).unlink(missing_ok=True)
        how.dataset.fit_path(subject, camera).unlink(missing_ok=True)


def _ambient_kept(person: _Subject, cameras: Iterable[str]) -> list[str]:
    """List cameras whose ambient image should be subtracted but is missing, and log a warning."""
    if not person.capture.subtract_ambient:
        return []
    without = [camera for camera in cameras if person.capture.ambient(person.name, camera) is None]
    if without:
        words = "no ambient image of the camera's size; nothing is subtracted"
        log.warning("%s/%s: %s", person.name, ", ".join(without), words)
    return without


def _find_landmarks(person: _Subject, camera: str) -> np.ndarray | None:
    """Detect landmarks [68, 2] in the fully lit sum, in the camera's pixels; None without a face."""
    weights = constant_weights(person.directions_world)
    posed = person.capture.cameras[camera]
    lit = np.zeros((posed.height_px, posed.width_px, 3), np.float32)
    for light, weight in zip(person.lights, weights, strict=True):
        lit += weight * person.capture.frame(person.name, camera, light)
    faces = detect_faces(person.how.networks.people, to_display(lit))
    return choose_face(faces, "largest", camera)[0].landmarks_px if faces else None


def constant_weights(directions: np.ndarray) -> np.ndarray:
    """Return weights [L] of lights [L, 3] under a constant map of radiance 1: their solid angles / pi."""
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
    """Make the header of a stack of images [S, S, 3] in a fit's crop, for camera-space lights [L, 3].

    `source` [S, S, 3] is the crop under a constant map of radiance 1; `inside` [S, S] is true where the crop
    lies in the photo. The mask `seen` is 1 where the front of the fitted mesh covers these pixels.
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


def _header(person: _Subject, camera: str, head: Heads, fit: FaceFit) -> StackHeader:
    """Make the header of a camera's stack with a black source; raise InputError where it sees no face."""
    posed = person.capture.cameras[camera]
    # World to crop through the head, so that lights rotate with the normals.
    world_to_crop = fit.rotation.double() @ head.rotation[0].mT
    directions = person.directions_world @ world_to_crop.numpy().T
    source = np.zeros((fit.crop.size_px, fit.crop.size_px, 3), np.float32)
    inside = fit.crop.valid(posed.height_px, posed.width_px)
    header = stack_header(person.how.model, fit, directions, source, inside, person.provenance(camera))
    if not header.seen.any():
        raise InputError("the camera does not see the face")
    complete = len(person.lights) == len(person.capture.light_ids)
    return header if complete else replace(header, rig_lights=person.lights)


def _write_camera(person: _Subject, camera: str, fit: FaceFit, header: StackHeader) -> np.ndarray:
    """Write a camera's stack and fit; return its tiles [6, h, w, 3] of the sheet."""
    sheet_images: dict[int, np.ndarray] = dict.fromkeys(sheet_lights(header.directions), header.source)
    crops = _crops(person, camera, fit.crop, header, sheet_images)
    write_olat_stack(person.how.dataset.stack_path(person.name, camera), header, crops)
    with atomic_path(person.how.dataset.fit_path(person.name, camera)) as temporary:
        save_fit(temporary, fit, header.metadata)
    return sheet_tiles(header, fit, person.how.model, sheet_images)


def _crops(
    person: _Subject, camera: str, crop: Crop, header: StackHeader, sheet_images: dict[int, np.ndarray]
) -> Iterator[Tensor]:
    """Yield a camera's images in the crop [1, 3, S, S]; fill the lights that `sheet_images` lists.

    The header's source accumulates on the way; `write_olat_stack` writes it last. Values below the black
    level become 0 only here, after the crop has averaged their noise.
    """
    clipped = 0
    for place, weight in enumerate(constant_weights(header.directions)):
        image = np.maximum(crop.apply(person.capture.frame(person.name, camera, person.lights[place])), 0)
        clipped += int((image > HALF_MAX).any(-1).sum())
        image = np.minimum(image, HALF_MAX)
        np.add(header.source, weight * image, out=header.source)
        if place in sheet_images:
            sheet_images[place] = image
        yield torch.from_numpy(image).permute(2, 0, 1)[None]
    # Under a constant map of 1 a face is below 1; warn about values outside the range of half floats.
    name, lit = f"{person.name}/{camera}", float(header.source.max())
    np.minimum(header.source, HALF_MAX, out=header.source)
    if clipped:
        advice = "the lights' intensities in stage.json are too small"
        log.warning("%s: %d pixels are above %g and were clipped; %s", name, clipped, HALF_MAX, advice)
    elif lit < _DIMMEST:
        advice = "the lights' intensities in stage.json are too large"
        log.warning("%s: a constant map of radiance 1 gives radiance %.2g at most; %s", name, lit, advice)


def sheet_lights(directions: np.ndarray) -> list[int]:
    """Return indices of the sheet's three lights, nearest to front, left and right; directions [L, 3]."""
    wanted = np.stack([azel_to_direction(*azel).numpy() for azel in _SHEET_AZEL_DEG])
    return (wanted @ directions.T).argmax(1).tolist()


def sheet_tiles(
    header: StackHeader, fit: FaceFit, model: MorphableModel, images: Mapping[int, np.ndarray]
) -> np.ndarray:
    """Draw the tiles of one camera [6, h, w, 3]: fully lit, with the fit, masked, and three single lights.

    They are scene-linear, exposed for display; the three lights share one exposure.
    """
    side_px = fit.crop.size_px
    lit = header.source * np.float32(2 ** auto_exposure_ev(header.source))
    overlay = draw_fit(header.source, replace(fit, crop=Crop(0.0, 0.0, float(side_px), side_px)), model)
    masked = lit * (0.1 + 0.9 * header.seen[..., None])
    single = np.stack([images[light] for light in sheet_lights(header.directions)])
    single *= np.float32(2 ** auto_exposure_ev(single.reshape(-1, side_px, 3)))
    small = Crop(0.0, 0.0, float(side_px), _TILE_PX)  # crops of a subject may differ in size
    tiles = np.stack([small.apply(tile.clip(0, 1)) for tile in (lit, overlay, masked, *single)])
    for tile, light in zip(tiles[3:], sheet_lights(header.directions), strict=True):
        mark_light(tile, header.directions[light], 1.0)
    return tiles
