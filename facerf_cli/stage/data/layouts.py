"""How captures of light stages lie on disk: an adapter for each layout that can be run here."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from facerf_cli.errors import InputError, UsageError
from facerf_cli.stage.data.capture import Capture
from facerf_cli.stage.data.stage_file import STAGE_FILE, read_stage
from facerf_cli.stage.data.yale_layout import read_yale_capture

LAYOUTS: dict[str, Callable[[Path], Capture]] = {"stage": read_stage, "extended-yale-b": read_yale_capture}


def read_capture(
    folder: Path, layout: str = "stage", subtract_ambient: bool = False, align: bool = False
) -> Capture:
    """Read a capture's description in one of `LAYOUTS`; no pictures yet."""
    if layout not in LAYOUTS:
        raise UsageError(f"--layout {layout}: not known; there is {', '.join(sorted(LAYOUTS))}")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    capture = LAYOUTS[layout](folder)
    if subtract_ambient and not capture.ambient_pattern:
        raise UsageError(f"--subtract-ambient: {folder / STAGE_FILE} names no 'ambient' pictures")
    return replace(capture, subtract_ambient=subtract_ambient, align=align)
