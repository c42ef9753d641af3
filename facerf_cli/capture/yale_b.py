"""Reader for the cropped Extended Yale Face Database B: real people under one flash at a time.

A. Georghiades, P. Belhumeur, D. Kriegman, *From few to many: illumination cone models for face recognition
under variable lighting and pose*, PAMI 2001; K.-C. Lee, J. Ho, D. Kriegman, *Acquiring linear subspaces for
face recognition under variable lighting*, PAMI 2005 (the cropped form).

Files are `yaleBXX/yaleBXX_P00A+035E-20.pgm`, 168 x 192 grey pixels of 8 bit, nearly linear in light. A is the
flash's azimuth in degrees, positive to the viewer's left; E is its elevation, positive above. Images that the
database marks as damaged end in `.bad`. `yaleBXX_P00_Ambient.pgm` shows the subject without a flash; for some
subjects it is not cropped.

The camera is not calibrated, and the images were cropped and scaled by hand. The reader assumes a focal
length `FOCAL_PX`, a central principal point and square pixels. The flashes' angles are relative to the
camera's axis, so world space is camera space. All flashes have intensity 1; the unit of light is unknown.
"""

import csv
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from facerf_cli.capture.capture import Capture
from facerf_cli.errors import InputError
from facerf_cli.files.read import read_image
from facerf_cli.files.texts import read_text
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.raster.camera import PosedCamera

WIDTH_PX, HEIGHT_PX = 168, 192
CAMERA = "P00"  # the frontal pose, the only one in the cropped database
FOCAL_PX = 1000.0  # at a distance of a metre, a face then fills the image
_LICENCE = "Extended Yale Face Database B: free for research (Georghiades et al. 2001; Lee et al. 2005)"
_SUBJECT = re.compile(r"yaleB\d\d")
_FLASH = re.compile(r"A([+-]\d{1,3})E([+-]\d{1,2})")


@dataclass(frozen=True, order=True)
class Flash:
    """Flash of the rig, with the angles in the file names; facerf's azimuth has the opposite sign."""

    azimuth_deg: int  # > 0: to the viewer's left
    elevation_deg: int

    @property
    def name(self) -> str:
        """Part of the file names, such as `A+035E-20`."""
        return f"A{self.azimuth_deg:+04d}E{self.elevation_deg:+03d}"

    @property
    def direction(self) -> np.ndarray:
        """Unit vector [3] toward the flash, x right, y up, z toward the camera, float64."""
        angles = torch.tensor([-self.azimuth_deg, self.elevation_deg], dtype=torch.float64)
        return azel_to_direction(angles[0], angles[1]).numpy()

    @property
    def angle_deg(self) -> float:
        """Angle between the flash and the camera."""
        return float(np.degrees(np.arccos(np.clip(self.direction[2], -1, 1))))

    @staticmethod
    def named(name: str) -> "Flash | None":
        """Parse a flash's name; return None for any other text."""
        match = _FLASH.fullmatch(name)
        return Flash(int(match[1]), int(match[2])) if match else None


# Damaged without a .bad mark: two video fields under different flashes, or a flash that did not fire.
UNMARKED_DAMAGE: Mapping[str, Collection[Flash]] = {
    "yaleB02": (Flash(20, -10), Flash(25, 0), Flash(95, 0)),
    "yaleB05": (Flash(35, 15), Flash(35, 40)),
    "yaleB08": (Flash(-35, 15), Flash(-35, 40)),
    "yaleB09": (Flash(50, -40),),
    "yaleB10": (Flash(50, -40),),
    "yaleB13": (Flash(-110, -20),),
    **{f"yaleB{number}": (Flash(95, 0),) for number in range(34, 40)},
}
Shifts = Mapping[tuple[str, Flash], tuple[int, int]]  # (down, right) in pixels


@dataclass(frozen=True, eq=False)
class YaleB:
    """Database on disk; `shifts` align an image with its subject's frontal one, because heads drift."""

    folder: Path
    files: Mapping[str, Mapping[Flash, Path]]  # by subject, sorted
    marked: Mapping[str, frozenset[Flash]]  # by subject, of the files that end in .bad
    left_out: Sequence[str]  # stems of the files that exist and are excluded as damaged
    shifts: Shifts

    @property
    def subjects(self) -> list[str]:
        """Subjects on disk, sorted."""
        return list(self.files)

    def flashes(self, subject: str) -> list[Flash]:
        """Return the flashes of a subject, sorted by azimuth and then elevation."""
        return list(self.files[subject])

    def image(self, subject: str, flash: Flash) -> np.ndarray:
        """Read the image [192, 168] of a subject under one flash, float32 in 0..1, without a display curve.

        Raises InputError for an image that is unreadable or has another size.
        """
        path = self.files[subject][flash]
        image = read_image(path, "linear").pixels[..., 0]
        if image.shape != (HEIGHT_PX, WIDTH_PX):
            raise InputError(
                f"{path}: {image.shape[1]} x {image.shape[0]} pixels, not {WIDTH_PX} x {HEIGHT_PX}; use the "
                "cropped database as distributed (CroppedYale.zip); some public copies are shrunk"
            )
        down_px, right_px = self.shifts.get((subject, flash), (0, 0))
        rows, columns = np.arange(HEIGHT_PX) - down_px, np.arange(WIDTH_PX) - right_px
        return image[rows.clip(0, HEIGHT_PX - 1)][:, columns.clip(0, WIDTH_PX - 1)]

    def images(self, subject: str) -> np.ndarray:
        """Read the images [L, 192, 168] of a subject under all its `flashes`."""
        return np.stack([self.image(subject, flash) for flash in self.flashes(subject)])


