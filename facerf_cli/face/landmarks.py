"""Files of the 68 face landmarks."""

from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.crop import check_landmarks
from facerf_cli.files.documents import Document, Points68, checked
from facerf_cli.files.texts import read_json, read_text, require_regular

_ADVICE = "use a .pts or JSON file of 68 landmarks"
_PTS_FIRST_PIXEL = 0.5  # .pts counts pixels from 1: the first pixel's centre is 1.0 there and 0.5 here


class _LandmarksDocument(Document):
    landmarks: Points68


def read_landmarks(path: Path) -> np.ndarray:
    """Read landmarks [68, 2] in the photo's pixels; raises InputError for any other file.

    The file is iBUG's `.pts`, which counts pixels from 1, or JSON with pixel centres at index + 0.5: a list
    of 68 [x, y], or an object with this list as "landmarks".
    """
    require_regular(path, _ADVICE)
    if path.suffix.lower() == ".pts":
        landmarks_px = _read_pts(path)
    else:
        content = read_json(path, _ADVICE)
        if isinstance(content, dict):
            landmarks_px = checked(_LandmarksDocument, content, str(path)).landmarks
        else:
            landmarks_px = checked(Points68, content, str(path))
    try:
        return check_landmarks(landmarks_px)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _read_pts(path: Path) -> np.ndarray:
    try:
        _, opening, rest = read_text(path, _ADVICE).partition("{")
        body, closing, _ = rest.partition("}")
        if not opening or not closing:
            raise ValueError("it has no points between { and }")
        rows = [[float(token) for token in line.split()] for line in body.splitlines() if line.strip()]
        return np.array(rows, np.float64) - _PTS_FIRST_PIXEL
    except ValueError as error:
        raise InputError(f"{path}: not landmarks ({error}); {_ADVICE}") from None
