"""Reader for `stage.json`, which describes a capture and lies next to its images.

    {"format": "facerf-stage-1", "axes": "opencv", "unit": "m",
     "colour_space": "linear", "black_level": 0.0,
     "pattern": "{subject}/{camera}/{light}.exr",
     "lights": [{"id": "L000", "direction": [x, y, z] or "position": [x, y, z], "intensity": [r, g, b]}],
     "cameras": [{"id": "C0", "width": 256, "height": 256, "K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
                  "world_to_camera": 3 x 4 or 4 x 4}],
     "subjects": {"0000": {traits}}, "provenance": {...}}

Directions are unit vectors in world space toward the light. K is in pixels whose centres lie at index + 0.5.
world_to_camera has OpenCV's axes (y down, z forward); only this file converts it to the axes of the package
(y up, z toward the camera). Intensities are linear Rec.709: under a light of rgb 1, a white surface facing it
has radiance 1. The black level is also linear.

Reading a frame removes the camera's optional "distortion", OpenCV's k1, k2, p1, p2 and k3. A single camera
without a pose defines the world: x right, y up, z toward the camera.

A light with a position, in metres in the world, is near: its direction depends on the fitted head, and its
intensity, stated for "centre" (by default the world's origin), on the square of the distance. "colour_matrix"
[3, 3] applies to linear values without the black level, which may differ between channels. "exposure_stops"
{subject: stops} states which frames are brighter.

Without `subjects`, every name that the pattern finds on disk is a subject. "ambient", for example
"{subject}/{camera}/ambient.exr", is optional: images without any light, which --subtract-ambient subtracts
instead of the black level. A pattern may omit {camera} if there is one camera, and {subject} if `subjects`
lists one.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import AfterValidator, Field, PlainValidator, model_validator

from facerf_cli.capture.capture import (
    FIELDS,
    BlackLevel,
    Capture,
    Coefficients,
    find_subjects,
    folds,
    require_pattern,
)
from facerf_cli.errors import UsageError
from facerf_cli.files.documents import Direction, Document, Matrix3, Name, Three, distinct, read_document
from facerf_cli.image.colour import named_space
from facerf_cli.raster.camera import PosedCamera

STAGE_FORMAT = "facerf-stage-1"
STAGE_FILE = "stage.json"
MOST_LIGHTS, MOST_CAMERAS, MOST_SUBJECTS = 4096, 256, 100_000
_LONGEST_SIDE_PX = 65_536
_ORTHONORMAL_OFF = 1e-3  # deviation of singular values from 1, in rotations written with few digits
_LEAST_INTENSITY = 1e-12  # frames are divided by it, in float32
_NEAREST_M, _MOST_STOPS = 0.05, 20.0  # distance of a near light from the centre; a subject's exposure
_MOST_BLACK = 1e12
_ASPECT_OFF = 0.01  # deviation of fx / fy from 1, because a face crop has square pixels
# Pose of a camera whose space (y up, z toward the camera) is the world, in OpenCV's axes (y down, z forward).
FACING = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
_OPENCV_TO_OURS = np.diag([1.0, -1.0, -1.0])


def _colour_space(name: str) -> str:
    try:
        named_space(name)
    except UsageError as error:
        raise ValueError(str(error)) from None
    return name


def _intensity(rgb: np.ndarray) -> np.ndarray:
    if not (rgb > _LEAST_INTENSITY).all():
        raise ValueError("use a positive value in every channel (frames are divided by it)")
    return rgb


def _black_level(value: Any) -> BlackLevel:
    levels = value if isinstance(value, list) else [value]
    numbers = [level for level in levels if isinstance(level, int | float) and abs(level) <= _MOST_BLACK]
    if len(levels) not in (1, 3) or len(numbers) != len(levels) or isinstance(value, bool):
        raise ValueError("use a number, or one for each of three channels")
    return (float(levels[0]), float(levels[1]), float(levels[2])) if len(levels) == 3 else float(levels[0])


def _nowhere() -> np.ndarray:
    return np.full(3, np.nan)


def _invertible(matrix: np.ndarray) -> np.ndarray:
    if np.linalg.matrix_rank(matrix) < 3:
        raise ValueError("use an invertible matrix")
    return matrix


def _intrinsics(k: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
    if not (min(fx, fy) > 0 and np.allclose(k, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], atol=1e-6 * fx)):
        raise ValueError("use [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0")
    if abs(fx / fy - 1) > _ASPECT_OFF:
        raise ValueError("use fx within 1 % of fy (square pixels)")
    return k


def _pose(value: Any) -> tuple[np.ndarray, np.ndarray]:
    """Parse 3 x 4 or 4 x 4 numbers; return the nearest rotation [3, 3] and the translation [3]."""
    try:
        matrix = np.array(value, np.float64)
    except (ValueError, TypeError):
        matrix = np.zeros(())
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise ValueError("use 3 x 4 finite numbers")
    if len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise ValueError("use 0 0 0 1 in the last row")
    u, stretch, vh = np.linalg.svd(matrix[:3, :3])
    if not np.abs(stretch - 1).max() < _ORTHONORMAL_OFF or np.linalg.det(u @ vh) < 0:
        raise ValueError("use a rotation without scale or reflection, and a translation in metres")
    return u @ vh, matrix[:3, 3]


def _coefficients(value: Any) -> Coefficients:
    try:
        numbers = tuple(float(number) for number in value)
    except (ValueError, TypeError):
        numbers = ()
    if len(numbers) not in (4, 5) or not np.isfinite(numbers).all():
        raise ValueError("use k1, k2, p1, p2, k3 of OpenCV; undistort images of other lenses first")
    return numbers


Side = Annotated[int, Field(ge=1, le=_LONGEST_SIDE_PX)]


class LightEntry(Document):
    """Light of the stage: a far light has a direction, a near one a position."""

    id: Name
    direction: Direction = Field(default_factory=_nowhere)
    position: Three = Field(default_factory=_nowhere)
    intensity: Annotated[Three, AfterValidator(_intensity)]

    @model_validator(mode="after")
    def _is_somewhere(self) -> "LightEntry":
        if np.isnan(self.direction[0]) == np.isnan(self.position[0]):
            raise ValueError("use either 'direction' or 'position'")
        return self


class CameraEntry(Document):
    """Calibrated camera with OpenCV's axes."""

    id: Name
    width: Side
    height: Side
    K: Annotated[Matrix3, AfterValidator(_intrinsics)]
    world_to_camera: Annotated[tuple[np.ndarray, np.ndarray], PlainValidator(_pose)] = _pose(FACING)
    distortion: Annotated[Coefficients, PlainValidator(_coefficients)] = ()

    @model_validator(mode="after")
    def _can_be_undistorted(self) -> "CameraEntry":
        if self.distortion and folds(self.posed(), self.distortion):
            raise ValueError("distortion folds the image within the frame; check its order k1 k2 p1 p2 k3")
        return self

    def posed(self) -> PosedCamera:
        """Return the camera with the axes of the package."""
        rotation, translation_m = self.world_to_camera
        return PosedCamera(
            focal_px=(float(self.K[0, 0]), float(self.K[1, 1])),
            centre_px=(float(self.K[0, 2]), float(self.K[1, 2])),
            width_px=self.width,
            height_px=self.height,
            rotation=torch.from_numpy(_OPENCV_TO_OURS @ rotation),
            translation_m=torch.from_numpy(_OPENCV_TO_OURS @ translation_m),
        )


