"""Where the 24 patches of a ColorChecker Classic lie between four corners, and what colours they have.

Patches are numbered as the chart is read: six a row, from dark skin to black. Pixel centres lie at
index + 0.5.
"""

import math
from dataclasses import dataclass

import numpy as np
from skimage.draw import polygon

ROWS, COLUMNS = 4, 6
PATCHES = ROWS * COLUMNS
GREYS = slice(18, 24)  # white to black, the last row
PATCH_SIDE = 0.87  # of the pitch of the grid; the rest is the chart's black frame
_SIGMA_OF_MAD = 1.4826
_AT_WHITE = 1e-4
MIDDLE_SIDE = 0.45  # of the pitch: what is sampled, away from edges and from corners that sit badly


@dataclass(frozen=True, eq=False)
class Patches:
    """The middles of the patches."""

    colours: np.ndarray  # [24, 3] medians, float64
    counts: np.ndarray  # [24] pixels in each
    noise: np.ndarray  # [24] spread of a pixel's green, robust
    at_white: np.ndarray  # [24] share of the pixels of which a channel is 1, which is white in integers


def centres() -> np.ndarray:
    """Of the patches [24, 2] on the grid whose pitch is 1: column, row."""
    row, column = np.divmod(np.arange(PATCHES), COLUMNS)
    return np.stack([column, row], -1).astype(float)


def area_corners() -> np.ndarray:
    """The corners [4, 2] of the patches' area on that grid, clockwise from dark skin's."""
    half, right, bottom = PATCH_SIDE / 2, COLUMNS - 1, ROWS - 1
    return np.array(
        [[-half, -half], [right + half, -half], [right + half, bottom + half], [-half, bottom + half]]
    )


def homography(points: np.ndarray, images: np.ndarray) -> np.ndarray:
    """The matrix [3, 3] that takes points [N, 2] to their images [N, 2], 4 or more, by least squares.

    Hartley and Zisserman, 'Multiple View Geometry', algorithm 4.2: images are centred and scaled first.
    """
    middle, scale = images.mean(0), max(float(images.std()), 1e-9)
    x, y = points.T
    u, v = ((images - middle) / scale).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows = [
        np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], -1),
        np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], -1),
    ]
    matrix = np.linalg.svd(np.concatenate(rows))[2][-1].reshape(3, 3)
    back = np.array([[scale, 0, middle[0]], [0, scale, middle[1]], [0, 0, 1]])
    return back @ matrix


def project(grid_to_px: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points [..., 2] through a homography [3, 3]."""
    mapped = points @ grid_to_px[:, :2].T + grid_to_px[:, 2]
    return mapped[..., :2] / mapped[..., 2:]


def squares_px(corners_px: np.ndarray, side: float = MIDDLE_SIDE) -> np.ndarray:
    """The middle of each patch as a quadrilateral [24, 4, 2], where the patches' area has these corners."""
    square = side / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return project(homography(area_corners(), corners_px), centres()[:, None] + square)


def sample(pixels: np.ndarray, corners_px: np.ndarray) -> Patches:
    """The patches of a picture [H, W, 3] between corners [4, 2]; one without pixels counts 0 and is black."""
    colours, counts = np.zeros((PATCHES, 3)), np.zeros(PATCHES, int)
    noise, at_white = np.zeros(PATCHES), np.zeros(PATCHES)
    for place, square in enumerate(squares_px(corners_px) - 0.5):
        inside = pixels[polygon(square[:, 1], square[:, 0], pixels.shape[:2])]
        if not len(inside):
            continue
        colours[place], counts[place] = np.median(inside, 0), len(inside)
        noise[place] = _SIGMA_OF_MAD * np.median(np.abs(inside[:, 1] - colours[place, 1]))
        at_white[place] = (np.abs(inside - 1) < _AT_WHITE).any(-1).mean()
    return Patches(colours, counts, noise, at_white)


def shrunk(pixels: np.ndarray, side_px: int) -> tuple[np.ndarray, int]:
    """A picture [H, W, 3] no longer than `side_px`, squares of its pixels averaged to one, and their side.

    One that is too thin for such squares stays longer.
    """
    scale = min(math.ceil(max(pixels.shape[:2]) / side_px), *pixels.shape[:2])
    height, width = (side // scale for side in pixels.shape[:2])
    blocks = pixels[: height * scale, : width * scale].reshape(height, scale, width, scale, 3)
    return blocks.mean((1, 3), dtype=np.float32), scale


def four_turns(corners_px: np.ndarray) -> list[np.ndarray]:
    """The corners [4, 2] clockwise on the screen, beginning with each of them."""
    rolled = np.roll(corners_px, -1, 0)
    area = (corners_px[:, 0] * rolled[:, 1] - rolled[:, 0] * corners_px[:, 1]).sum()
    clockwise = corners_px if area > 0 else corners_px[::-1]
    return [np.roll(clockwise, -turn, 0) for turn in range(4)]


def is_convex(corners_px: np.ndarray) -> bool:
    """Whether the corners [4, 2], in turn, go round a convex quadrilateral."""
    edges = np.roll(corners_px, -1, 0) - corners_px
    ahead = np.roll(edges, -1, 0)
    bends = edges[:, 0] * ahead[:, 1] - edges[:, 1] * ahead[:, 0]
    return bool((bends > 0).all() or (bends < 0).all())
