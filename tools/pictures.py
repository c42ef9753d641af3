"""Draw the images of the documentation into docs/pictures, each from the results of commands.

    python tools/pictures.py [sheet gallery tutorial rigs way] [--hopper GRACE_HOPPER.jpg] [--to FOLDER]

Without names, all are drawn. The second photo of the sheet and of the gallery is matplotlib's sample data
(U.S. Navy, public domain); by default, that of an installed matplotlib. The commands of `tutorial` are read
from docs/tutorial.md, and its image of a page needs Chromium. `way` uses the Python API.
"""

import argparse
import contextlib
import importlib.util
import re
import shlex
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from PIL import Image, ImageDraw, ImageFont

import facerf_cli as facerf
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.files.read import read_image
from facerf_cli.files.sheets import contact_sheet
from facerf_cli.files.write import write_display
from facerf_cli.image.colour import srgb_to_linear
from facerf_cli.image.strips import resized
from facerf_cli.main import main
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.models import SHIPPED_NETWORKS

ROOT = Path(__file__).parents[1]
ASTRONAUT = Path("examples/astronaut.jpg")
LOW_SUN, OVERCAST, STAGE = (f"examples/maps/{name}.exr" for name in ("low_sun", "overcast", "stage"))
PRESETS = ("rembrandt", "loop", "butterfly", "split", "rim", "beauty")
QUALITY = 85
TITLE_PX = 18

# By picture: commands, and the names of the files to show, in order, after the stem of the photo.
COMMANDS = {
    "sheet": {
        f"relight {{photo}} --background envmap --envmap {LOW_SUN} {STAGE}": "low_sun.png stage.png",
        "relight {photo} --light=-60,20": "light_-60_20.png",
        "relight {photo} --light=original --light=rim=145,15,10": "light_original+rim.png",
        "segment {photo}": "person.png",
    },
    "well": {
        f"relight {{photo}} --light=40,20 --light=-60,15 --envmap {OVERCAST} {LOW_SUN}": (
            "light_40_20.png light_-60_15.png overcast.png low_sun.png"
        )
    },
    "badly": {
        "relight {photo} --light=90,0 --light=0,80 --light=150,20 --light=0,-60": (
            "light_90_0.png light_0_80.png light_150_20.png light_0_-60.png"
        )
    },
    "cut_out": {
        "segment {photo}": "overlay.jpg",
        f"relight {{photo}} --envmap {LOW_SUN} --background envmap": "low_sun.png",
    },
    "before_wall": {
        "relight {photo} --background {folder}/wall.png --light-wrap 0.3 --light-from background"
        " --light-from ambient=background --light key=60,25": "wall_light.png light_ambient+key.png"
    },
    "rigs": {
        f"relight {{photo}} --background 0,0,0 --light {' --light '.join(PRESETS)}": (
            " ".join(f"{preset}.png" for preset in PRESETS)
        )
    },
}


def results(picture: str, photo: Path) -> list[np.ndarray]:
    """Run the commands of a picture and return the images [H, W, 3] they write, linear, over white."""
    images = []
    with tempfile.TemporaryDirectory() as folder:
        wall = Path(folder, "wall.png")
        if picture == "before_wall":
            from skimage.data import brick

            write_display(wall, srgb_to_linear(brick()[..., None].repeat(3, -1) / np.float32(255)))
        for command, files in COMMANDS[picture].items():
            run([word.format(photo=photo, folder=folder) for word in shlex.split(command)] + ["-o", folder])
            images += [over_white(Path(folder, f"{photo.stem}_{name}")) for name in files.split()]
    return images


def run(words: Sequence[str]) -> None:
    """Run a command of facerf; a failure ends the script."""
    if main(["-q", *words]):
        raise SystemExit(1)


def over_white(path: Path) -> np.ndarray:
    """Read an image [H, W, 3], linear, over white where it has alpha."""
    with Image.open(path) as opened:
        has_alpha, image = "A" in opened.getbands(), opened.convert("RGBA")
    if has_alpha:
        white = Image.new("RGBA", image.size, (255, 255, 255, 255))
        Image.alpha_composite(white, image).convert("RGB").save(path)
    return read_image(path).pixels


def beside(images: Sequence[np.ndarray], height_px: int = 360) -> np.ndarray:
    """Images side by side [h, w, 3]."""
    height, width = images[0].shape[:2]
    size = height_px, round(width * height_px / height)
    return np.concatenate([resized(image, *size) for image in images], 1)


