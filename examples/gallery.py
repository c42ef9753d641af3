"""Draw the images of docs/gallery.md: two people, cut out, and under lights that facerf does well and badly.

    python examples/gallery.py [GRACE_HOPPER.jpg [FOLDER]]

The second photo is matplotlib's sample data (U.S. Navy, public domain); without an argument it is that of
an installed matplotlib. Each row: the photo, then its lights in the order of `ROWS`; the wall is skimage's.
"""

import importlib.util
import sys
import tempfile
from pathlib import Path

import numpy as np

from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.image.colour import srgb_to_linear
from facerf_cli.image.strips import resized
from facerf_cli.main import main

HERE = Path(__file__).parent
HEIGHT_PX = 360
MAPS = HERE / "maps"
WELL = ("--light=40,20", "--light=-60,15", "--envmap=overcast.exr", "--envmap=low_sun.exr")
BADLY = ("--light=90,0", "--light=0,80", "--light=150,20", "--light=0,-60")


def hopper() -> Path:
    """matplotlib's photo of Grace Hopper."""
    found = importlib.util.find_spec("matplotlib")
    if found is None or not found.submodule_search_locations:
        raise SystemExit("gallery: needs matplotlib's sample photo; give the path of grace_hopper.jpg")
    return Path(found.submodule_search_locations[0]) / "mpl-data" / "sample_data" / "grace_hopper.jpg"


def row(photo: Path, lights: tuple[str, ...]) -> np.ndarray:
    """The photo and its relit images side by side [h, w, 3], linear."""
    options = []
    for light in lights:
        name, value = light.split("=")
        options += [name, str(MAPS / value) if name == "--envmap" else value]
    names = [value.split("=")[1].removesuffix(".exr").replace(",", "_") for value in lights]
    files = [
        f"{photo.stem}_{'light_' if light.startswith('--light') else ''}{name}.png"
        for light, name in zip(lights, names, strict=True)
    ]
    return beside([read_image(photo).pixels, *made(["relight", str(photo), *options], files)])


def cut_out(photo: Path) -> np.ndarray:
    """The photo, the person's parts as facerf sees them, and the person before the map that lights it."""
    words = [str(photo), "--envmap", str(MAPS / "low_sun.exr"), "--background", "envmap"]
    parts = made(["segment", str(photo)], [f"{photo.stem}_overlay.jpg"])
    return beside(
        [read_image(photo).pixels, *parts, *made(["relight", *words], [f"{photo.stem}_low_sun.png"])]
    )


def before_wall(photo: Path) -> np.ndarray:
    """The person before a brick wall, in its light and with a key light beside."""
    from skimage.data import brick

    with tempfile.TemporaryDirectory() as folder:
        wall = Path(folder, "wall.png")
        write_display(wall, srgb_to_linear(brick()[..., None].repeat(3, -1) / np.float32(255)))
        words = ["relight", str(photo), "--background", str(wall), "--light-wrap", "0.3"]
        words += ["--light-from", "background", "--light-from", "room=background", "--light", "key=60,25"]
        return beside(made(words, [f"{photo.stem}_wall_light.png", f"{photo.stem}_light_room+key.png"]))


def made(words: list[str], files: list[str]) -> list[np.ndarray]:
    """Images [H, W, 3], linear, that a command writes."""
    with tempfile.TemporaryDirectory() as folder:
        if main(["-q", *words, "-o", folder]):
            raise SystemExit(1)
        return [read_image(Path(folder, name)).pixels for name in files]


def beside(images: list[np.ndarray]) -> np.ndarray:
    """Images side by side, of the gallery's height."""
    height, width = images[0].shape[:2]
    size = HEIGHT_PX, round(width * HEIGHT_PX / height)
    return np.concatenate([resized(image, *size) for image in images], 1)


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    second = given[0] if given else hopper()
    target = given[1] if given[1:] else HERE.parent / "docs/pictures"
    for name, lights in (("well", WELL), ("badly", BADLY)):
        for photo in (HERE / "astronaut.jpg", second):
            write_display(target / f"gallery_{photo.stem}_{name}.jpg", row(photo, lights), quality=85)
    both = [cut_out(photo) for photo in (HERE / "astronaut.jpg", second)]
    write_display(target / "gallery_cut_out.jpg", np.concatenate(both, 1), quality=85)
    write_display(target / "gallery_before_wall.jpg", before_wall(HERE / "astronaut.jpg"), quality=85)
