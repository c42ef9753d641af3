"""A portrait under four maps and four single lights, on one sheet.

    python examples/contact_sheet.py [PHOTO [MAPS [SHEET.jpg]]]

Above: the photo, then the maps in the order of their names, with their backgrounds. Below: the maps'
mirror balls in that order, then single lights from the picture's left, from its left above, from its right
above, and from straight above.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.main import main
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.models import SHIPPED_NETWORKS

HERE = Path(__file__).parent
LIGHTS = ("-75,0", "-35,25", "50,20", "0,60")
CELL_PX, MARGIN = 360, 0.3  # the margin in sides of the face's crop


def sheet(photo: Path, maps: Path) -> np.ndarray:
    """The sheet [2 cells, 5 cells, 3], linear."""
    names = sorted(path.stem for path in maps.iterdir())[:4]
    shots = [*names, *(f"light_{light.replace(',', '_')}" for light in LIGHTS)]
    original = read_image(photo).pixels
    frame = head(original, photo)
    with tempfile.TemporaryDirectory() as folder:
        lights = [part for light in LIGHTS for part in ("--light", light)]
        if main(
            [
                "-q",
                "relight",
                str(photo),
                "--envmap",
                str(maps),
                "--ball",
                "--background",
                "envmap",
                "-o",
                folder,
                *lights,
            ]
        ):
            raise SystemExit(1)
        lit = [frame.apply(read_image(Path(folder, f"{photo.stem}_{shot}.png")).pixels) for shot in shots]
        balls = [read_image(Path(folder, "balls", f"{name}.png")).pixels for name in names]
    half = [Crop(0, 0, ball.shape[0], CELL_PX // 2).apply(ball) for ball in balls]  # of a pair the mirror
    grid = np.concatenate([np.concatenate(half[:2], 1), np.concatenate(half[2:], 1)])
    rows = [frame.apply(original), *lit[:4]], [grid, *lit[4:]]
    return np.concatenate([np.concatenate(row, 1) for row in rows])


def head(photo: np.ndarray, path: Path) -> Crop:
    """The square around the face, with room for hair."""
    face = from_landmarks(find_faces(SHIPPED_NETWORKS.people, photo, str(path))[0].landmarks_px, CELL_PX)
    room = MARGIN * face.side_px
    return Crop(face.x0_px - room, face.y0_px - room, face.side_px + 2 * room, CELL_PX)


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    defaults = [HERE / "astronaut.jpg", HERE / "maps", HERE / "contact_sheet.jpg"]
    photo, maps, target = given + defaults[len(given) :]
    write_display(target, sheet(photo, maps))
