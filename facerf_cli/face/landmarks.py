"""Landmark files, and the display copy of a photo in which faces are found."""

from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.crop import check_landmarks
from facerf_cli.files.documents import Document, Points68, checked
from facerf_cli.files.texts import read_json, read_text, require_regular
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.image.strips import strips

_BLOCK_PX = 1 << 16  # converted at a time, so that they stay in the processor's cache
_ADVICE = "give 68 landmarks as .pts or JSON"
_PTS_FIRST_PIXEL = 0.5  # .pts counts pixels from 1: the first pixel's centre is 1.0 there and 0.5 here


def to_display(pixels_linear: np.ndarray, exposure_ev: float | None = None) -> np.ndarray:
    """Convert a scene-linear image [H, W, 3] to sRGB uint8, at `display_ev` where no exposure is given."""
    gain = np.float32(2.0 ** (display_ev(pixels_linear) if exposure_ev is None else exposure_ev))
    display = np.empty(pixels_linear.shape, np.uint8)
    for rows in strips(display.shape, _BLOCK_PX):
        encoded = linear_to_srgb((pixels_linear[rows] * gain).clip(0, 1))
        display[rows] = np.round(encoded * 255)
    return display


def display_ev(pixels_linear: np.ndarray) -> float:
    """The automatic exposure of an image [H, W, 3] in EV, by some of its pixels."""
    stride = max(1, max(pixels_linear.shape[:2]) // 1024)
    return auto_exposure_ev(pixels_linear[::stride, ::stride])


def check_display(image_srgb: np.ndarray) -> None:
    """Raise ValueError for anything but an sRGB uint8 image [H, W, 3], as `to_display` gives it."""
    if image_srgb.ndim != 3 or image_srgb.shape[2] != 3 or image_srgb.dtype != np.uint8:
        raise ValueError(f"image: it is {image_srgb.dtype} {image_srgb.shape}, not uint8 [H, W, 3]")


def read_landmarks(path: Path) -> np.ndarray:
    """Read landmarks [68, 2] in the photo's pixels; raises InputError for any other file.

    The file is iBUG's `.pts`, whose pixels count from 1, or JSON with pixel centres at index + 0.5: a list of
    68 [x, y], or an object with this list as "landmarks".
    """
    require_regular(path, _ADVICE)
    try:
        if path.suffix.lower() == ".pts":
            return check_landmarks(_read_pts(path))
        content = read_json(path, _ADVICE)
        points = (
            checked(_LandmarksDocument, content, str(path)).landmarks
            if isinstance(content, dict)
            else content
        )
        return check_landmarks(checked(Points68, points, str(path)))
    except InputError as error:
        named = "" if str(error).startswith(str(path)) else f"{path}: "
        raise InputError(f"{named}{error}") from None


class _LandmarksDocument(Document):
    landmarks: Points68


def _read_pts(path: Path) -> np.ndarray:
    try:
        _, opening, rest = read_text(path, _ADVICE).partition("{")
        body, closing, _ = rest.partition("}")
        if not opening or not closing:
            raise ValueError("it has no points between { and }")
        rows = [[float(token) for token in line.split()] for line in body.splitlines() if line.strip()]
        return np.array(rows, np.float64) - _PTS_FIRST_PIXEL
    except ValueError as error:
        raise InputError(f"{path}: no landmarks ({error}); {_ADVICE}") from None
