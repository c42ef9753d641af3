"""How often a colour chart is found in a picture, how well it corrects, and what else is taken for one.

    python benchmarks/colour_charts.py --pictures 300 --sheet charts.png
    python benchmarks/colour_charts.py --photos PICTURE ... --sheet charts.png

Pictures are rendered: charts of 15 to 85 % of a picture's width, turned any way, tilted up to 40 degrees, out
of focus, noisy, with vignetting, under light that falls off, before walls, clouds of colour and rectangles;
by cameras whose colours are up to a quarter off. As many pictures have such surroundings and no chart.
What the matrix is worth is told by the published colours, as the camera sees them without noise, corrected.
Real photographs (sRGB, or as their files say) have no truth: what is left of delta E after the fit is told.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation
from skimage.transform import resize

from facerf_cli.capture.chart_colours import delta_e_2000, fit_colours, neutral_matrix, published_colours
from facerf_cli.capture.chart_patches import PATCH_SIDE, area_corners, sample, squares_px
from facerf_cli.capture.colour_chart import outline_patches
from facerf_cli.capture.find_chart import find_chart
from facerf_cli.files.drawings import contact_sheet
from facerf_cli.files.images import read_image, write_display

sys.path.insert(0, str(Path(__file__).parents[1]))  # the renderer is the tests'
from tests.capture.chart_image import background, chart_image

SHAPE = (360, 480)
_DISTANCE = 2.5  # of the camera, in widths of the chart
_SHOWN = 12


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--pictures", type=int, default=60)
    parser.add_argument("--sheet", type=Path, help="a picture of some, with what was sampled outlined")
    parser.add_argument(
        "--photos", type=Path, nargs="+", help="photographs in the place of rendered pictures"
    )
    options = parser.parse_args()
    tiles = [told(path) for path in options.photos] if options.photos else counted(options.images)
    if options.sheet:
        sized = [resize(tile, (*SHAPE, 3), anti_aliasing=True) for tile in tiles[:_SHOWN]]
        write_display(options.sheet, contact_sheet(np.stack(sized)))


def told(path: Path) -> np.ndarray:
    """A photograph [H, W, 3], outlined, after a line of what is found in it."""
    image = read_image(path).pixels
    found = find_chart(image)
    if found is None:
        print(f"{path.name}: not found")
        return image
    fit = fit_colours(sample(image, found).colours)
    before, after = fit.delta_e_before.mean(), fit.delta_e_after.mean()
    print(f"{path.name}: found; mean delta E 2000 {before:.1f} before, {after:.1f} after the fit")
    return outline_patches(image, found)


def counted(images: int) -> list[np.ndarray]:
    """Rendered pictures [H, W, 3], outlined, after lines of what is found in all."""
    rows, tiles, seconds = [], [], 0.0
    for seed in range(images):
        image, corners_px, camera = draw_photograph(seed)
        begun_s = time.perf_counter()
        found = find_chart(image)
        seconds += time.perf_counter() - begun_s
        rows.append(figures(image, corners_px, camera, found))
        tiles += [image if found is None else outline_patches(image, found)]
    print(summary(np.array(rows)), f"{seconds / images:.2f} s a picture", sep="\n")
    false = sum(find_chart(surroundings(seed)) is not None for seed in range(images))
    print(f"without a chart: {false} of {images} pictures taken for one")
    return tiles


def draw_photograph(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture [H, W, 3] of a chart, its corners [4, 2] and the camera's matrix [3, 3]."""
    draw = np.random.default_rng(seed)
    corners_px = draw_corners(draw)
    camera = np.eye(3) + np.where(np.eye(3), 0.25, 0.15) * draw.uniform(-1, 1, (3, 3))
    light = np.exp(draw.uniform(-0.25, 0.25, 2))
    noise, clutter = draw.uniform(0.002, 0.02), draw.uniform(0, 1)
    image = chart_image(corners_px, SHAPE, camera, light, noise, clutter, seed)
    blurred = ndimage.gaussian_filter(image, (*[draw.uniform(0, 1.2)] * 2, 0))
    y, x = (np.linspace(-1, 1, side) for side in SHAPE)
    return blurred * (1 - 0.15 * (y[:, None, None] ** 2 + x[:, None] ** 2)), corners_px, camera


def draw_corners(draw: np.random.Generator) -> np.ndarray:
    """Of a chart [4, 2] that is turned, tilted, and wholly in the picture with its frame."""
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
        f"mean delta E 2000 of a picture's 24 colours: {before.mean():.1f} before, {after.mean():.2f} after;"
    )
    lines.append(f"the worst picture's {before.max():.1f} before, {after.max():.2f} after")
    return "\n".join(lines)


def surroundings(seed: int) -> np.ndarray:
    """A picture [H, W, 3] without a chart."""
    draw = np.random.default_rng(10_000 + seed)
    return background(draw, SHAPE, draw.uniform(0, 1)).astype(np.float32)


if __name__ == "__main__":
    main()
