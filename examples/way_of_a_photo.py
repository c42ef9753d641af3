"""Draw docs/pictures/way.jpg: what a photo becomes on its way to an image under a map.

python examples/way_of_a_photo.py [PHOTO [MAP [PICTURE.jpg]]]
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import facerf_cli as facerf
from facerf_cli.files.sheets import contact_sheet
from facerf_cli.files.write import write_display
from facerf_cli.image.strips import resized

HERE = Path(__file__).parent
TILE_PX, LIGHTS = 300, 150
STEPS = ("photo", "crop, landmarks", "texture (UV)", "one light at a time", "weighted sum", "composite")


def way(photo: np.ndarray, envmap: np.ndarray) -> np.ndarray:
    """The steps, three in a row [h, w, 3], linear, each with its name above."""
    person = facerf.fit(facerf.load_models(), photo)
    crop, points = person.head.fit.crop, person.landmarks
    corner = np.array([crop.x0_px, crop.y0_px])
    box = tuple(np.concatenate([corner, corner + crop.side_px]))
    around = marked(photo, [box], width=4)
    face = crop.apply(marked(photo, [(x - 1, y - 1, x + 1, y + 1) for x, y in points], width=2))
    light = facerf.Light.from_envmap(envmap, lights=LIGHTS, keys=False)
    textures = person.uv_olat(light.directions)
    total = (textures * light.weights[:, None, None]).sum(0)
    in_front = np.argsort(-light.directions[:, 2])[:72:8]  # nine of the lights before the face
    single = contact_sheet(np.asarray(textures[in_front]), 3)
    level = person.texture.mean()
    relit = person.relight(float(level / total.mean()) * light)
    as_bright = [values * level / values[values > 0].mean() for values in (single, total)]
    steps = [around, face, person.texture, *as_bright, relit]
    tiles = [
        np.concatenate([title(name), resized(square(step), TILE_PX, TILE_PX)])
        for name, step in zip(STEPS, steps, strict=True)
    ]
    return contact_sheet(np.stack(tiles), 3)


def title(name: str) -> np.ndarray:
    """A strip [h, TILE_PX, 3] with the name of a step."""
    strip = Image.new("RGB", (TILE_PX, 32))
    ImageDraw.Draw(strip).text((8, 4), name, "white", ImageFont.load_default(18))
    return np.asarray(strip, np.float32) / 255


def marked(image: np.ndarray, boxes: list[tuple[float, ...]], width: int) -> np.ndarray:
    """A copy of a linear image [H, W, 3] with white boxes."""
    drawn = Image.new("L", image.shape[1::-1])
    for box in boxes:
        ImageDraw.Draw(drawn).rectangle(box, outline=255, width=width)
    share = np.asarray(drawn, np.float32)[..., None] / 255
    return image * (1 - share) + share


def square(image: np.ndarray) -> np.ndarray:
    """The middle square of an image."""
    side = min(image.shape[:2])
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    return image[top : top + side, left : left + side]


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    defaults = [HERE / "astronaut.jpg", HERE / "maps/low_sun.exr", HERE.parent / "docs/pictures/way.jpg"]
    photo, envmap, picture = given + defaults[len(given) :]
    write_display(picture, way(facerf.read_image(photo), facerf.read_image(envmap)), quality=85)
