"""Classes of what a photo of a synthetic person shows, and the class of each vertex of the skin."""

import numpy as np

from facerf_cli.face.topology import BOTTOM_M, HALF_ANGLE_DEG, LANDMARK_UV, TOP_M, inside_mm
from facerf_cli.portrait.classes import class_index
from facerf_cli.synth.head.cranium import average_head_mm

CLASS_OF_PART = {
    "skin": "skin",
    "eye": "eyes",
    "mouth": "mouth",
    "teeth": "mouth",
    "cloth": "garment",
    "hair": "hair",
    "frame": "glasses",
    "hat": "headwear",
}
# Lower edge of the face on the mean head: height in metres at an azimuth in degrees, the same on both sides.
# It follows the jaw to the lobe of the ear, then the nape below the hair.
_JAW_DEG = (0, 15, 27, 38, 50, 65, 80, 95, 110, 180)
_JAW_M = (-0.0755, -0.072, -0.064, -0.053, -0.046, -0.042, -0.041, -0.046, -0.05, -0.058)
# The ear on the mean head juts out from it, between these azimuths and heights.
_EAR_DEG, _EAR_M, _EAR_OUT_MM = (66.0, 125.0), (-0.045, 0.06), 4.0
_MARGIN_UV = 0.02  # around the landmarks, within which features of the face are looked for


def part_class(part: str) -> int:
    """Class that all of a part has, unless its builder says otherwise."""
    return class_index(CLASS_OF_PART[part])


def skin_classes(uv: np.ndarray) -> np.ndarray:
    """Classes [V] uint8 of skin at (u, v) [V, 2] of the continued UV map; ears: see `ears_of`."""
    classes = np.full(len(uv), class_index("skin"), np.uint8)
    azimuth_deg, height_m = _place(uv)
    classes[height_m < np.interp(np.abs(azimuth_deg), _JAW_DEG, _JAW_M)] = class_index("neck")
    low, high = LANDMARK_UV[17:].min(0) - _MARGIN_UV, LANDMARK_UV[17:].max(0) + _MARGIN_UV
    central = np.flatnonzero(((uv > low) & (uv < high)).all(-1))
    left = uv[central].copy()
    left[:, 0] = np.minimum(left[:, 0], 1 - left[:, 0])
    classes[central[inside_mm("brows", left) > 0]] = class_index("brows")
    classes[central[inside_mm("lips", uv[central]) > 0]] = class_index("lips")
    return classes


def ears_of(mean_m: np.ndarray) -> np.ndarray:
    """[V] bool: the ears of a mean head [V, 3], where it juts out."""
    azimuth_deg, height_m = np.degrees(np.arctan2(mean_m[:, 0], mean_m[:, 2])), mean_m[:, 1]
    around = np.abs(azimuth_deg)
    near = (around > _EAR_DEG[0]) & (around < _EAR_DEG[1])
    near &= (height_m > _EAR_M[0]) & (height_m < _EAR_M[1])
    smooth = average_head_mm(
        0.5 + azimuth_deg / (2 * HALF_ANGLE_DEG), (TOP_M - height_m) / (TOP_M - BOTTOM_M)
    )
    out_mm = 1000 * np.hypot(mean_m[:, 0], mean_m[:, 2]) - np.hypot(smooth[:, 0], smooth[:, 2])
    found: np.ndarray = near & (out_mm > _EAR_OUT_MM)
    return found


def _place(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth in degrees and height in metres [V] of places of the UV map on the mean head."""
    return (uv[:, 0] - 0.5) * 2 * HALF_ANGLE_DEG, TOP_M - uv[:, 1] * (TOP_M - BOTTOM_M)
