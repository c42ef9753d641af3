"""Confidence in a photo: how sure facerf is that what it makes of it will be good."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from facerf_cli.face.topology import OUTER_EYE_CORNERS
from facerf_cli.portrait.classes import class_index
from facerf_cli.portrait.find import FoundBox, FoundFace

Word = Literal["sure", "unsure", "doubtful"]
_SURE, _UNSURE = 0.6, 0.35  # least scores of the words
_SMALL_PX, _LARGE_PX = 40.0, 160.0  # extents of a face that is too small, and large enough
_NARROW, _FRONTAL = 0.15, 0.4  # distance of the eyes over the face's extent, in profile and from the front
_OFF = 0.05  # expected error of the landmarks, in extents, at which they are worthless
_BLURRED, _SHARP = 0.12, 0.24  # sharpness of a face without detail, and with enough of it
SUPPORTED_YAW_DEG, _LOST_YAW_DEG = 45.0, 75.0  # turn of a head that the fit supports, and that it loses
_COVERING = ("glasses", "hand", "headwear")


@dataclass(frozen=True)
class Confidence:
    """A score in 0..1, a product of factors by name; `word` and `reason` say it in words."""

    factors: dict[str, float]

    @property
    def score(self) -> float:
        """The score."""
        return float(np.prod(list(self.factors.values())))

    @property
    def word(self) -> Word:
        """The score in one word."""
        return "sure" if self.score >= _SURE else "unsure" if self.score >= _UNSURE else "doubtful"

    @property
    def reason(self) -> str:
        """The factor that weighs most."""
        return min(self.factors, key=lambda name: self.factors[name])


def confidence_in(face: FoundFace | FoundBox, yaw_deg: float = 0.0) -> Confidence:
    """Rate a face: how sure its landmarks are, its size and sharpness, its turn and what covers it.

    `yaw_deg` is the turn of the head that was fitted to it.
    """
    seen, extent_px = face.seen, face.seen.extent_px
    left, right = seen.landmarks_px[list(OUTER_EYE_CORNERS)]
    eyes = float(np.linalg.norm(right - left)) / max(extent_px, 1e-6)
    middle = seen.classes[:, seen.classes.shape[1] // 4 : -(seen.classes.shape[1] // 4)]
    middle = middle[..., middle.shape[-1] // 4 : -(middle.shape[-1] // 4)]
    covered = float(middle[[class_index(name) for name in _COVERING]].sum(0).mean())
    return Confidence(
        {
            "unclear": seen.presence * _ramp(seen.relative_error, _OFF, 0.3 * _OFF),
            "small": _ramp(extent_px, _SMALL_PX, _LARGE_PX),
            "blurred": _ramp(seen.sharpness, _BLURRED, _SHARP),
            "profile": _ramp(eyes, _NARROW, _FRONTAL),
            "covered": _ramp(covered, 0.6, 0.1),
            "turned": _ramp(abs(yaw_deg), _LOST_YAW_DEG, SUPPORTED_YAW_DEG),
        }
    )


def _ramp(value: float, worst: float, best: float) -> float:
    """From 0.1 at the worst value to 1 at the best."""
    return 0.1 + 0.9 * float(np.clip((value - worst) / (best - worst), 0, 1))
