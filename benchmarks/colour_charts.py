"""How often a colour chart is found, how well its matrix corrects, and what else is taken for a chart.

    python benchmarks/colour_charts.py [--images 300] [--sheet charts.png]
    python benchmarks/colour_charts.py --photos IMAGE ... --sheet charts.png

Images are rendered: charts of 15 to 85 % of an image's width, in any rotation, tilted up to 40 degrees,
blurred, noisy, with vignetting, under light that falls off, in front of walls, clouds of colour and
rectangles, by cameras whose colours are up to a quarter off. As many images have no chart. The matrix is
judged by the published colours, as the camera sees them without noise, corrected. Naive twin: no matrix.
Photos have no truth; their delta E is what the fit leaves.
"""

import sys
import time
from pathlib import Path

import numpy as np
from _common import ROOT, arguments
from scipy import ndimage
from scipy.spatial.transform import Rotation
from skimage.transform import resize

from facerf_cli.capture.chart import (
    PATCH_SIDE,
    area_corners,
    delta_e_2000,
    fit_colours,
    neutral_matrix,
    published_colours,
    sample,
    squares_px,
)
from facerf_cli.capture.chart_photo import outline_patches
from facerf_cli.capture.chart_search import find_chart
from facerf_cli.files.read import read_image
from facerf_cli.files.sheets import contact_sheet
from facerf_cli.files.write import write_display

sys.path.insert(0, str(ROOT))  # the renderer of charts is the tests'
from tests.capture.chart_image import background, chart_image

SHAPE = (360, 480)
_DISTANCE = 2.5  # of the camera, in widths of the chart
_SHOWN = 12  # images on the sheet


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--images", type=int, default=60, help="with a chart, and as many without")
    parser.add_argument("--sheet", type=Path, help="an image of some, with the sampled patches outlined")
    parser.add_argument("--photos", type=Path, nargs="+", help="photos, in place of rendered images")
    given = parser.parse_args()
    tiles = [of_photo(path) for path in given.photos] if given.photos else of_rendered(given.images)
    if given.sheet:
        sized = [resize(tile, (*SHAPE, 3), anti_aliasing=True) for tile in tiles[:_SHOWN]]
        write_display(given.sheet, contact_sheet(np.stack(sized)))


def of_photo(path: Path) -> np.ndarray:
    """Print what is found in a photo; the photo [H, W, 3], outlined."""
    image = read_image(path).pixels
    found = find_chart(image)
    if found is None:
        print(f"{path.name}: not found")
        return image
    fit = fit_colours(sample(image, found).colours)
    before, after = fit.delta_e_before.mean(), fit.delta_e_after.mean()
    print(f"{path.name}: found; mean delta E 2000 {before:.1f} before, {after:.1f} after the fit")
    return outline_patches(image, found)


def of_rendered(images: int) -> list[np.ndarray]:
    """Print what is found in rendered images; these [H, W, 3], outlined."""
    rows, tiles, seconds = [], [], 0.0
    for seed in range(images):
        image, corners_px, camera = draw_photo(seed)
        begun_s = time.perf_counter()
        found = find_chart(image)
        seconds += time.perf_counter() - begun_s
        rows.append(figures(image, corners_px, camera, found))
        tiles += [image if found is None else outline_patches(image, found)]
    print(summary(np.array(rows)), f"{seconds / images:.2f} s an image", sep="\n")
    false = sum(find_chart(surroundings(seed)) is not None for seed in range(images))
    print(f"without a chart: {false} of {images} images taken for one")
    return tiles


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


def figures(
    image: np.ndarray, corners_px: np.ndarray, camera: np.ndarray, found: np.ndarray | None
) -> tuple[float, ...]:
    """A patch's smaller side in pixels, whether found, corners' error in patches, delta E before, after."""
    patches = squares_px(corners_px, PATCH_SIDE)
    side_px = float(np.linalg.norm(patches - np.roll(patches, 1, 1), axis=-1).min())
    if found is None:
        return side_px, 0, np.nan, np.nan, np.nan
    off = np.linalg.norm(found - corners_px, axis=-1).max() / side_px
    seen = published_colours() @ camera.T
    matrix = fit_colours(sample(image, found).colours).matrix
    errors = [
        delta_e_2000(colours / neutral_matrix(colours, published_colours())[1], published_colours()).mean()
        for colours in (seen, seen @ matrix.T)
    ]
    return side_px, 1, off, *errors


def summary(rows: np.ndarray) -> str:
    """Lines of how many are found, by the size of a patch, and of the errors of those."""
    lines = []
    for low, high in ((0, 5), (5, 8), (8, 12), (12, 20), (20, 999)):
        within = rows[(rows[:, 0] >= low) & (rows[:, 0] < high)]
        lines.append(f"patches of {low} to {high} px: {within[:, 1].sum():.0f} of {len(within)} found")
    _, _, off, before, after = rows[rows[:, 1] == 1].T
    lines.append(f"corners off by {np.median(off):.3f} of a patch (median), {off.max():.2f} (most)")
    lines.append(
        f"mean delta E 2000 of an image's 24 colours: {before.mean():.1f} before, {after.mean():.2f} after;"
    )
    lines.append(f"the worst image's {before.max():.1f} before, {after.max():.2f} after")
    return "\n".join(lines)


def surroundings(seed: int) -> np.ndarray:
    """Render an image [H, W, 3] without a chart."""
    draw = np.random.default_rng(10_000 + seed)
    return background(draw, SHAPE, draw.uniform(0, 1)).astype(np.float32)


if __name__ == "__main__":
    main()