class StageDocument(Document):
    format: Literal["facerf-stage-1"]
    axes: Literal["opencv"]
    unit: Literal["m"]
    colour_space: Annotated[str, AfterValidator(_colour_space)]
    black_level: Annotated[BlackLevel, PlainValidator(_black_level)]
    colour_matrix: Annotated[Matrix3, AfterValidator(_invertible)] | None = None
    centre: Three = Field(default_factory=lambda: np.zeros(3))
    exposure_stops: dict[Name, Annotated[float, Field(ge=-_MOST_STOPS, le=_MOST_STOPS)]] = Field(
        default_factory=dict
    )
    pattern: str
    lights: Annotated[list[LightEntry], Field(min_length=1, max_length=MOST_LIGHTS)]
    cameras: Annotated[list[CameraEntry], Field(min_length=1, max_length=MOST_CAMERAS)]
    subjects: Annotated[dict[Name, dict[str, Any]], Field(max_length=MOST_SUBJECTS)] | None = None
    ambient: str | None = None
    provenance: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _is_consistent(self) -> "StageDocument":
        distinct([light.id for light in self.lights], "the light")
        distinct([camera.id for camera in self.cameras], "the camera")
        for light in self.lights:
            if np.linalg.norm(light.position - self.centre) < _NEAREST_M:
                raise ValueError(f"light {light.id} is at the centre; use a position in metres")
        if unknown := sorted(self.exposure_stops.keys() - (self.subjects or self.exposure_stops).keys()):
            raise ValueError(f"exposure_stops: no subject {unknown[0]}; correct the name")
        unposed = [camera.id for camera in self.cameras if "world_to_camera" not in camera.model_fields_set]
        if len(self.cameras) > 1 and unposed:
            raise ValueError(f"camera {unposed[0]} has no 'world_to_camera'; only a single camera needs none")
        return self


def read_stage(folder: Path) -> Capture:
    """Read the capture described by a folder's `stage.json`; InputError names the first invalid entry."""
    path = folder / STAGE_FILE
    stage = read_document(path, StageDocument, "--describe drafts one from the images")
    single = {"camera": len(stage.cameras) == 1, "subject": len(stage.subjects or ()) == 1}
    needed = {field for field in FIELDS if not single.get(field)}  # in a pattern
    pattern = require_pattern(stage.pattern, f"{path}: pattern", needed)
    light_ids, camera_ids = ([entry.id for entry in entries] for entries in (stage.lights, stage.cameras))
    positions = np.stack([light.position for light in stage.lights])
    capture = Capture(
        folder=folder,
        pattern=pattern,
        colour_space=stage.colour_space,
        black_level=stage.black_level,
        light_ids=tuple(light_ids),
        directions_world=np.stack([light.direction for light in stage.lights]),
        intensities=np.stack([light.intensity for light in stage.lights]),
        cameras={camera.id: camera.posed() for camera in stage.cameras},
        distortion={camera.id: camera.distortion for camera in stage.cameras if any(camera.distortion)},
        subjects=(
            {name: {} for name in find_subjects(folder, pattern, camera_ids, light_ids)}
            if stage.subjects is None
            else dict(sorted(stage.subjects.items()))
        ),
        provenance=stage.provenance,
        ambient_pattern=(
            require_pattern(stage.ambient, f"{path}: ambient", needed, FIELDS[:2]) if stage.ambient else ""
        ),
        colour_matrix=stage.colour_matrix,
        positions_m=None if np.isnan(positions).all() else positions,
        centre_m=stage.centre,
        stops=stage.exposure_stops,
    )
    return capture.about(stage.centre)
