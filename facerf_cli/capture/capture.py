"""Light-stage capture on disk: lights, calibrated cameras, and frames in linear light.

Path patterns name the frames: {subject}, {camera} and {light} stand for parts of their paths. Reading a frame
removes lens distortion, which is given by OpenCV's coefficients.
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.files.documents import is_name
from facerf_cli.files.read import read_image
from facerf_cli.raster.camera import PosedCamera

FIELDS = ("subject", "camera", "light")
_RESERVED = r"{}\:*?"  # wildcards of patterns, and characters that some file systems forbid
_LONGEST = 500
BlackLevel = float | tuple[float, float, float]
Coefficients = tuple[float, ...]  # k1, k2, p1, p2 and optionally k3
_STEPS = 64  # radii at which a lens is examined


@dataclass(frozen=True)
class ChartCorrection:
    """Colour correction of one or more cameras, from a chart's image."""

    image: Path
    # Entry in `dataset.json`: cameras; matrix [3, 3] for linear Rec.709 under a light of rgb 1, which keeps
    # the luminance of neutral colours; corners of the patches' area; CIE delta E 2000 of the 24 patches.
    record: Mapping[str, Any]

    def in_words(self) -> str:
        """Return the log line with the colour errors before and after."""
        before, after = (self.record["delta_e_2000"][when] for when in ("before", "after"))
        return (
            f"{self.image}: colour chart of {', '.join(self.record['cameras'])}: CIE delta E 2000 mean "
            f"{after['mean']:.1f}, max {after['max']:.1f} (before: {before['mean']:.1f}, {before['max']:.1f})"
        )


def correct_colours(charts: Iterable[ChartCorrection], camera: str, linear: np.ndarray) -> np.ndarray:
    """Apply the matrix of a camera's chart, if it has one, to a frame [H, W, 3], linear Rec.709, float32."""
    for chart in charts:
        if camera in chart.record["cameras"]:
            return linear @ np.array(chart.record["matrix"], np.float32).T
    return linear


class FrameSizeError(InputError):
    """A frame's size differs from its camera's."""


