"""Readers of capture layouts: `stage.json`, and the Extended Yale Face Database B.

Extended Yale B has one camera and 64 flashes, whose directions are in the file names. Nothing calibrates the
camera, and the cropped images were cut out and scaled by hand, so a documented guess stands in: focal length
`FOCAL_PX`, principal point in the middle, square pixels. The flashes' angles are relative to the camera's
axis, so world space is camera space. All flashes have intensity 1; the unit of light is unknown.

Images that the database marks as damaged (`.bad`) become `Capture.marked`. Damaged images without that mark
are kept: the checks of a capture find them.
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
FOCAL_PX = 1000.0  # at a distance of a metre, a face then fills the image
_LICENCE = "Extended Yale Face Database B: free for research (Georghiades et al. 2001; Lee et al. 2005)"


def read_yale_capture(folder: Path) -> Capture:
    """Read the database in a folder as a capture; no images are decoded yet."""
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
        cameras={CAMERA: guess_camera()},
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


def guess_camera() -> PosedCamera:
    """Camera of the cropped images, at the world origin, looking down -z."""
    return PosedCamera(
        focal_px=(FOCAL_PX, FOCAL_PX),
        centre_px=(WIDTH_PX / 2, HEIGHT_PX / 2),
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
        rotation=torch.eye(3, dtype=torch.float64),
        translation_m=torch.zeros(3, dtype=torch.float64),
    )


def _marked(database: YaleB, subject: str) -> set[Flash]:
    """Flashes of which a subject has an image that ends in .bad and no sound one."""
    prefix, suffix = f"{subject}_{CAMERA}", ".pgm.bad"
    names = (name for name in database.marked_damaged if name.startswith(prefix))
    found = {Flash.named(name.removeprefix(prefix).removesuffix(suffix)) for name in names}
    return {flash for flash in found if flash is not None} - set(database.files[subject])


LAYOUTS: dict[str, Callable[[Path], Capture]] = {"stage": read_stage, "extended-yale-b": read_yale_capture}


def read_capture(
    folder: Path, layout: str = "stage", subtract_ambient: bool = False, align: bool = False
) -> Capture:
    """Read a capture's description in one of `LAYOUTS`; no images yet.

    UsageError for an unknown layout, or `subtract_ambient` without ambient images; InputError for a wrong
    description.
    """
    if layout not in LAYOUTS:
        raise UsageError(f"--layout {layout}: unknown layout; there is {', '.join(sorted(LAYOUTS))}")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder of a capture")
    capture = LAYOUTS[layout](folder)
    if subtract_ambient and not capture.ambient_pattern:
        raise UsageError(
            f"--subtract-ambient: {folder / STAGE_FILE} names no 'ambient' images; add them, or omit it"
        )
    return replace(capture, subtract_ambient=subtract_ambient, align=align)
