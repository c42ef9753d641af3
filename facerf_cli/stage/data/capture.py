"""A capture of a light stage on disk: lamps, calibrated cameras, and its pictures in linear light."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.joint_fit import PosedCamera
from facerf_cli.files.images import read_image
from facerf_cli.stage.chart.correction import ChartCorrection, corrected
from facerf_cli.stage.data.moved import moved
from facerf_cli.stage.data.patterns import filled


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
        path = self.folder / filled(self.ambient_pattern, subject=subject, camera=camera)
        pixels = _read_ambient(path, self.colour_space) if self.ambient_pattern and path.is_file() else None
        posed = self.cameras[camera]
        return pixels if pixels is not None and pixels.shape == (posed.height_px, posed.width_px, 3) else None


def read_picture(path: Path, colour_space: str) -> np.ndarray:
    """A picture [H, W, 3], its colour multiplied by its alpha."""
    picture = read_image(path, colour_space, non_finite="zero")
    return picture.pixels if picture.alpha is None else picture.pixels * picture.alpha[..., None]


_read_ambient = lru_cache(maxsize=2)(read_picture)  # one a camera, and every frame needs it
