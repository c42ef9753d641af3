"""How well the matrix of a colour chart corrects, by corners as a hand gives them.

    python benchmarks/colour_charts.py [--images 300] [--sheet charts.png]

Images are rendered: charts of 15 to 85 % of an image's width, in any rotation, tilted up to 40 degrees,
blurred, noisy, with vignetting, under light that falls off, in front of walls, clouds of colour and
rectangles, by cameras whose colours are up to a quarter off. Corners are off by up to a tenth of a patch.
The matrix is judged by the published colours, as the camera sees them without noise, corrected. Naive twin:
no matrix.
"""

import sys
from pathlib import Path

import numpy as np
from _common import ROOT, arguments
from scipy import ndimage
from scipy.spatial.transform import Rotation

from facerf_cli.capture.chart import (
    PATCH_SIDE,
    area_corners,
    delta_e_2000,
    fit_colours,
    neutral_matrix,
    outline_patches,
    published_colours,
    sample,
    squares_px,
)
from facerf_cli.files.sheets import contact_sheet
from facerf_cli.files.write import write_display

sys.path.insert(0, str(ROOT))  # the renderer of charts is the tests'
from tests.capture.chart_image import chart_image

SHAPE = (360, 480)
_DISTANCE = 2.5  # of the camera, in widths of the chart
_SHOWN = 12  # images on the sheet
OFF = 0.1  # of a patch's side, of a corner that a hand gives


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--images", type=int, default=60)
    parser.add_argument("--sheet", type=Path, help="an image of some, with the sampled patches outlined")
    given = parser.parse_args()
    rows, tiles = [], []
    for seed in range(given.images):
        image, corners_px, camera = draw_photo(seed)
        clicked_px = corners_px + np.random.default_rng(seed).uniform(-1, 1, (4, 2)) * OFF * side_px(
            corners_px
        )
        rows.append((side_px(corners_px), *errors(image, clicked_px, camera)))
        if len(tiles) < _SHOWN:
            tiles.append(outline_patches(image, clicked_px))
    print(summary(np.array(rows)))
    if given.sheet:
        write_display(given.sheet, contact_sheet(np.stack(tiles)))


def draw_photo(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render an image [H, W, 3] of a chart; its corners [4, 2] and the camera's matrix [3, 3]."""
    draw = np.random.default_rng(seed)
    corners_px = draw_corners(draw)
    camera = np.eye(3) + np.where(np.eye(3), 0.25, 0.15) * draw.uniform(-1, 1, (3, 3))
    light = np.exp(draw.uniform(-0.25, 0.25, 2)).tolist()
    noise, clutter = draw.uniform(0.002, 0.02), draw.uniform(0, 1)
    image = chart_image(corners_px, SHAPE, camera, light, noise, clutter, seed)
    blurred = ndimage.gaussian_filter(image, (*[draw.uniform(0, 1.2)] * 2, 0))
    y, x = (np.linspace(-1, 1, side) for side in SHAPE)
    return blurred * (1 - 0.15 * (y[:, None, None] ** 2 + x[:, None] ** 2)), corners_px, camera


def draw_corners(draw: np.random.Generator) -> np.ndarray:
    """Draw the corners [4, 2] of a rotated, tilted chart that lies within the image with its frame."""
    corners = (area_corners() - area_corners().mean(0)) / np.ptp(area_corners()[:, 0])
    angles = (draw.uniform(-180, 180), *draw.uniform(-40, 40, 2))
    turned = Rotation.from_euler("zxy", angles, degrees=True).apply(np.c_[corners, np.zeros(4)])
    seen = turned[:, :2] / (1 + turned[:, 2:] / _DISTANCE)
    room = np.array(SHAPE[::-1]) / (np.ptp(seen, axis=0) * 1.2)
    seen *= min(draw.uniform(0.15, 0.85) * SHAPE[1], *room)
    low, high = 1.1 * seen.min(0), 1.1 * seen.max(0)
    return seen - low + draw.uniform(0, 1, 2) * (SHAPE[::-1] - (high - low))


def side_px(corners_px: np.ndarray) -> float:
    """The smallest side of a patch in pixels."""
    patches = squares_px(corners_px, PATCH_SIDE)
    return float(np.linalg.norm(patches - np.roll(patches, 1, 1), axis=-1).min())


def errors(image: np.ndarray, corners_px: np.ndarray, camera: np.ndarray) -> list[float]:
    """Mean delta E 2000 of the published colours as a camera sees them, before and after the correction."""
    seen, published = published_colours() @ camera.T, published_colours()
    matrix = fit_colours(sample(image, corners_px).colours).matrix
    return [
        float(delta_e_2000(colours / neutral_matrix(colours, published)[1], published).mean())
        for colours in (seen, seen @ matrix.T)
    ]


def summary(rows: np.ndarray) -> str:
    """Lines of the errors, by the size of a patch."""
    lines = []
    for low, high in ((0, 5), (5, 8), (8, 12), (12, 20), (20, 999)):
        _, before, after = rows[(rows[:, 0] >= low) & (rows[:, 0] < high)].T
        if len(after):
            lines.append(
                f"patches of {low} to {high} px, {len(after)} images: mean delta E 2000 {before.mean():.1f} "
                f"before, {after.mean():.2f} after; worst image {before.max():.1f}, {after.max():.2f}"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
