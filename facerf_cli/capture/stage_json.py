"""Reader of `stage.json`, the description of a capture that stands next to its images.

    {"format": "facerf-stage-1", "axes": "opencv", "unit": "m",
     "colour_space": "lin_rec709", "black_level": 0.0,
     "pattern": "{subject}/{camera}/{light}.exr",
     "lights": [{"id": "L000", "direction": [x, y, z], "intensity": [r, g, b]}],
     "cameras": [{"id": "C0", "width": 256, "height": 256, "K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
                  "world_to_camera": 3 x 4 or 4 x 4}],
     "subjects": {"0000": {traits}}, "provenance": {...}}

Directions are unit vectors in world space toward the light. K is in pixels whose centres lie at index + 0.5.
world_to_camera has OpenCV's axes (y down, z forward); only this file converts it to the axes of the package
(y up, z toward the camera). Intensities are linear Rec.709: a light of rgb 1 gives a white surface that faces
it radiance 1. The black level is linear too.

Without `subjects`, every name that the pattern finds on disk is a subject. "ambient", for example
"{subject}/{camera}/ambient.exr", is optional: images without any light, which --subtract-ambient subtracts in
place of the black level. A pattern may lack {camera} if there is one camera, and {subject} if `subjects`
lists one.
"""

from pathlib import Path

import numpy as np
import torch

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.pattern import FIELDS, find_subjects, require_pattern
from facerf_cli.colour import named_space
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.joint_fit import PosedCamera
from facerf_cli.files.documents import Node, read_document, unique_ids
from facerf_cli.files.images import PHOTO_LIMIT_PX

STAGE_FILE, STAGE_FORMAT = "stage.json", "facerf-stage-1"
MOST_LIGHTS, MOST_CAMERAS, MOST_SUBJECTS = 4096, 256, 100_000
_LONGEST_SIDE_PX = 65_536
_ORTHONORMAL_OFF = 1e-3  # of a singular value from 1, in rotations written with few digits
_LEAST_INTENSITY = 1e-12  # frames are divided by it, in float32
_ASPECT_OFF = 0.01  # of fx / fy from 1: a face crop has square pixels
_OPENCV_TO_OURS = np.diag([1.0, -1.0, -1.0])


def read_stage(folder: Path) -> Capture:
    """Read the capture that `stage.json` in a folder describes; InputError names the first wrong entry."""
    root = read_document(folder / STAGE_FILE, "--describe drafts one from the images")
    _require_filled(root)
    for key, value in (("format", STAGE_FORMAT), ("axes", "opencv"), ("unit", "m")):
        if root[key].value != value:
            raise root[key].wrong(f"'{value}'")
    lights, cameras = root["lights"].items(MOST_LIGHTS), root["cameras"].items(MOST_CAMERAS)
    for key, nodes in (("lights", lights), ("cameras", cameras)):
        if not nodes:
            raise root[key].wrong("one entry at least")
    light_ids, camera_ids = unique_ids(lights), unique_ids(cameras)
    subjects = root.get("subjects")
    needed = _needed_fields(camera_ids, subjects)
    pattern = require_pattern(root["pattern"], needed)
    return Capture(
        folder=folder,
        pattern=pattern,
        colour_space=_colour_space(root["colour_space"]),
        black_level=float(root["black_level"].array()),
        light_ids=tuple(light_ids),
        directions_world=np.stack([node["direction"].unit() for node in lights]),
        intensities=np.stack([_intensity(node) for node in lights]),
        cameras={name: _camera(node) for name, node in zip(camera_ids, cameras, strict=True)},
        subjects=(
            {name: {} for name in find_subjects(folder, pattern, camera_ids, light_ids)}
            if subjects is None
            else {name: node.table() for name, node in sorted(subjects.entries(MOST_SUBJECTS).items())}
        ),
        provenance={} if (node := root.get("provenance")) is None else node.table(),
        ambient_pattern=(
            "" if (node := root.get("ambient")) is None else require_pattern(node, needed, FIELDS[:2])
        ),
    )


def _require_filled(root: Node) -> None:
    """Raise for null values, which a draft of --describe has; traits and provenance may hold them."""
    required = (root[key] for key in root.table() if key not in ("subjects", "provenance"))
    if gaps := [gap for node in required for gap in node.nulls()]:
        more = f" (and {len(gaps) - 1} more)" if len(gaps) > 1 else ""
        raise InputError(f"{gaps[0].where} is null; fill it in{more}")


def _colour_space(node: Node) -> str:
    try:
        named_space(node.text())
    except UsageError as error:
        raise InputError(f"{node.where}: {error}") from None
    return node.text()


def _intensity(light: Node) -> np.ndarray:
    intensity = light["intensity"].array(3)
    if not (intensity > _LEAST_INTENSITY).all():
        name = light["id"].name()
        raise light["intensity"].wrong(
            f"a positive value in every channel (frames of light {name} are divided by it)"
        )
    return intensity


def _camera(node: Node) -> PosedCamera:
    width, height = (node[key].whole(1, _LONGEST_SIDE_PX) for key in ("width", "height"))
    if width * height > PHOTO_LIMIT_PX:
        raise node["width"].wrong(f"an image of at most {PHOTO_LIMIT_PX // 1_000_000} megapixels")
    k = node["K"].array(3, 3)
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
    if not (min(fx, fy) > 0 and np.allclose(k, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], atol=1e-6 * fx)):
        raise node["K"].wrong("[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0")
    if abs(fx / fy - 1) > _ASPECT_OFF:
        raise node["K"].wrong("fx within 1 % of fy (square pixels)")
    rotation, translation_m = _pose(node["world_to_camera"])
    return PosedCamera(
        focal_px=(float(fx), float(fy)),
        centre_px=(float(cx), float(cy)),
        width_px=width,
        height_px=height,
        rotation=torch.from_numpy(_OPENCV_TO_OURS @ rotation),
        translation_m=torch.from_numpy(_OPENCV_TO_OURS @ translation_m),
    )


def _pose(node: Node) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] nearest to the given one, and translation [3]."""
    rows = len(node.value) if isinstance(node.value, list) else 0
    matrix = node.array(4 if rows == 4 else 3, 4)
    if rows == 4 and not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise node.wrong("0 0 0 1 in the last row")
    u, stretch, vh = np.linalg.svd(matrix[:3, :3])
    if not np.abs(stretch - 1).max() < _ORTHONORMAL_OFF or np.linalg.det(u @ vh) < 0:
        raise node.wrong("a rotation without stretch or reflection, and a translation in metres")
    return u @ vh, matrix[:3, 3]


def _needed_fields(camera_ids: list[str], subjects: Node | None) -> set[str]:
    """Fields that a pattern must name: all but those with a single value."""
    single = {"camera": len(camera_ids) == 1, "subject": subjects is not None and len(subjects.table()) == 1}
    return {field for field in FIELDS if not single.get(field)}
