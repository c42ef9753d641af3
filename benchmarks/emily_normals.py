"""Normals of a real scanned head: mean angle to the truth, and sharpness, by view.

    python benchmarks/emily_normals.py [--emily DIR] [--given] [--checkpoint FILE]

DIR holds seven views of the Wikihuman Project's Digital Emily 2 (MIT, github.com/hpd/DigitalEmily), half
as large as its renders: `view_N.jpg`, and `truth_N.npz` from its mesh through the scene's cameras: `normal`
[H, W, 3] int8 / 127 in camera space, `face` [H, W] within 9 cm of the tip of the nose. Sharpness is the mean
change of the normal between neighbours in the face over the truth's. `--given` gives `fit` the true normals,
with y down and z away from the camera, and adds how far they change images of single lights: the mean
difference of display values in the face and in the rest, of 255.
"""

from pathlib import Path

import numpy as np
from _common import SHARED, arguments, print_header, print_row, required
from PIL import Image

from facerf_cli import Light, fit, load_models
from facerf_cli.files.read import read_image
from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.relighting.models import Models

VIEWS = range(1, 8)
LIGHTS = ((-60, 20), (60, 20), (-30, 45), (30, 45), (0, 70), (0, -20))  # azimuth and elevation, degrees
_BLACK = 10  # of 255: darker pixels show nothing


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--emily", type=Path, help="folder of the views")
    parser.add_argument("--given", action="store_true", help="give the true normals")
    parser.add_argument(
        "--checkpoint", type=Path, nargs="*", default=[], help="networks in place of the shipped"
    )
    given = parser.parse_args()
    models = load_models(given.checkpoint)
    folder = required(given.emily, "views of Digital Emily", "--emily", SHARED / "bench" / "emily")
    images = ("face's images, of 255", "rest's") if given.given else ()
    print_header("view", "face, degrees", "rest, degrees", "sharpness", *images)
    rows = [measured(models, folder, view, given.given) for view in VIEWS]
    for view, row in (*zip(VIEWS, rows, strict=True), ("mean", np.mean(rows, 0))):
        print_row(str(view), *(f"{value:.2f}" for value in row))


def measured(models: Models, folder: Path, view: int, given: bool) -> tuple[float, ...]:
    """Mean angles in degrees over the face and the rest, the sharpness in the face, and changes of images."""
    path = folder / f"view_{view}.jpg"
    photo, file = read_image(path).pixels, np.load(folder / f"truth_{view}.npz", allow_pickle=False)
    truth, known = unit(file["normal"].astype(np.float32))
    person = fit(models, photo)
    better = fit(models, photo, normals=truth * np.array([1, -1, -1], np.float32)) if given else person
    found, seen = unit(better.normals)
    shown = known & seen & (truth[..., 2] > 0.1) & (np.asarray(Image.open(path).convert("L")) > _BLACK)
    away_deg = np.degrees(np.arccos((found * truth).sum(-1).clip(-1, 1)))
    face = shown & file["face"]
    steps = [change(normals, face) for normals in (found, truth)]
    angles = away_deg[face].mean(), away_deg[shown & ~file["face"]].mean(), steps[0] / steps[1]
    if not given:
        return angles
    lights = [np.pi * Light.single(*light) for light in LIGHTS]
    pairs = zip(person.relight(lights), better.relight(lights), strict=True)
    away = np.mean([np.abs(np.subtract(*map(shown_255, pair))).mean(-1) for pair in pairs], 0)
    return *angles, away[face].mean(), away[shown & ~file["face"]].mean()


def shown_255(image: np.ndarray) -> np.ndarray:
    """Display values [H, W, 3] in 0..255 of scene-linear ones."""
    return 255 * linear_to_srgb(image.clip(0, 1))


def unit(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors [H, W, 3], and where there are any [H, W]."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, 1e-6), length[..., 0] > 0.3


def change(normals: np.ndarray, mask: np.ndarray) -> float:
    """Mean change from a pixel to its neighbour on the right, both inside."""
    steps = np.linalg.norm(np.diff(normals, axis=1), axis=-1)
    return float(steps[mask[:, 1:] & mask[:, :-1]].mean())


if __name__ == "__main__":
    main()