@dataclass(frozen=True, eq=False)
class Capture:
    """Description of a capture, axes as in raster/camera.py; no image is read until `frame` is called."""

    folder: Path
    pattern: str  # path of a frame, with {light}, and mostly {subject} and {camera}
    colour_space: str
    black_level: BlackLevel
    light_ids: tuple[str, ...]
    directions_world: np.ndarray  # [L, 3] unit, toward the lights
    intensities: np.ndarray  # [L, 3] positive
    cameras: dict[str, PosedCamera]
    subjects: dict[str, dict[str, Any]]  # traits by subject, sorted
    provenance: dict[str, Any]
    ambient_pattern: str = ""  # of images without any light, with {subject} and {camera}
    subtract_ambient: bool = False
    # Ids of the lights, by subject, whose frames the capture itself declares damaged.
    marked: Mapping[str, frozenset[str]] = field(default_factory=dict)
    distortion: Mapping[str, Coefficients] = field(default_factory=dict)  # by camera
    charts: tuple[ChartCorrection, ...] = ()
    colour_matrix: np.ndarray | None = None  # [3, 3], for linear values without the black level
    positions_m: np.ndarray | None = None  # [L, 3] of near lights, in the world; NaN for far ones
    centre_m: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [3], where intensities are measured
    stops: Mapping[str, float] = field(default_factory=dict)  # extra exposure of a subject's frames

    def frame_path(self, subject: str, camera: str, light: str) -> Path:
        """Return the path of a subject's frame in a camera under one light."""
        return self.folder / self.pattern.format(subject=subject, camera=camera, light=light)

    def has_frame(self, subject: str, camera: str, light: str) -> bool:
        return self.frame_path(subject, camera, light).is_file()

    def frame(self, subject: str, camera: str, light: int) -> np.ndarray:
        """Read a frame [H, W, 3] as under a light of rgb 1, linear Rec.709, float32.

        Applies the colour chart's correction and removes the lens's distortion. NaN and infinite values
        become 0, with a warning. Values below the black level, from noise or a wide gamut, stay negative so
        that sums have no bias. Raises InputError for an unreadable file, FrameSizeError for another size.
        """
        path = self.frame_path(subject, camera, self.light_ids[light])
        pixels = read_frame(path, self.colour_space)
        posed = self.cameras[camera]
        if pixels.shape[:2] != (posed.height_px, posed.width_px):
            raise FrameSizeError(
                f"{path}: {pixels.shape[1]} x {pixels.shape[0]} pixels, but camera {camera} has "
                f"{posed.width_px} x {posed.height_px}; use frames of one size, or correct the camera"
            )
        ambient = self.ambient(subject, camera) if self.subtract_ambient else None
        exposed = np.float32(2.0 ** self.stops.get(subject, 0.0)) * self.intensities[light].astype(np.float32)
        lit = self.without_dark(pixels, ambient) / exposed
        lit = correct_colours(self.charts, camera, lit)
        return undistorted(lit, posed, self.distortion[camera]) if camera in self.distortion else lit

    def without_dark(self, pixels: np.ndarray, ambient: np.ndarray | None = None) -> np.ndarray:
        """Subtract the black level or an ambient image from values [..., 3], and apply `colour_matrix`."""
        linear = pixels - (np.asarray(self.black_level, np.float32) if ambient is None else ambient)
        return linear if self.colour_matrix is None else linear @ self.colour_matrix.T.astype(np.float32)

    def about(self, head_m: np.ndarray) -> "Capture":
        """Return a copy with near lights as received at a point [3] in the world.

        A near light's intensity falls with the square of the distance; its direction is toward the light.
        """
        if self.positions_m is None:
            return self
        near = np.isfinite(self.positions_m).all(1)
        offsets = self.positions_m[near] - head_m
        distances = np.linalg.norm(offsets, axis=1, keepdims=True)
        directions, intensities = self.directions_world.copy(), self.intensities.copy()
        directions[near] = offsets / distances
        measured = np.linalg.norm(self.positions_m[near] - self.centre_m, axis=1, keepdims=True)
        intensities[near] *= (measured / distances) ** 2
        return replace(self, directions_world=directions, intensities=intensities, centre_m=head_m)

    def ambient(self, subject: str, camera: str) -> np.ndarray | None:
        """Read a subject's image without any light [H, W, 3], including the black level.

        Returns None if it does not exist or differs from the camera's size.
        """
        path = self.folder / self.ambient_pattern.format(subject=subject, camera=camera)
        pixels = _read_ambient(path, self.colour_space) if self.ambient_pattern and path.is_file() else None
        posed = self.cameras[camera]
        return pixels if pixels is not None and pixels.shape == (posed.height_px, posed.width_px, 3) else None


def read_frame(path: Path, colour_space: str) -> np.ndarray:
    """Read an image [H, W, 3] in linear Rec.709, multiplied by its alpha."""
    image = read_image(path, colour_space, non_finite="zero")
    return image.pixels if image.alpha is None else image.pixels * image.alpha[..., None]


_read_ambient = lru_cache(maxsize=2)(read_frame)  # shared by all frames of a camera


def require_pattern(
    pattern: str, where: str, needed: Collection[str], fields: tuple[str, ...] = FIELDS
) -> str:
    """Return a pattern if it is a path below the capture's folder that contains the `needed` fields.

    It may contain no braces except for `fields`. Otherwise raises InputError that names `where` it occurs.
    """
    parts = pattern.split("/")
    plain = re.sub(rf"\{{({'|'.join(fields)})\}}", "", pattern)
    words = [f"{{{key}}}" for key in fields if key in needed]
    odd = sorted({letter for letter in plain if letter in _RESERVED or not letter.isprintable()})
    if (
        odd
        or any(word not in pattern for word in words)
        or any(part in ("", ".", "..") for part in parts)
        or len(pattern) > _LONGEST
    ):
        named = " that names " * bool(words) + " and ".join(words)
        free = f", without {' '.join(map(ascii, odd))} elsewhere," * bool(odd)
        raise InputError(f"{where} is {pattern!r}; a path below the capture{named}{free} is needed")
    return pattern