def frame_around_face(photo: Path, margin: float, side_px: int) -> Crop:
    """A square around the face within the photo; the margin is in sides of the face's crop."""
    pixels = read_image(photo).pixels
    face = from_landmarks(find_faces(SHIPPED_NETWORKS.people, pixels, str(photo))[0].landmarks_px, side_px)
    side = min(face.side_px * (1 + 2 * margin), *pixels.shape[:2])
    left = np.clip(face.x0_px + (face.side_px - side) / 2, 0, pixels.shape[1] - side)
    top = np.clip(face.y0_px + (face.side_px - side) / 2, 0, pixels.shape[0] - side)
    return Crop(float(left), float(top), float(side), side_px)


def sheet(hopper: Path) -> Iterator[tuple[str, np.ndarray]]:
    """The README's picture: a row per person."""
    tiles = []
    for photo in (ASTRONAUT, hopper):
        frame = frame_around_face(photo, margin=0.55, side_px=260)
        tiles += [frame.apply(image) for image in (read_image(photo).pixels, *results("sheet", photo))]
    yield "sheet.jpg", contact_sheet(np.stack(tiles), len(tiles) // 2)


def gallery(hopper: Path) -> Iterator[tuple[str, np.ndarray]]:
    """The pictures of docs/gallery.md."""
    for name in ("well", "badly"):
        for photo in (ASTRONAUT, hopper):
            row = [read_image(photo).pixels, *results(name, photo)]
            yield f"gallery_{photo.stem}_{name}.jpg", beside(row)
    both = [beside([read_image(photo).pixels, *results("cut_out", photo)]) for photo in (ASTRONAUT, hopper)]
    yield "gallery_cut_out.jpg", np.concatenate(both, 1)
    yield "gallery_before_wall.jpg", beside(results("before_wall", ASTRONAUT))


def rigs(_: Path) -> Iterator[tuple[str, np.ndarray]]:
    """The presets of `facerf relight --light`, three per row, each with its name."""
    frame = frame_around_face(ASTRONAUT, margin=0.08, side_px=360)
    cells = []
    for preset, image in zip(PRESETS, results("rigs", ASTRONAUT), strict=True):
        cell = frame.apply(image)
        label = Image.new("L", cell.shape[1::-1])
        corner = (TITLE_PX // 2, cell.shape[0] - 2 * TITLE_PX)
        ImageDraw.Draw(label).text(corner, preset, 255, ImageFont.load_default(TITLE_PX))
        cells.append(with_white(cell, label))
    yield "rigs.jpg", np.concatenate([np.concatenate(cells[first : first + 3], 1) for first in (0, 3)])


def with_white(image: np.ndarray, mask: Image.Image) -> np.ndarray:
    """A linear image [H, W, 3] with white where the mask is 255."""
    share = np.asarray(mask, np.float32)[..., None] / 255
    return np.asarray(image + share * (1 - image))


def way(_: Path) -> Iterator[tuple[str, np.ndarray]]:
    """The steps from a photo to an image under a map, each with its name above."""
    photo, tile_px = facerf.read_image(ASTRONAUT), 300
    person = facerf.fit(facerf.load_models(), photo)
    crop, points = person.head.fit.crop, person.landmarks
    corner = np.array([crop.x0_px, crop.y0_px])
    around = marked(photo, [tuple(np.concatenate([corner, corner + crop.side_px]))], width=4)
    face = crop.apply(marked(photo, [(x - 1, y - 1, x + 1, y + 1) for x, y in points], width=2))
    light = facerf.Light.from_envmap(facerf.read_image(LOW_SUN), lights=150, keys=False)
    textures = person.uv_olat(light.directions)
    total = (textures * light.weights[:, None, None]).sum(0)
    in_front = np.argsort(-light.directions[:, 2])[:72:8]  # nine of the lights in front of the face
    single = contact_sheet(np.asarray(textures[in_front]), 3)
    level = person.texture.mean()
    steps = {
        "photo": around,
        "crop, landmarks": face,
        "texture (UV)": person.texture,
        "one light at a time": single * level / single[single > 0].mean(),
        "weighted sum": total * level / total[total > 0].mean(),
        "composite": person.relight(float(level / total.mean()) * light),
    }
    tiles = []
    for name, step in steps.items():
        title = Image.new("RGB", (tile_px, 32))
        ImageDraw.Draw(title).text((8, 4), name, "white", ImageFont.load_default(TITLE_PX))
        strip = np.asarray(title, np.float32) / 255
        tiles.append(np.concatenate([strip, resized(middle_square(step), tile_px, tile_px)]))
    yield "way.jpg", contact_sheet(np.stack(tiles), 3)


def marked(image: np.ndarray, boxes: Sequence[tuple[float, ...]], width: int) -> np.ndarray:
    """A copy of a linear image [H, W, 3] with white boxes."""
    drawn = Image.new("L", image.shape[1::-1])
    for box in boxes:
        ImageDraw.Draw(drawn).rectangle(box, outline=255, width=width)
    return with_white(image, drawn)


def middle_square(image: np.ndarray) -> np.ndarray:
    """The middle square of an image."""
    side = min(image.shape[:2])
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    return image[top : top + side, left : left + side]


_STEP = re.compile(r"```sh\n([^`]*?)\n```\n\n!\[[^\n]*\]\(pictures/(\w+\.jpg)\)")
_WAIT = """<script>
  const waiting = setInterval(() => document.body.dataset.settled === "true" && clearInterval(waiting), 20);
</script></body>"""  # without a timer the browser's clock runs out before the first image


def tutorial(_: Path) -> Iterator[tuple[str, Image.Image]]:
    """The pictures of docs/tutorial.md, each by the command above it."""
    pictures = {"tutorial_photo.jpg": Image.open(ASTRONAUT).convert("RGB")}
    with tempfile.TemporaryDirectory() as folder:
        for command, name in _STEP.findall(Path("docs/tutorial.md").read_text()):
            *words, output = shlex.split(command)
            run([*words[1:], str(Path(folder, output))])
            pictures[name] = shown(Path(folder, output))
    for name, picture in pictures.items():
        size = 360 * picture.width // picture.height, 360
        yield name, picture.resize(size, Image.Resampling.LANCZOS)


def shown(made: Path) -> Image.Image:
    """What a command of the tutorial wrote: an image over grey, normals of a folder's EXR, or a page."""
    if made.is_dir():
        (stack,) = made.glob("*.exr")
        return Image.fromarray((127.5 + 127.5 * layer(stack, "normal")).astype("uint8"))
    image = Image.open(screenshot(made) if made.suffix == ".html" else made).convert("RGBA")
    return Image.alpha_composite(Image.new("RGBA", image.size, (128, 128, 128, 255)), image).convert("RGB")


def layer(stack: Path, name: str) -> np.ndarray:
    """A layer [H, W, 3] of an EXR."""
    part, image = 0, oiio.ImageBuf(str(stack))
    while image.spec().get_string_attribute("name") != name:
        image = oiio.ImageBuf(str(stack), part := part + 1, 0)
    return np.asarray(image.get_pixels(oiio.FLOAT))


def screenshot(page: Path) -> Path:
    """A PNG of a page of `facerf view`, by Chromium."""
    target = page.with_suffix(".png")
    source = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.read_text(), flags=re.S)
    page.write_text(source.replace("</body>", _WAIT))
    words = ["chromium", "--headless", "--no-sandbox", "--enable-unsafe-swiftshader"]
    words += ["--window-size=1100,900", "--virtual-time-budget=1000000000", f"--screenshot={target}"]
    words += [f"--user-data-dir={page.parent / 'profile'}", f"{page.as_uri()}#light=key=60,25"]
    subprocess.run(words, check=True, capture_output=True)
    return target


def sample_photo() -> Path:
    """matplotlib's photo of Grace Hopper."""
    found = importlib.util.find_spec("matplotlib")
    if found is None or not found.submodule_search_locations:
        raise SystemExit("pictures: needs matplotlib's sample photo; pass --hopper grace_hopper.jpg")
    return Path(found.submodule_search_locations[0]) / "mpl-data" / "sample_data" / "grace_hopper.jpg"


def draw(names: Sequence[str], hopper: Path, target: Path) -> None:
    """Write the pictures of some sets into a folder."""
    for name in names:
        for file, picture in PICTURES[name](hopper):
            if isinstance(picture, Image.Image):
                picture.save(target / file, quality=QUALITY)
            else:
                write_display(target / file, picture, quality=QUALITY)


PICTURES: dict[str, Callable[[Path], Iterator[tuple[str, np.ndarray | Image.Image]]]] = {
    "sheet": sheet,
    "gallery": gallery,
    "tutorial": tutorial,
    "rigs": rigs,
    "way": way,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help=f"some of {', '.join(PICTURES)}")
    parser.add_argument("--hopper", type=Path, help="the second photo")
    parser.add_argument("--to", type=Path, default=ROOT / "docs/pictures", help="folder of the pictures")
    given = parser.parse_args()
    chosen = given.names or list(PICTURES)
    hopper = given.hopper or (sample_photo() if {"sheet", "gallery"} & set(chosen) else ASTRONAUT)
    paths = hopper.resolve(), given.to.resolve()
    with contextlib.chdir(ROOT):
        draw(chosen, *paths)
