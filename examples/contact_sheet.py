"""A portrait under four maps and four single lights, on one sheet.

    python examples/contact_sheet.py [PHOTO [MAPS [SHEET.jpg]]]

Above: the photo, then the maps in the order of their names. Below: the maps' mirror balls in that order, then
single lights from the picture's left, from its left above, from its right above, and from straight above.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from facerf_cli.files.images import read_image, write_display
from facerf_cli.main import main

HERE = Path(__file__).parent
LIGHTS = ("-75,0", "-35,25", "50,20", "0,60")


def sheet(photo: Path, maps: Path) -> np.ndarray:
    """The sheet [H, W, 3], linear."""
    with tempfile.TemporaryDirectory() as folder:
        lights = [part for light in LIGHTS for part in ("--light", light)]
        line = ["relight", str(photo), "--envmap", str(maps), "--ball", "-o", folder, *lights]
        if main(line):
            raise SystemExit(1)
        names = sorted(path.stem for path in maps.iterdir())[:4]
        lit = [f"{photo.stem}_{name}.png" for name in names]
        lit += [f"{photo.stem}_light_{light.replace(',', '_')}.png" for light in LIGHTS]
        pictures = [read_image(Path(folder, name)).pixels for name in lit]
        balls = [read_image(Path(folder, "balls", f"{name}.png")).pixels for name in names]
    mirrors = [ball[:, : ball.shape[1] // 2] for ball in balls]
    grid = np.concatenate([np.concatenate(mirrors[:2], 1), np.concatenate(mirrors[2:], 1)])
    cell = np.zeros_like(pictures[0])
    grid = grid[: cell.shape[0], : cell.shape[1]]
    cell[: grid.shape[0], : grid.shape[1]] = grid
    rows = [read_image(photo).pixels, *pictures[:4]], [cell, *pictures[4:]]
    return np.concatenate([np.concatenate(row, 1) for row in rows])


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    photo, maps, target = (
        given + [HERE / "astronaut.jpg", HERE / "maps", HERE / "contact_sheet.jpg"][len(given) :]
    )[:3]
    write_display(target, sheet(photo, maps))
