"""Normals of a real scanned head: mean angle to the truth, and sharpness, by view.

    python benchmarks/emily_normals.py [--emily DIR]

DIR holds seven views of the Wikihuman Project's Digital Emily 2 (MIT, github.com/hpd/DigitalEmily), half
as large as its renders: `view_N.jpg`, and `truth_N.npz` from its mesh through the scene's cameras: `normal`
[H, W, 3] int8 / 127 in camera space, `face` [H, W] within 9 cm of the tip of the nose. Sharpness is the mean
change of the normal between neighbours in the face over the truth's.
"""

from pathlib import Path

import numpy as np
from _common import SHARED, arguments, print_header, print_row, required
from PIL import Image

from facerf_cli.api import fit, load_models
from facerf_cli.files.read import read_image

VIEWS = range(1, 8)
_BLACK = 10  # of 255: darker pixels show nothing


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--emily", type=Path, help="folder of the views")
    folder = required(
        parser.parse_args().emily, "views of Digital Emily", "--emily", SHARED / "bench" / "emily"
    )
    print_header("view", "face, degrees", "rest, degrees", "sharpness")
    rows = [measured(folder, view) for view in VIEWS]
    for view, row in (*zip(VIEWS, rows, strict=True), ("mean", np.mean(rows, 0))):
        print_row(str(view), *(f"{value:.2f}" for value in row))


def measured(folder: Path, view: int) -> tuple[float, float, float]:
    """Mean angles in degrees over the face and the rest, and the sharpness in the face."""
    models, path = load_models(), folder / f"view_{view}.jpg"
    photo, file = read_image(path).pixels, np.load(folder / f"truth_{view}.npz", allow_pickle=False)
    (found, seen), (truth, known) = unit(fit(models, photo).normals), unit(file["normal"].astype(np.float32))
    shown = known & seen & (truth[..., 2] > 0.1) & (np.asarray(Image.open(path).convert("L")) > _BLACK)
    away_deg = np.degrees(np.arccos((found * truth).sum(-1).clip(-1, 1)))
    face = shown & file["face"]
    steps = [change(normals, face) for normals in (found, truth)]
    return away_deg[face].mean(), away_deg[shown & ~file["face"]].mean(), steps[0] / steps[1]


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
