"""A picture moved by parts of pixels: how a head that moved between frames is taken back.

Where a capture's pictures are: a path with {subject}, {camera} and {light} in it.

A capture of a light stage on disk: lamps, calibrated cameras, and its pictures in linear light.
"""

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.capture.colour_correction import ChartCorrection, corrected
from facerf_cli.errors import InputError
from facerf_cli.face.joint_fit import PosedCamera
from facerf_cli.files.documents import Node
from facerf_cli.files.images import read_image


def moved(image: np.ndarray, down_px: float, right_px: float) -> np.ndarray:
    """The picture [H, W, C] moved down and right, its border repeated; whole shifts are exact.

    Between pixels by cubic convolution (R. Keys, *Cubic convolution interpolation for digital image
    processing*, ASSP 1981), which keeps detail that straight lines between pixels lose.
    """
    return _along(_along(image, 0, down_px), 1, right_px)


def _along(image: np.ndarray, axis: int, by_px: float) -> np.ndarray:
    if by_px == 0:
        return image
    first = int(np.floor(-by_px))
    places = np.arange(image.shape[axis]) + first
    summed = np.zeros_like(image)
    for tap, weight in enumerate(_keys(-by_px - first), start=-1):
        if weight:
            at = np.clip(places + tap, 0, image.shape[axis] - 1)
            summed += image.dtype.type(weight) * image.take(at, axis)
    return summed


def _keys(t: float) -> tuple[float, float, float, float]:
    """Weights of the pixels at -1, 0, 1 and 2 for a place t past 0, in 0..1 (there, equation 15)."""
    return (
        -t * (1 - t) ** 2 / 2,
        1 - (5 - 3 * t) * t**2 / 2,
        t * (1 + 4 * t - 3 * t**2) / 2,
        -(t**2) * (1 - t) / 2,
    )


FIELDS = ("subject", "camera", "light")
_ODD = r"{}\:*?"  # what stands for other things in patterns, or in no file's name


def require_pattern(node: Node, needed: Collection[str], fields: tuple[str, ...] = FIELDS) -> str:
    """A relative path that names the needed of `fields`, and leads nowhere else; an InputError otherwise."""
    pattern = node.text()
    parts = pattern.split("/")
    plain = re.sub(rf"\{{({'|'.join(fields)})\}}", "", pattern)
    words = [f"{{{field}}}" for field in fields if field in needed]
    odd = sorted({letter for letter in plain if letter in _ODD or not letter.isprintable()})
    if (
        odd
        or any(word not in pattern for word in words)
        or any(part in ("", ".", "..") for part in parts)
        or len(pattern) > 500
    ):
        named = " that names " * bool(words) + " and ".join(words)
        free = f", without {' '.join(map(ascii, odd))} elsewhere," * bool(odd)
        raise node.wrong(f"a path below the capture{named}{free}")
    return pattern


def filled(pattern: str, **names: str) -> str:
    """A pattern with names in the fields' places."""
    for word, name in names.items():
        pattern = pattern.replace(f"{{{word}}}", name)
    return pattern


def found_subjects(folder: Path, pattern: str, cameras: list[str], lights: list[str]) -> Iterator[str]:
    """Whoever has a picture, in order: the files or folders at the pattern's part that names the subject."""
    parts = pattern.split("/")
    depth = next(index for index, part in enumerate(parts) if "{subject}" in part)
    expression = re.escape("/".join(parts[: depth + 1]))
    for word in FIELDS:
        first, *rest = expression.split(re.escape(f"{{{word}}}"))
        named = [f"(?P<{word}>[^/]+)", *[f"(?P={word})"] * (len(rest) - 1)] if rest else []
        expression = first + "".join(name + part for name, part in zip(named, rest, strict=True))
    above = filled("/".join([*parts[:depth], "*"]), camera="*", light="*")
    relatives = (path.relative_to(folder).as_posix() for path in folder.glob(above) if path.name[0] != ".")
    matches = (re.fullmatch(expression, relative) for relative in relatives)
    for name in sorted({match["subject"] for match in matches if match}):
        paths = (folder / filled(pattern, subject=name, camera=c, light=i) for c in cameras for i in lights)
        if any(path.exists() for path in paths):
            yield Node(f"{folder}: a subject", name).name()


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
        return self.folder / filled(self.pattern, subject=subject, camera=camera, light=light)

    def frame(self, subject: str, camera: str, light: int) -> np.ndarray:
        """That picture [H, W, 3] under a light of rgb 1, linear Rec.709, float32, by its camera's chart.

        Values that are NaN or infinite count as 0, with a warning. What noise or a wide gamut brings below
        the black level stays negative here, so that sums are not biased.
        """
        path = self.frame_path(subject, camera, self.light_ids[light])
        pixels = read_frame(path, self.colour_space)
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
        path = self.folder / filled(self.ambient_pattern, subject=subject, camera=camera)
        pixels = _read_ambient(path, self.colour_space) if self.ambient_pattern and path.is_file() else None
        posed = self.cameras[camera]
        return pixels if pixels is not None and pixels.shape == (posed.height_px, posed.width_px, 3) else None


def read_frame(path: Path, colour_space: str) -> np.ndarray:
    """A picture [H, W, 3], its colour multiplied by its alpha."""
    image = read_image(path, colour_space, non_finite="zero")
    return image.pixels if image.alpha is None else image.pixels * image.alpha[..., None]


_read_ambient = lru_cache(maxsize=2)(read_frame)  # one a camera, and every frame needs it
