"""Real photos under six lights on one sheet, to be looked at: what no figure says.

    python benchmarks/look.py [PHOTO|DIR ...] [--checkpoint A B] [-o out/look.png]

A row a photo, and of that a row a checkpoint: the photo, then a lamp in front, from the picture's left 45
degrees off, from its right 70 degrees off, from above, from below, and a map. Every picture is what `facerf
relight` writes, at the exposure that it chooses.
"""

import argparse
import io
import tempfile
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.landmarks import find_faces
from facerf_cli.files.images import read_image, write_display
from facerf_cli.main import main as facerf

PHOTOS = [Path("examples/astronaut.jpg"), Path("../shared/data/photos")]
ENVMAP = Path("examples/maps/studio.exr")
LAMPS = {"front": "0,0", "left 45": "-45,0", "right 70": "70,0", "above": "0,60", "below": "0,-50"}
_ROOM = 0.22  # around the crop of the face, in its sides, for hair
_LABEL_PX = 22


def main() -> None:
    given = _arguments()
    photos = [path for entry in given.photos for path in _photos(entry)]
    if not photos:
        raise SystemExit(f"no photos in {', '.join(map(str, given.photos))}")
    rows = []
    for checkpoint in given.checkpoint or [None]:
        with tempfile.TemporaryDirectory() as scratch:
            relight(photos, checkpoint, given.envmap, Path(scratch))
            rows.append([_row(photo, Path(scratch), given.envmap, given.cell) for photo in photos])
    names = [f"{path.parent.name}/{path.stem}" if path else "" for path in given.checkpoint or [None]]
    sheet = [
        _labelled(row[i], _labels(photo, name, given.envmap), given.cell)
        for i, photo in enumerate(photos)
        for row, name in zip(rows, names, strict=True)
    ]
    given.output.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(sheet)).save(given.output)
    print(given.output)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("photos", type=Path, nargs="*", default=PHOTOS, help="photos, or folders of them")
    add("--checkpoint", type=Path, nargs="+", help="one or several to compare (default: the one shipped)")
    add("--envmap", type=Path, default=ENVMAP)
    add("--cell", type=int, default=256, help="side of a picture on the sheet, in pixels")
    add("-o", "--output", type=Path, default=Path("out/look.png"))
    return parser.parse_args()


def _photos(entry: Path) -> list[Path]:
    """A photo, or those of a folder."""
    if entry.is_dir():
        return sorted(path for path in entry.iterdir() if path.suffix.lower() in (".jpg", ".jpeg", ".png"))
    return [entry]


def relight(photos: list[Path], checkpoint: Path | None, envmap: Path, folder: Path) -> None:
    """Write every photo under every light to `folder`, a folder a photo, for names may be alike."""
    options = [word for lamp in LAMPS.values() for word in ("--light", lamp)] + ["--envmap", str(envmap)]
    options += ["--checkpoint", str(checkpoint)] if checkpoint else []
    for number, photo in enumerate(photos):
        out = folder / f"{photo.stem}-{number}"
        with redirect_stdout(io.StringIO()):  # the paths of what it wrote
            failed = facerf(["-q", "relight", str(photo), "-o", str(out), *options])
        if failed:
            raise SystemExit(f"{photo}: facerf relight failed")


def _row(photo: Path, folder: Path, envmap: Path, cell_px: int) -> list[np.ndarray]:
    """The photo and its six pictures [cell, cell, 3] uint8."""
    original = read_image(photo).pixels
    frame = _head(original, photo, cell_px)
    shots = [f"light_{lamp.replace(',', '_')}" for lamp in LAMPS.values()] + [envmap.stem]
    (own,) = (path for path in folder.iterdir() if path.name.rsplit("-", 1)[0] == photo.stem)
    relit = [read_image(own / f"{photo.stem}_{shot}.png").pixels for shot in shots]
    beyond = ~frame.valid(*original.shape[:2])
    shown = [_displayed(frame.apply(image)) for image in (original, *relit)]
    return [np.where(beyond[..., None], np.uint8(255), image) for image in shown]


def _head(photo: np.ndarray, path: Path, cell_px: int) -> Crop:
    """The square around the face, with room for hair."""
    face = from_landmarks(find_faces(photo, str(path))[0].landmarks_px, cell_px)
    room_px = _ROOM * face.side_px
    return Crop(face.x0_px - room_px, face.y0_px - room_px, face.side_px + 2 * room_px, cell_px)


def _displayed(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB of a linear picture, as files have it."""
    with tempfile.NamedTemporaryFile(suffix=".png") as file:
        write_display(Path(file.name), linear)
        return np.asarray(Image.open(file.name).convert("RGB"))


def _labels(photo: Path, checkpoint: str, envmap: Path) -> list[str]:
    return [f"{photo.stem}  {checkpoint}".strip(), *LAMPS, envmap.stem]


def _labelled(images: list[np.ndarray], labels: list[str], cell_px: int) -> np.ndarray:
    """A row of the sheet with words above its pictures."""
    row = Image.new("RGB", (cell_px * len(images), cell_px + _LABEL_PX), "white")
    draw = ImageDraw.Draw(row)
    for column, (image, label) in enumerate(zip(images, labels, strict=True)):
        row.paste(Image.fromarray(image), (column * cell_px, _LABEL_PX))
        draw.text((column * cell_px + 4, 5), label, fill="black")
    return np.asarray(row)


if __name__ == "__main__":
    main()
