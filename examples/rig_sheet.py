"""The presets of `facerf relight --light` on one sheet.

python examples/rig_sheet.py [PHOTO [SHEET.jpg]]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.main import main
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.models import SHIPPED_NETWORKS

HERE = Path(__file__).parent
PRESETS = ("rembrandt", "loop", "butterfly", "split", "rim", "beauty")
CELL_PX, COLUMNS, LABEL_PX = 360, 3, 18
MARGIN = 0.08  # in sides of the face's crop


def sheet(photo: Path) -> np.ndarray:
    """The presets, three in a row [2 cells, 3 cells, 3], linear, over black."""
    face = from_landmarks(
        find_faces(SHIPPED_NETWORKS.people, read_image(photo).pixels, str(photo))[0].landmarks_px, CELL_PX
    )
    room = MARGIN * face.side_px
    frame = Crop(face.x0_px - room, face.y0_px - room, face.side_px + 2 * room, CELL_PX)
    with tempfile.TemporaryDirectory() as folder:
        lights = [part for preset in PRESETS for part in ("--light", preset)]
        if main(["-q", "relight", str(photo), "--background", "0,0,0", "-o", folder, *lights]):
            raise SystemExit(1)
        images = [Path(folder, f"{photo.stem}_{preset}.png") for preset in PRESETS]
        lit = [frame.apply(read_image(image).pixels) for image in images]
    cells = [labelled(image, preset) for image, preset in zip(lit, PRESETS, strict=True)]
    rows = [np.concatenate(cells[first : first + COLUMNS], 1) for first in range(0, len(cells), COLUMNS)]
    return np.concatenate(rows)


def labelled(image: np.ndarray, text: str) -> np.ndarray:
    """An image with its name in the lower left corner."""
    label = Image.new("L", image.shape[1::-1])
    place = (LABEL_PX // 2, image.shape[0] - 2 * LABEL_PX)
    ImageDraw.Draw(label).text(place, text, 255, ImageFont.load_default(LABEL_PX))
    share = np.asarray(label, np.float32)[..., None] / 255
    return image + share * (1 - image)


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    defaults = [HERE / "astronaut.jpg", HERE.parent / "docs/pictures/rigs.jpg"]
    photo, target = given + defaults[len(given) :]
    write_display(target, sheet(photo), quality=85)
