"""What a photographed colour chart says of a camera's colours, and how a frame is corrected by it."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class ChartCorrection:
    """A matrix for the frames of some cameras, and what is known of it; settings that processes share."""

    image: Path
    image_sha256: str
    cameras: tuple[str, ...]
    corners_px: Rows  # [4, 2] of the patches' area, clockwise from the dark skin's
    matrix: Rows  # [3, 3] on linear Rec.709 under a light of rgb 1; keeps the luminance of neutral colours
    delta_e_before: tuple[float, float]  # CIE 2000, mean and largest of the 24 patches
    delta_e_after: tuple[float, float]
    light_span: float  # of the light over the chart, brightest over darkest; it was taken off
    overlay: str  # name of its picture for people, in a dataset

    def record(self) -> dict[str, Any]:
        """What `dataset.json` says of it."""
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
        """One line for a person."""
        (mean_before, max_before), (mean, most) = self.delta_e_before, self.delta_e_after
        return (
            f"{self.image}: colour chart of {', '.join(self.cameras)}: CIE delta E 2000 mean {mean:.1f}, "
            f"max {most:.1f} (before: {mean_before:.1f}, {max_before:.1f})"
        )


def corrected(charts: Iterable[ChartCorrection], camera: str, linear: np.ndarray) -> np.ndarray:
    """A camera's picture [H, W, 3] by its chart, if it has one; linear Rec.709, float32."""
    for chart in charts:
        if camera in chart.cameras:
            return linear @ np.array(chart.matrix, np.float32).T
    return linear
