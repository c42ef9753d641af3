"""Captures of light stages on disk, read into one form: lamps, calibrated cameras, linear pictures.

`stage.json` (layout 'stage') lies beside the pictures and says what they are:

    {"format": "facerf-stage-1", "axes": "opencv", "unit": "m",
     "colour_space": "lin_rec709", "black_level": 0.0,
     "pattern": "{subject}/{camera}/{light}.exr",
     "lights": [{"id": "L000", "direction": [x, y, z], "intensity": [r, g, b]}],
     "cameras": [{"id": "C0", "width": 256, "height": 256, "K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
                  "world_to_camera": 3 x 4 or 4 x 4}],
     "subjects": {"0000": {traits}}, "provenance": {...}}

Directions are unit vectors of the world toward the light. K is in pixels whose centres lie at index + 0.5.
world_to_camera has OpenCV's axes (y down, z forward); it becomes DESIGN's (y up, z toward the camera) here
and nowhere else. Intensities are linear Rec.709 in DESIGN's unit of light; the black level is linear too.
Without `subjects` whoever has pictures is one. "ambient": "{subject}/{camera}/ambient.exr", which may be
missing, names pictures without any lamp; --subtract-ambient takes them away in the black level's place.
A pattern names {camera} unless there is one camera alone, and {subject} unless `subjects` is of one alone.

Layout 'extended-yale-b': `yale_layout.py`.
"""

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from facerf_cli.colour import named_space
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.joint_fit import PosedCamera
from facerf_cli.files.images import PHOTO_LIMIT_PX, read_image
from facerf_cli.stage.chart.correction import ChartCorrection, corrected
from facerf_cli.stage.data.documents import Node, read_document, unique_ids
from facerf_cli.stage.data.moved import moved

STAGE_FILE, STAGE_FORMAT = "stage.json", "facerf-stage-1"
MOST_LIGHTS, MOST_CAMERAS, MOST_SUBJECTS = 4096, 256, 100_000
FIELDS = ("subject", "camera", "light")  # of a pattern
_LONGEST_SIDE_PX = 65_536
_ORTHONORMAL_OFF = 1e-3
_LEAST_INTENSITY = 1e-12  # what is less is no light, and 0 in float32 before long
_ASPECT_OFF = 0.01  # of fx from fy: a face crop has square pixels
_OPENCV_TO_OURS = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture in DESIGN's axes and units; `pattern` holds {subject}, {camera} and {light}."""

    folder: Path
    pattern: str
    colour_space: str
    black_level: float
    light_ids: tuple[str, ...]
    directions_world: np.ndarray  # [L, 3] unit, toward the lights
    intensities: np.ndarray  # [L, 3] positive
    cameras: dict[str, PosedCamera]
    subjects: dict[str, dict[str, Any]]  # traits by subject, sorted
    provenance: dict[str, Any]
    ambient_pattern: str = (
        ""  # of pictures without any lamp, with {subject} and {camera}; empty: there are none
    )
    subtract_ambient: bool = False
    marked: Mapping[str, frozenset[str]] = field(default_factory=dict)  # ids of lights that it gives up
    align: bool = False  # head motion is to be undone: `shifts` are to be found for each subject
    charts: tuple[ChartCorrection, ...] = ()  # what photographed colour charts say of the cameras
    # Pixels down and right that take a frame back to where the head was, by subject, camera and light.
    shifts: Mapping[tuple[str, str, str], tuple[float, float]] = field(default_factory=dict)

    def frame_path(self, subject: str, camera: str, light: str) -> Path:
        """The picture of a subject seen by a camera under one light."""
        return self.folder / _filled(self.pattern, subject=subject, camera=camera, light=light)

    def frame(self, subject: str, camera: str, light: int) -> np.ndarray:
        """That picture [H, W, 3] under a light of rgb 1, linear Rec.709, float32, by its camera's chart.

        Values that are NaN or infinite count as 0, with a warning. What noise or a wide gamut brings below
        the black level stays negative here, so that sums are not biased.
        """
        path = self.frame_path(subject, camera, self.light_ids[light])
        pixels = read_picture(path, self.colour_space)
        posed = self.cameras[camera]
        if pixels.shape[:2] != (posed.height_px, posed.width_px):
            raise InputError(
                f"{path}: {pixels.shape[1]} x {pixels.shape[0]} pixels; camera {camera} has "
                f"{posed.width_px} x {posed.height_px}"
            )
        ambient = self.ambient(subject, camera) if self.subtract_ambient else None
        dark = np.float32(self.black_level) if ambient is None else ambient
        shift_px = self.shifts.get((subject, camera, self.light_ids[light]), (0.0, 0.0))
        lit = (pixels - dark) / self.intensities[light].astype(np.float32)
        return moved(corrected(self.charts, camera, lit), *shift_px)

    def ambient(self, subject: str, camera: str) -> np.ndarray | None:
        """A subject without any lamp [H, W, 3], black level included; None where none has the right size."""
        path = self.folder / _filled(self.ambient_pattern, subject=subject, camera=camera)
        pixels = _read_ambient(path, self.colour_space) if self.ambient_pattern and path.is_file() else None
        posed = self.cameras[camera]
        return pixels if pixels is not None and pixels.shape == (posed.height_px, posed.width_px, 3) else None


