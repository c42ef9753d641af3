"""A small Extended Yale B on disk: a grey ramp under each flash, in the database's folders and names."""

from pathlib import Path

import numpy as np

from facerf_cli.capture.yale_b import HEIGHT_PX, WIDTH_PX, Flash

FLASHES = tuple(
    Flash(*angles)
    for angles in ((0, 0), (-25, 0), (25, 0), (35, 40), (0, -35), (-70, 0), (70, 0), (0, 90), (-110, 15))
)


def write_pgm(path: Path, values: np.ndarray) -> None:
    """A binary grey map of uint8 [H, W]."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = values.shape
    path.write_bytes(b"P5\n%d %d\n255\n" % (width, height) + values.astype(np.uint8).tobytes())


def ramp(seed: int) -> np.ndarray:
    """A picture uint8 [192, 168] like no other."""
    row, column = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    return ((3 * row + 5 * column + 37 * seed) % 251).astype(np.uint8)


def write_yale_b(
    folder: Path, subjects: tuple[str, ...] = ("yaleB05", "yaleB07"), flashes: tuple[Flash, ...] = FLASHES
) -> Path:
    """The pictures `ramp(place of the flash)` of each subject."""
    for subject in subjects:
        for seed, flash in enumerate(flashes):
            write_pgm(folder / subject / f"{subject}_P00{flash.name}.pgm", ramp(seed))
        (folder / subject / f"{subject}_P00.info").write_text("a list\n")
    return folder
