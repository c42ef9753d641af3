"""Colour correction of a camera's frames by a photographed colour chart."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class ChartCorrection:
    """Colour matrix of some cameras, and how it was found; plain values that processes can share."""

    image: Path
    image_sha256: str
    cameras: tuple[str, ...]
    corners_px: Rows  # [4, 2] of the patches' area, clockwise from the dark skin patch
    matrix: Rows  # [3, 3] on linear Rec.709 under a light of rgb 1; keeps the luminance of neutral colours
    delta_e_before: tuple[float, float]  # CIE 2000, mean and largest of the 24 patches
    delta_e_after: tuple[float, float]
    light_span: float  # brightest over darkest light on the chart; the fit removes this falloff
    overlay: str  # file name of the control image in a dataset

    def record(self) -> dict[str, Any]:
        """Entry of the correction in `dataset.json`."""
        return {
            "picture": self.image.name,
            "picture_sha256": self.image_sha256,
            "cameras": list(self.cameras),
            "corners_px": [list(corner) for corner in self.corners_px],
            "matrix": [list(row) for row in self.matrix],
            "delta_e_2000": {
                "before": dict(zip(("mean", "max"), self.delta_e_before, strict=True)),
                "after": dict(zip(("mean", "max"), self.delta_e_after, strict=True)),
            },
            "light_span": self.light_span,
            "overlay": self.overlay,
        }

    def in_words(self) -> str:
        """Log line with the colour errors before and after."""
        (mean_before, max_before), (mean, most) = self.delta_e_before, self.delta_e_after
        return (
            f"{self.image}: colour chart of {', '.join(self.cameras)}: CIE delta E 2000 mean {mean:.1f}, "
            f"max {most:.1f} (before: {mean_before:.1f}, {max_before:.1f})"
        )


def correct_colours(charts: Iterable[ChartCorrection], camera: str, linear: np.ndarray) -> np.ndarray:
    """Apply the matrix of a camera's chart to a frame [H, W, 3], linear Rec.709, float32; if it has one."""
    for chart in charts:
        if camera in chart.cameras:
            return linear @ np.array(chart.matrix, np.float32).T
    return linear
