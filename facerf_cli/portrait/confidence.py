"""Confidence in a person of a photo: cheap measurements, and a rating in words.

Measurements of the face need its view and the photo; that of the matte needs the predictions of each network.
Each measurement becomes a factor in 0..1 by its scale in `SCALES`; the score is the product of the factors.

Landmarks and mattes that a user passes are compared with the networks' predictions (`lie_on_one`,
`check_seen`, `given_matte_facts`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Literal

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.topology import MIRROR_68, OUTER_EYE_CORNERS
from facerf_cli.image.colour import display_ev, to_display
from facerf_cli.portrait.matte import HeadPlace
from facerf_cli.portrait.parse import SquareView, class_index, covering, unit_centres

Word = Literal["sure", "unsure", "doubtful"]

_SURE, _UNSURE = 0.6, 0.35  # least scores of the ratings
_LOSES = 0.9  # a factor below it is a reason
_GRID = 64  # samples along a side of the square around a face
_ON_LINE = 1e-12  # tolerance of rounding, in squared fractions of the square's side
_WHITE = 0.95  # fraction of a photo's brightest value above which a channel is clipped
_NEAR = 1.5  # distance from the head's middle, in its heights, within which all networks are reliable
_SAME = 0.1  # largest median distance of two sets of landmarks of one face, relative to its extent
_OWN_SIZE = 0.05  # tolerance of the scale of landmarks of the photo at its own size
_ELSEWHERE = 0.7  # fraction of background and garment at landmarks that are not on a face
_MASKED = 0.1  # least fraction of the face that a matte of its person covers
# Overlap of a person with a matte: gain by changing a wrong one, over itself and over an all-white one, and
# the least overlap afterwards. Correct mattes, also shrunk, grown or of heads only, gain less than 0.15.
_GAIN, _GAIN_OVER_WHITE, _FITS = 0.17, 0.04, 0.77
_CHANGES = list(product((False, True), repeat=3))  # x and y swapped, then x and y reversed
_CAUSES: dict[tuple[bool, ...], str] = {
    (False, False, False): "the photo had another size",
    (True, False, False): "x and y are swapped",
    (False, True, False): "x counts from the right",
    (False, False, True): "y counts from the bottom",
}
_EXIF = "the photo's EXIF orientation was not applied"
_ADVICE = "use landmarks of the upright photo, [x, y] in its pixels from the top left"


@dataclass(frozen=True)
class Scale:
    """Range of a measurement, from unusable to unimpaired."""

    worst: float
    best: float
    said: str = ""  # wording in messages, if it differs from the name

    def factor(self, value: float) -> float:
        """Return 0.1 for the worst value up to 1 for the best."""
        return 0.1 + 0.9 * float(np.clip((value - self.worst) / (self.best - self.worst), 0, 1))


# Set on the scenes of SETTING in benchmarks/confidence.py, which measures how often the ratings are right.
SCALES = {
    # Landmarks: median of their expected errors, and distance of the mesh from that of the mirrored photo
    # (.007 to .012 for good photos); both relative to the face's extent.
    "unclear": Scale(0.05, 0.018, "unclear features"),
    "unsteady": Scale(0.04, 0.018, "unsure features"),
    # Extent of the face in pixels; its sharpness (`sharpness_of`); distance of the eyes' outer corners over
    # the extent, which is .45 at 45 degrees of yaw, the largest that is supported, and .25 at 67.
    "small": Scale(20.0, 44.0),
    "blurred": Scale(0.1, 0.18),
    "turned": Scale(0.25, 0.45, "turned away"),
    # Fraction of the face that is covered, that lies outside the frame, and that is clipped in two channels;
    # number of its levels of green.
    "covered": Scale(0.4, 0.1),
    "cropped": Scale(0.5, 0.2),
    "overexposed": Scale(1.0, 0.6),
    "dark": Scale(4.0, 14.0),
    # Overlap of the networks' mattes of the person around the head; fraction of the face in a user's matte.
    "disputed": Scale(0.8, 0.9, "unclear outline"),
    "masked": Scale(0.2, 0.7, "the matte covers the face"),
}


@dataclass(frozen=True)
class Confidence:
    """Factors in 0..1 by name, as in `SCALES`, and the rating that follows."""

    factors: dict[str, float]

    @property
    def score(self) -> float:
        return float(np.prod(list(self.factors.values())))

    @property
    def word(self) -> Word:
        return "sure" if self.score >= _SURE else "unsure" if self.score >= _UNSURE else "doubtful"

    @property
    def reasons(self) -> list[str]:
        """Names of the low factors, the lowest first."""
        names = sorted(self.factors, key=lambda name: self.factors[name])
        return [name for name in names if self.factors[name] < _LOSES]


def confidence_of(facts: Mapping[str, float]) -> Confidence:
    """Rate measurements by their scales."""
    return Confidence({name: SCALES[name].factor(value) for name, value in facts.items()})


def face_facts(view: SquareView, photo: np.ndarray) -> dict[str, float]:
    """Measure a face in a scene-linear photo [H, W, 3]."""
    left, right = view.landmarks_px[list(OUTER_EYE_CORNERS)]
    extent_px = max(view.extent_px, 1e-6)
    positions = unit_centres(_GRID).reshape(-1, 2)
    positions = positions[in_hull(positions, view.square.to_unit_square(view.landmarks_px[:68]))]
    columns, rows = np.floor(view.square.to_photo(positions)).astype(int).T
    height, width = photo.shape[:2]
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    right_px, down_px = (positions * view.classes.shape[-1]).astype(int)[inside].T
    pixels = photo[rows[inside], columns[inside]]
    step = max(1, max(height, width) // 512)
    white = _WHITE * float(photo[::step, ::step].max())
    levels = to_display(pixels[None], display_ev(photo))[..., 1]
    return {
        "unclear": view.relative_error,
        "unsteady": view.unsteadiness,
        "small": extent_px,
        "blurred": view.sharpness,
        "turned": float(np.linalg.norm(right - left)) / extent_px,
        "covered": float(covering(view.classes)[down_px, right_px].mean()),
        "cropped": 1 - float(inside.mean()),
        "overexposed": float(((pixels >= white).sum(-1) >= 2).mean()),
        "dark": float(len(np.unique(levels))),
    }


def in_hull(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return which points [N, 2] are in the convex hull of corners [C, 2]: on one side of all its edges."""
    along = corners[:, None] - corners  # [C, C, 2]
    across = np.stack([along[..., 1], -along[..., 0]], -1)
    offset = np.einsum("ijk,jk->ij", across, corners)
    bounds = (across @ corners.T <= offset[..., None] + _ON_LINE).all(-1) & along.any(-1)
    return np.asarray((points @ across[bounds].T <= offset[bounds] + _ON_LINE).all(-1))


