"""Landmarks and mattes that a user passes, compared with what the networks see of the face."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.topology import MIRROR_68
from facerf_cli.portrait.classes import class_index
from facerf_cli.portrait.confidence import in_hull, overlap
from facerf_cli.portrait.parse import SquareView, covering
from facerf_cli.raster.camera import PIXEL_CENTRE

_SAME = 0.1  # largest median distance of two sets of landmarks of one face, in its extent
_OWN_SIZE = 0.05  # difference of a scale from 1 that landmarks of the photo at its own size may have
_ELSEWHERE = 0.7  # share of background and garment at landmarks that are not on a face
_MASKED = 0.1  # share of the face that a matte of its person shows at least
# Overlap of a person with a matte: gain by changing a wrong one, over itself and over an all-white one, and
# the least afterwards. Right mattes, also shrunk, grown and of heads only, gain less than 0.15.
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


def lie_on_one(given_px: np.ndarray, faces: Sequence[np.ndarray], size_px: tuple[int, ...]) -> bool:
    """Tell if landmarks [68, 2] lie on one of the faces [68, 2] that are detected in a photo [H, W].

    Raises InputError, with the likely cause, where they would after a change of axes or size.
    """
    if any(_apart(given_px, face_px) < _SAME for face_px in faces):
        return True
    causes = [(1.0, "")]
    for face_px, (swapped, *reverse) in product(faces, _CHANGES):
        start = np.array(reverse) * (size_px[1], size_px[0])
        points = given_px[:, :: -1 if swapped else 1] * (1 - 2 * np.array(reverse))
        named = [(_CAUSES.get((swapped, *reverse), _EXIF), points)]
        if sum([swapped, *reverse]) % 2:  # a detector names left and right as they lie in the stored pixels
            named.append((_EXIF, points[MIRROR_68]))
        for cause, ordered in named:
            scale = ((face_px - start) * ordered).sum() / (ordered**2).sum()
            said = f" (they fit {1 / scale:.2f} of the photo's size)" if abs(scale - 1) > _OWN_SIZE else ""
            causes.append((_apart(scale * ordered + start, face_px), cause + said))
    misfit, cause = min(causes)
    if misfit < _SAME:
        raise InputError(f"landmarks: they lie off the face; the likely cause: {cause}; {_ADVICE}")
    return False


def check_seen(view: SquareView) -> None:
    """Raise InputError for landmarks of a view that clearly lie where no face is."""
    classes = view.classes.numpy()
    side = classes.shape[-1]
    x, y = (view.square.to_share(view.landmarks_px[17:68]) * side).astype(int).clip(0, side - 1).T
    if classes[[0, class_index("garment")]][:, y, x].sum(0).mean() > _ELSEWHERE:
        raise InputError(f"landmarks: they lie on background or clothes, where no face is seen; {_ADVICE}")


def _apart(points_px: np.ndarray, face_px: np.ndarray) -> float:
    """Median distance of points [68, 2] from those of a face, in its extent."""
    return float(np.median(np.linalg.norm(points_px - face_px, axis=-1)) / np.ptp(face_px, axis=0).max())


def given_matte_facts(view: SquareView, matte: np.ndarray) -> dict[str, float]:
    """Measure a matte [H, W] that is given against the head that the Parsing Network sees.

    Raises InputError, with the likely cause, for one that masks out the face or that fits far better when it
    is inverted, mirrored or turned.
    """
    height, width = matte.shape
    side = view.classes.shape[-1]
    at = (np.arange(side) + PIXEL_CENTRE) / side
    shares = np.stack(np.meshgrid(at, at), -1)
    places_px = view.square.to_photo(shares)
    inside = ((places_px >= 0) & (places_px < (width, height))).all(-1)
    columns, rows = places_px[inside].astype(int).T
    person = 1 - view.classes[0].numpy()[inside]
    face = (1 - covering(view.classes).numpy())[inside]
    face = face * in_hull(shares[inside], view.square.to_share(view.landmarks_px[:68]))
    if face.sum() < 1:
        return {}  # no face is seen that the matte could leave out
    seen = matte[rows, columns]
    shown, fits = float((face * seen).sum() / face.sum()), overlap(person, seen)
    changed = [(overlap(person, 1 - seen), "it is inverted")]
    for swapped, *reverse in _CHANGES[1:]:
        turned = matte[tuple(slice(None, None, -1 if back else 1) for back in reverse)]
        if not swapped or width == height:
            changed.append((overlap(person, (turned.T if swapped else turned)[rows, columns]), _EXIF))
    best, cause = max(changed)
    needed = max(_FITS, fits + _GAIN, overlap(person, np.ones_like(seen)) + _GAIN_OVER_WHITE)
    if best > needed:
        raise InputError(
            f"the matte does not show the head; the likely cause: {cause}; use one that is white on the "
            "person in the upright photo"
        )
    if shown < _MASKED:
        raise InputError(
            "the matte leaves out the face; use one that is white on this person, or choose another by --face"
        )
    return {"masked": shown}
