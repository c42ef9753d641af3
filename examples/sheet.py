"""Draw docs/pictures/sheet.jpg: people, a row each, and what facerf makes of them.

    python examples/sheet.py [PHOTO ...]

From the left: the photo, two maps with their backgrounds, a key light, the own light with a rim, cut out.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.files.read import read_image
from facerf_cli.files.sheets import contact_sheet
from facerf_cli.files.write import write_display
from facerf_cli.main import main
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.models import SHIPPED_NETWORKS

HERE = Path(__file__).parent
MAPS = [str(HERE / f"maps/{name}.exr") for name in ("low_sun", "stage")]
STEPS = {
    "{}_low_sun.png": ["relight", "--background", "envmap", "--envmap", *MAPS],
    "{}_stage.png": [],  # by the line above
    "{}_light_-60_20.png": ["relight", "--light=-60,20"],
    "{}_light_own+rim.png": ["relight", "--light=own", "--light=rim=145,15,10"],
    "{}_person.png": ["segment"],
}
CELL_PX, MARGIN, WHITE = 260, 0.55, (255, 255, 255, 255)  # the margin in sides of the face's crop


def row(photo: Path) -> list[np.ndarray]:
    """The photo's images [CELL_PX, CELL_PX, 3], linear."""
    pixels = read_image(photo).pixels
    face = from_landmarks(find_faces(SHIPPED_NETWORKS.people, pixels, str(photo))[0].landmarks_px, CELL_PX)
    side = min(face.side_px * (1 + 2 * MARGIN), *pixels.shape[:2])
    left = np.clip(face.x0_px + (face.side_px - side) / 2, 0, pixels.shape[1] - side)
    top = np.clip(face.y0_px + (face.side_px - side) / 2, 0, pixels.shape[0] - side)
    frame = Crop(float(left), float(top), float(side), CELL_PX)
    with tempfile.TemporaryDirectory() as folder:
        for words in filter(None, STEPS.values()):
            if main(["-q", *words, "-o", folder, "--", str(photo)]):
                raise SystemExit(1)
        made = [over_white(Path(folder, name.format(photo.stem))) for name in STEPS]
    return [frame.apply(image) for image in (pixels, *made)]


def over_white(path: Path) -> np.ndarray:
    """An image [H, W, 3], linear, over white where it has alpha."""
    image = Image.open(path).convert("RGBA")
    Image.alpha_composite(Image.new("RGBA", image.size, WHITE), image).convert("RGB").save(path)
    return read_image(path).pixels


if __name__ == "__main__":
    photos = [Path(argument) for argument in sys.argv[1:]] or [HERE / "astronaut.jpg"]
    tiles = [image for photo in photos for image in row(photo)]
    sheet = contact_sheet(np.stack(tiles), 1 + len(STEPS))
    write_display(HERE.parent / "docs/pictures/sheet.jpg", sheet, quality=85)