def read_capture(
    folder: Path, layout: str = "stage", subtract_ambient: bool = False, align: bool = False
) -> Capture:
    """Read a capture's description in one of `LAYOUTS`; no pictures yet."""
    if layout not in LAYOUTS:
        raise UsageError(f"--layout {layout}: not known; there is {', '.join(sorted(LAYOUTS))}")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    capture = LAYOUTS[layout](folder)
    if subtract_ambient and not capture.ambient_pattern:
        raise UsageError(f"--subtract-ambient: {folder / STAGE_FILE} names no 'ambient' pictures")
    return replace(capture, subtract_ambient=subtract_ambient, align=align)


def read_picture(path: Path, colour_space: str) -> np.ndarray:
    """A picture [H, W, 3], its colour multiplied by its alpha."""
    picture = read_image(path, colour_space, non_finite="zero")
    return picture.pixels if picture.alpha is None else picture.pixels * picture.alpha[..., None]


_read_ambient = lru_cache(maxsize=2)(read_picture)  # one a camera, and every frame needs it


def _read_stage(folder: Path) -> Capture:
    root = read_document(folder / STAGE_FILE, "--describe drafts one from the pictures")
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
            {name: {} for name in _found_subjects(folder, pattern, camera_ids, light_ids)}
            if subjects is None
            else {name: node.table() for name, node in sorted(subjects.entries(MOST_SUBJECTS).items())}
        ),
        provenance={} if (node := root.get("provenance")) is None else node.table(),
        ambient_pattern=(
            "" if (node := root.get("ambient")) is None else require_pattern(node, needed, FIELDS[:2])
        ),
    )


def _require_filled(root: Node) -> None:
    """Raise where something is null, as in a draft of --describe; traits and provenance may be."""
    said = (root[key] for key in root.table() if key not in ("subjects", "provenance"))
    if gaps := [gap for node in said for gap in node.nulls()]:
        more = f" (and {len(gaps) - 1} more)" if len(gaps) > 1 else ""
        raise InputError(f"{gaps[0].where} is null; fill it in{more}")


def _read_yale(folder: Path) -> Capture:
    from facerf_cli.stage.data.yale_layout import read_yale_capture  # it makes captures, too

    return read_yale_capture(folder)


LAYOUTS: dict[str, Callable[[Path], Capture]] = {"stage": _read_stage, "extended-yale-b": _read_yale}


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
        raise light["intensity"].wrong(f"light in every channel (lamp {name} cannot be divided out)")
    return intensity


def _camera(node: Node) -> PosedCamera:
    width, height = (node[key].whole(1, _LONGEST_SIDE_PX) for key in ("width", "height"))
    if width * height > PHOTO_LIMIT_PX:
        raise node["width"].wrong(f"a picture of at most {PHOTO_LIMIT_PX // 1_000_000} megapixels")
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
    """Rotation [3, 3], the nearest to what is written, and translation [3]."""
    rows = len(node.value) if isinstance(node.value, list) else 0
    matrix = node.array(4 if rows == 4 else 3, 4)
    if rows == 4 and not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise node.wrong("0 0 0 1 in the last row")
    u, stretch, vh = np.linalg.svd(matrix[:3, :3])
    if not np.abs(stretch - 1).max() < _ORTHONORMAL_OFF or np.linalg.det(u @ vh) < 0:
        raise node.wrong("a rotation without stretch or reflection, and a translation in metres")
    return u @ vh, matrix[:3, 3]


def _needed_fields(camera_ids: list[str], subjects: Node | None) -> set[str]:
    """What a pattern must name: there may be one camera alone, or one subject alone."""
    alone = {"camera": len(camera_ids) == 1, "subject": subjects is not None and len(subjects.table()) == 1}
    return {field for field in FIELDS if not alone.get(field)}


def require_pattern(node: Node, needed: Collection[str], fields: tuple[str, ...] = FIELDS) -> str:
    """A relative path that names the needed of `fields`, and leads nowhere else; an InputError otherwise."""
    pattern = node.text()
    parts = pattern.split("/")
    plain = re.sub(rf"\{{({'|'.join(fields)})\}}", "", pattern)
    words = [f"{{{field}}}" for field in fields if field in needed]
    if (
        any(word not in pattern for word in words)
        or not plain.isprintable()
        or re.search(r"[{}\\:*?]", plain)
        or any(part in ("", ".", "..") for part in parts)
        or len(pattern) > 500
    ):
        raise node.wrong(f"a path below the capture{' that names ' * bool(words)}{' and '.join(words)}")
    return pattern


def _filled(pattern: str, **names: str) -> str:
    for word, name in names.items():
        pattern = pattern.replace(f"{{{word}}}", name)
    return pattern


def _found_subjects(folder: Path, pattern: str, cameras: list[str], lights: list[str]) -> Iterator[str]:
    """Whoever has a picture, in order: the files or folders at the pattern's part that names the subject."""
    parts = pattern.split("/")
    depth = next(index for index, part in enumerate(parts) if "{subject}" in part)
    expression = re.escape("/".join(parts[: depth + 1]))
    for word in FIELDS:
        first, *rest = expression.split(re.escape(f"{{{word}}}"))
        named = [f"(?P<{word}>[^/]+)", *[f"(?P={word})"] * (len(rest) - 1)] if rest else []
        expression = first + "".join(name + part for name, part in zip(named, rest, strict=True))
    above = _filled("/".join([*parts[:depth], "*"]), camera="*", light="*")
    relatives = (path.relative_to(folder).as_posix() for path in folder.glob(above) if path.name[0] != ".")
    matches = (re.fullmatch(expression, relative) for relative in relatives)
    for name in sorted({match["subject"] for match in matches if match}):
        paths = (folder / _filled(pattern, subject=name, camera=c, light=i) for c in cameras for i in lights)
        if any(path.exists() for path in paths):
            yield Node(f"{folder}: a subject", name).name()
