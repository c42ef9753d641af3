"""Layouts of captures on disk and their readers."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.faceolat import read_faceolat
from facerf_cli.capture.settings import ReadSettings
from facerf_cli.capture.stage_json import STAGE_FILE, read_stage
from facerf_cli.capture.yale_b import read_yale_capture
from facerf_cli.errors import InputError, UsageError

_AS_STORED = ReadSettings()
LAYOUTS: dict[str, Callable[[Path], Capture]] = {
    "stage": read_stage,
    "extended-yale-b": read_yale_capture,
    "faceolat": partial(read_faceolat, is_linear=False),
    "faceolat-linear": partial(read_faceolat, is_linear=True),
}


def read_capture(folder: Path, settings: ReadSettings = _AS_STORED) -> Capture:
    """Read a capture's description in one of `LAYOUTS`; no images are decoded yet.

    Raises UsageError for an unknown layout, or `subtract_ambient` without ambient images; InputError for an
    invalid description.
    """
    if settings.layout not in LAYOUTS:
        known = ", ".join(sorted(LAYOUTS))
        raise UsageError(f"--layout {settings.layout}: unknown layout; use {known}")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; use the folder of a capture")
    capture = LAYOUTS[settings.layout](folder)
    if settings.subtract_ambient and not capture.ambient_pattern:
        raise UsageError(f"--subtract-ambient: {folder / STAGE_FILE} names no 'ambient' images; add them")
    return replace(capture, subtract_ambient=settings.subtract_ambient)
