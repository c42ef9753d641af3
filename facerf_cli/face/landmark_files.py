"""Landmarks from files instead of a detector: iBUG's `.pts`, and JSON."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.crop import check_landmarks

_LIMIT_BYTES = 1 << 20
_PTS_FIRST_PIXEL = 0.5  # .pts counts from 1: the first pixel's centre is 1.0 there and 0.5 here


def read_landmarks(path: Path) -> np.ndarray:
    """Landmarks [68, 2] in the photo's pixels, centres at index + 0.5.

    `.pts` as iBUG writes it (pixels counted from 1), or JSON: a list of 68 [x, y], or an object that holds it
    as "landmarks", with pixel centres at index + 0.5.
    """
    try:
        size = path.stat().st_size
        text = path.read_text(encoding="utf-8") if size <= _LIMIT_BYTES else ""
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as landmarks ({_reason(error)})") from None
    if size > _LIMIT_BYTES:
        raise InputError(f"{path}: {size} bytes are too many for 68 landmarks")
    try:
        points = _parse_pts(text) if path.suffix.lower() == ".pts" else _parse_json(text)
        return check_landmarks(points)
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: not 68 landmarks as .pts or JSON ({_reason(error)})") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _reason(error: Exception) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)


def _parse_pts(text: str) -> np.ndarray:
    _, opening, rest = text.partition("{")
    body, closing, _ = rest.partition("}")
    if not opening or not closing:
        raise ValueError("no points between { and }")
    rows = [[float(token) for token in line.split()] for line in body.splitlines() if line.strip()]
    return np.array(rows, np.float64) - _PTS_FIRST_PIXEL


def _parse_json(text: str) -> np.ndarray:
    content: Any = json.loads(text)
    if isinstance(content, dict):
        if "landmarks" not in content:
            raise ValueError('the object has no "landmarks"')
        content = content["landmarks"]
    return np.array(content, np.float64)
