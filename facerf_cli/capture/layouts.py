"""The Extended Yale Face Database B as a capture: one camera, 64 flashes, the lights in the files' names.

Nothing in the database calibrates its camera, and the cropped pictures were cut out and scaled by hand. So
this is a stated guess: focal length `FOCAL_PX`, the principal point in the picture's middle, square pixels.
The flashes' angles are relative to the camera's axis, so the world is the camera's own space. All flashes
count as equally bright, with intensity 1: the unit of light is unknown, too.

Pictures that the database marks as damaged (`.bad`) are `Capture.marked`. Those that are damaged without a
mark are in it like the others: the checks are to find them.

How captures of light stages lie on disk: an adapter for each layout that can be run here.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.stage_json import STAGE_FILE, read_stage
from facerf_cli.capture.yale_b import HEIGHT_PX, WIDTH_PX, Flash, YaleB, read_yale_b
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.joint_fit import PosedCamera

CAMERA = "P00"  # the frontal pose, the only one of the cropped database
FOCAL_PX = 1000.0
_LICENCE = "Extended Yale Face Database B: free for research (Georghiades et al. 2001; Lee et al. 2005)"


def read_yale_capture(folder: Path) -> Capture:
    """The database in a folder as a capture; no pictures are decoded yet."""
    database = read_yale_b(folder, leave_out={})
    marked = {subject: _marked(database, subject) for subject in database.subjects}
    flashes = sorted({flash for found in (*database.files.values(), *marked.values()) for flash in found})
    return Capture(
        folder=folder,
        pattern="{subject}/{subject}_{camera}{light}.pgm",
        colour_space="linear",
        black_level=0.0,
        light_ids=tuple(flash.name for flash in flashes),
        directions_world=np.stack([flash.direction for flash in flashes]),
        intensities=np.ones((len(flashes), 3)),
        cameras={CAMERA: guessed_camera()},
        subjects={subject: {} for subject in database.subjects},
        provenance={
            "database": "Extended Yale Face Database B, cropped",
            "licence": _LICENCE,
            "synthetic": False,
            "calibration": f"a guess: focal length {FOCAL_PX:g} px, equal flashes of unknown intensity",
        },
        ambient_pattern="{subject}/{subject}_{camera}_Ambient.pgm",
        marked={
            subject: frozenset(flash.name for flash in found) for subject, found in marked.items() if found
        },
    )


def guessed_camera() -> PosedCamera:
    """The camera of the cropped pictures, at the world's origin, looking down -z."""
    return PosedCamera(
        focal_px=(FOCAL_PX, FOCAL_PX),
        centre_px=(WIDTH_PX / 2, HEIGHT_PX / 2),
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
        rotation=torch.eye(3, dtype=torch.float64),
        translation_m=torch.zeros(3, dtype=torch.float64),
    )


def _marked(database: YaleB, subject: str) -> set[Flash]:
    """The flashes whose pictures of a subject end in .bad, where there is no other of the same."""
    prefix, suffix = f"{subject}_{CAMERA}", ".pgm.bad"
    names = (name for name in database.marked_damaged if name.startswith(prefix))
    found = {Flash.named(name.removeprefix(prefix).removesuffix(suffix)) for name in names}
    return {flash for flash in found if flash is not None} - set(database.files[subject])


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