def read_yale_b(
    folder: Path,
    shifts: Shifts | None = None,
    leave_out: Mapping[str, Collection[Flash]] = UNMARKED_DAMAGE,
) -> YaleB:
    """List the database's images, except `leave_out`; nothing is decoded yet.

    Raises InputError for a folder without subjects, or a subject without images.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; use the folder of the database")
    subjects = sorted(
        path.name for path in folder.iterdir() if path.is_dir() and _SUBJECT.fullmatch(path.name)
    )
    if not subjects:
        raise InputError(f"{folder}: no folders yaleB01 to yaleB39; use the folder that contains them")
    files, marked, dropped = {}, {}, []
    for subject in subjects:
        images, damaged = _images_of(folder / subject, ".pgm"), leave_out.get(subject, ())
        if not images:
            example = f"{subject}_{CAMERA}A+000E+00.pgm"
            raise InputError(f"{folder / subject}: no images {example} and so on; copy the folder again")
        files[subject] = {flash: path for flash, path in images.items() if flash not in damaged}
        dropped += [path.stem for flash, path in images.items() if flash in damaged]
        marked[subject] = frozenset(_images_of(folder / subject, ".pgm.bad"))
    return YaleB(folder, files, marked, dropped, shifts or {})


def _images_of(folder: Path, suffix: str) -> dict[Flash, Path]:
    """Return the images of a subject in the order of their flashes."""
    prefix = f"{folder.name}_{CAMERA}"
    images = {
        flash: path
        for path in folder.glob(f"{prefix}A*{suffix}")
        if (flash := Flash.named(path.name.removeprefix(prefix).removesuffix(suffix)))
    }
    return dict(sorted(images.items()))


def read_shifts(path: Path) -> dict[tuple[str, Flash], tuple[int, int]]:
    """Read rows `subject,light,dy,dx`, such as yaleB01,A-130E+20,2,-1, in pixels down and right.

    Other columns are ignored. An InputError names the first invalid row.
    """
    advice = "write lines subject,light,dy,dx under such a header"
    shifts, rows = {}, csv.DictReader(read_text(path, advice).splitlines())
    try:
        for row in rows:
            flash, down, right = Flash.named(row["light"]), int(row["dy"]), int(row["dx"])
            if flash is None or max(abs(down), abs(right)) >= WIDTH_PX:
                raise ValueError
            shifts[row["subject"], flash] = down, right
    except (csv.Error, KeyError, TypeError, ValueError):
        raise InputError(f"{path}: line {rows.line_num} is invalid; {advice}") from None
    if not shifts:
        raise InputError(f"{path}: no shifts; {advice}")
    return shifts


def read_yale_capture(folder: Path) -> Capture:
    """Read the database in a folder as a capture; no images are decoded yet."""
    database = read_yale_b(folder, leave_out={})
    marked = {subject: database.marked[subject] - set(of) for subject, of in database.files.items()}
    flashes = sorted(set().union(*database.files.values(), *marked.values()))
    return Capture(
        folder=folder,
        pattern="{subject}/{subject}_{camera}{light}.pgm",
        colour_space="linear",
        black_level=0.0,
        light_ids=tuple(flash.name for flash in flashes),
        directions_world=np.stack([flash.direction for flash in flashes]),
        intensities=np.ones((len(flashes), 3)),
        cameras={
            CAMERA: PosedCamera(
                focal_px=(FOCAL_PX, FOCAL_PX),
                centre_px=(WIDTH_PX / 2, HEIGHT_PX / 2),
                width_px=WIDTH_PX,
                height_px=HEIGHT_PX,
                rotation=torch.eye(3, dtype=torch.float64),
                translation_m=torch.zeros(3, dtype=torch.float64),
            )
        },
        subjects={subject: {} for subject in database.subjects},
        provenance={
            "database": "Extended Yale Face Database B, cropped",
            "licence": _LICENCE,
            "synthetic": False,
            "calibration": f"a guess: focal length {FOCAL_PX:g} px, equal flashes of unknown intensity",
        },
        ambient_pattern="{subject}/{subject}_{camera}_Ambient.pgm",
        marked={
            subject: frozenset(flash.name for flash in flashes)
            for subject, flashes in marked.items()
            if flashes
        },
    )