def matte_facts(
    anybody: np.ndarray, parsed: np.ndarray, matte: np.ndarray, head: HeadPlace
) -> dict[str, float]:
    """Compare a matte [h, w] with the mattes [h, w] of people of the person and Parsing Networks."""
    near = head.distance(matte.shape) < _NEAR
    pairs = combinations((anybody[near], parsed[near], matte[near]), 2)
    return {"disputed": min(overlap(*pair) for pair in pairs)}


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Return intersection over union of two coverages [...]."""
    return float(np.minimum(one, other).sum() / max(float(np.maximum(one, other).sum()), 1e-6))


def lie_on_one(given_px: np.ndarray, faces: Sequence[np.ndarray], size_px: tuple[int, ...]) -> bool:
    """Return True if landmarks [68, 2] fit one of the faces [68, 2] detected in a photo [H, W].

    Raises InputError, with the likely cause, if they would fit after a change of axes or size.
    """
    if any(_landmarks_apart(given_px, face_px) < _SAME for face_px in faces):
        return True
    causes = [(1.0, "")]
    for face_px, (swapped, *reverse) in product(faces, _CHANGES):
        start = np.array(reverse) * (size_px[1], size_px[0])
        points = given_px[:, :: -1 if swapped else 1] * (1 - 2 * np.array(reverse))
        named = [(_CAUSES.get((swapped, *reverse), _EXIF), points)]
        if sum([swapped, *reverse]) % 2:  # a detector labels left and right in the stored pixels
            named.append((_EXIF, points[MIRROR_68]))
        for cause, ordered in named:
            scale = ((face_px - start) * ordered).sum() / (ordered**2).sum()
            size = f" (they fit {1 / scale:.2f} of the photo's size)" if abs(scale - 1) > _OWN_SIZE else ""
            causes.append((_landmarks_apart(scale * ordered + start, face_px), cause + size))
    misfit, cause = min(causes)
    if misfit < _SAME:
        raise InputError(f"landmarks: they lie off the face; likely cause: {cause}; {_ADVICE}")
    return False


def check_seen(view: SquareView) -> None:
    """Raise InputError if the landmarks of a view clearly lie where no face is visible."""
    classes = view.classes.numpy()
    side = classes.shape[-1]
    x, y = (view.square.to_unit_square(view.landmarks_px[17:68]) * side).astype(int).clip(0, side - 1).T
    if classes[[0, class_index("garment")]][:, y, x].sum(0).mean() > _ELSEWHERE:
        raise InputError(f"landmarks: they lie on background or clothes, not on a face; {_ADVICE}")


def _landmarks_apart(points_px: np.ndarray, face_px: np.ndarray) -> float:
    """Return the median distance of points [68, 2] from a face's landmarks, relative to its extent."""
    return float(np.median(np.linalg.norm(points_px - face_px, axis=-1)) / np.ptp(face_px, axis=0).max())


def given_matte_facts(view: SquareView, matte: np.ndarray) -> dict[str, float]:
    """Compare a user's matte [H, W] with the head that the Parsing Network predicts.

    Raises InputError, with the likely cause, if the matte excludes the face, or fits far better when
    inverted, mirrored or rotated.
    """
    height, width = matte.shape
    positions = unit_centres(view.classes.shape[-1])
    positions_px = view.square.to_photo(positions)
    inside = ((positions_px >= 0) & (positions_px < (width, height))).all(-1)
    columns, rows = positions_px[inside].astype(int).T
    person = 1 - view.classes[0].numpy()[inside]
    face = (1 - covering(view.classes).numpy())[inside]
    face = face * in_hull(positions[inside], view.square.to_unit_square(view.landmarks_px[:68]))
    if face.sum() < 1:
        return {}  # no face is visible that the matte could exclude
    alpha = matte[rows, columns]
    kept, fits = float((face * alpha).sum() / face.sum()), overlap(person, alpha)
    changed = [(overlap(person, 1 - alpha), "it is inverted")]
    for swapped, *reverse in _CHANGES[1:]:
        turned = matte[tuple(slice(None, None, -1 if back else 1) for back in reverse)]
        if not swapped or width == height:
            changed.append((overlap(person, (turned.T if swapped else turned)[rows, columns]), _EXIF))
    best, cause = max(changed)
    needed = max(_FITS, fits + _GAIN, overlap(person, np.ones_like(alpha)) + _GAIN_OVER_WHITE)
    if best > needed:
        raise InputError(
            f"the matte does not show the head; likely cause: {cause}; use one that is white on the person "
            "in the upright photo"
        )
    if kept < _MASKED:
        advice = "use one that is white on this person, or choose another person with --face"
        raise InputError(f"the matte excludes the face; {advice}")
    return {"masked": kept}