def compile_pattern(pattern: str) -> re.Pattern[str]:
    """Return a regular expression with a group per field; a repeated field must match the same text."""
    expression = re.escape(pattern)
    for key in FIELDS:
        escaped = re.escape(f"{{{key}}}")
        expression = expression.replace(escaped, f"(?P<{key}>[^/]+)", 1).replace(escaped, f"(?P={key})")
    return re.compile(expression)


def find_subjects(folder: Path, pattern: str, cameras: list[str], lights: list[str]) -> Iterator[str]:
    """Yield the sorted names of subjects that have an image, from the part of the paths with {subject}."""
    parts = pattern.split("/")
    depth = next(index for index, part in enumerate(parts) if "{subject}" in part)
    expression = compile_pattern("/".join(parts[: depth + 1]))
    above = "/".join([*parts[:depth], "*"]).format(camera="*", light="*")
    relatives = (path.relative_to(folder).as_posix() for path in folder.glob(above) if path.name[0] != ".")
    matches = (expression.fullmatch(relative) for relative in relatives)
    for name in sorted({match["subject"] for match in matches if match}):
        paths = (folder / pattern.format(subject=name, camera=c, light=i) for c in cameras for i in lights)
        if any(path.exists() for path in paths):
            if not is_name(name):
                raise InputError(f"{folder}: subject {name!r}: use a name of letters, digits, - and _")
            yield name


def distorted(plane: Tensor, coefficients: Coefficients) -> Tensor:
    """Distort points of the plane at depth 1 [..., 2] (x right, y down).

    OpenCV's documentation, 'Camera Calibration and 3D Reconstruction': radial and tangential distortion.
    """
    k1, k2, p1, p2, k3 = (*coefficients, 0.0)[:5]
    x, y = plane.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    aside, down = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return torch.stack([x * radial + aside, y * radial + down], -1)


def folds(camera: PosedCamera, coefficients: Coefficients) -> bool:
    """Return whether the radial distortion is not monotonic within the image, so that it has no inverse."""
    k1, k2, _, _, k3 = (*coefficients, 0.0)[:5]
    corners = torch.tensor([[x, y] for x in (0.0, camera.width_px) for y in (0.0, camera.height_px)])
    r2 = (np.linspace(0, 1, _STEPS) * float(camera.to_plane(corners).norm(dim=-1).max())) ** 2
    return bool((1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) <= 0).any())


def undistorted(image: np.ndarray, camera: PosedCamera, coefficients: Coefficients) -> np.ndarray:
    """Resample an image [H, W, 3] without the camera's distortion; the border is repeated."""
    view = (camera.focal_px, camera.centre_px, camera.width_px, camera.height_px)
    pixels = torch.from_numpy(image).permute(2, 0, 1)[None]
    grid = _grid(*view, coefficients)
    flat = F.grid_sample(pixels, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return np.ascontiguousarray(flat[0].permute(1, 2, 0).numpy())


@lru_cache(maxsize=2)  # all frames of a camera share it
def _grid(
    focal_px: tuple[float, float],
    centre_px: tuple[float, float],
    width_px: int,
    height_px: int,
    coefficients: Coefficients,
) -> Tensor:
    """Return each undistorted pixel's position in the distorted image [1, H, W, 2], for `grid_sample`."""
    focal, centre, size = (
        torch.tensor(pair, dtype=torch.float64) for pair in (focal_px, centre_px, (width_px, height_px))
    )
    rows, columns = torch.meshgrid(torch.arange(height_px) + 0.5, torch.arange(width_px) + 0.5, indexing="ij")
    plane = (torch.stack([columns, rows], -1).double() - centre) / focal
    px = distorted(plane, coefficients) * focal + centre
    return (2 * px / size - 1).float()[None]
