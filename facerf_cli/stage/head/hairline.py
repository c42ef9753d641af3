"""Where hair grows on the scalp: above a hairline that differs from head to head."""

import numpy as np

from facerf_cli.face.topology import BOTTOM_M, HALF_ANGLE_DEG, TOP_M
from facerf_cli.stage.head.hair_styles import HairStyle

# The hairline: height in metres at an azimuth in degrees from the nose, on both sides. `forehead` and
# `recession` are added to the first ones; the ear lies between 75 and 100 degrees.
_LINE_DEG = (0, 20, 36, 46, 54, 60, 64, 67, 72, 75, 85, 95, 103, 112, 130, 150, 180)
_LINE_M = (0, 0.001, 0.004, -0.003, -0.022, -0.040, -0.058, -0.076, -0.078)
_LINE_EAR_M = (0.046, 0.048, 0.043, 0.022, -0.018, -0.052, -0.066, -0.068)
_RECEDES = (0.0, 0.35, 1.0, 1.0, 0.6, 0.3, 0.1, 0, 0)  # share of `recession` at the first azimuths
_MEAN_FOREHEAD_M = 0.096


def scalp_margin_m(points: np.ndarray, style: HairStyle) -> np.ndarray:
    """How far [...] above the style's hairline points [..., 3] of the skin lie, in metres of height."""
    azimuth = np.abs(np.degrees(np.arctan2(points[..., 0], points[..., 2])))
    first = np.array(_LINE_M) + style.forehead_mm / 1000 + np.array(_RECEDES) * style.recession_mm / 1000
    fixed = np.array(_LINE_M) + _MEAN_FOREHEAD_M  # temples and sideburns stay where they are
    first = np.where(np.array(_LINE_DEG[: len(first)]) > 50, fixed, first)
    return points[..., 1] - np.interp(azimuth, _LINE_DEG, [*first, *_LINE_EAR_M])


def scalp_cover(uv: np.ndarray, style: HairStyle) -> np.ndarray:
    """Share [...] in 0..1 of the skin at extended chart (u, v) [..., 2] that hair grows on.

    A skin picture stained with it hides the scalp that shows between the wisps.
    """
    azimuth = np.radians((uv[..., 0] - 0.5) * 2 * HALF_ANGLE_DEG)
    y = TOP_M - uv[..., 1] * (TOP_M - BOTTOM_M)
    points = np.stack([np.sin(azimuth), y, np.cos(azimuth)], -1)
    cover = np.clip(scalp_margin_m(points, style) / 0.008 + 0.3, 0, 1) * (style.wisps > 0)
    return cover * np.where(np.abs(azimuth) < np.pi, 1 - 0.7 * style.thinning * (y > 0.1), 0)
