"""Photographs of a colour chart, rendered: perspective, a camera's matrix, uneven light, noise, clutter."""

from collections.abc import Sequence

import numpy as np
from skimage.transform import resize

from facerf_cli.capture.chart import (
    COLUMNS,
    GREYS,
    PATCH_SIDE,
    PATCHES,
    ROWS,
    area_corners,
    homography,
    published_colours,
)
from facerf_cli.image.colour import luminance

SHAPE = (240, 330)
CORNERS = np.array([[60.0, 50], [270, 62], [262, 188], [52, 180]])  # dark skin's first, clockwise
CAMERA = np.array([[0.8, 0.25, 0.02], [0.1, 0.75, 0.1], [0.03, 0.22, 0.6]])  # from linear Rec.709
_FRAME, _FRAME_COLOUR = 0.25, 0.03  # of the pitch, beyond the patches' area
_SUPER = 3


def chart_image(
    corners_px: np.ndarray = CORNERS,
    shape: tuple[int, int] = SHAPE,
    matrix: np.ndarray | None = None,
    light: Sequence[float] = (1.0, 1.0),
    noise: float = 0.004,
    clutter: float = 0.0,
    seed: int = 0,
    exposure: float = 0.8,
) -> np.ndarray:
    """A picture [H, W, 3], float32, as a camera sees it that turns linear Rec.709 by `matrix` [3, 3].

    `light` is that at the left and the right edge of the picture; `noise` is a pixel's, of a colour of 1.
    """
    draw = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0] * _SUPER, : shape[1] * _SUPER] + 0.5
    from_grid = homography(area_corners(), corners_px)
    grid = from_grid.inverse(np.stack([x, y], -1).reshape(-1, 2) / _SUPER).reshape(*x.shape, 2)
    cell = np.rint(grid).astype(int)
    board = ((grid > -0.5 - _FRAME) & (grid < [COLUMNS - 0.5 + _FRAME, ROWS - 0.5 + _FRAME])).all(-1)
    inside = ((cell >= 0) & (cell < [COLUMNS, ROWS])).all(-1) & (np.abs(grid - cell) < PATCH_SIDE / 2).all(-1)
    place = (cell[..., 1] * COLUMNS + cell[..., 0]).clip(0, PATCHES - 1)
    scene = background(draw, grid.shape[:2], clutter)
    scene = np.where(board[..., None], _FRAME_COLOUR, scene)
    scene = np.where((board & inside)[..., None], published_colours()[place], scene)
    small = scene.reshape(shape[0], _SUPER, shape[1], _SUPER, 3).mean((1, 3))
    lit = exposure * small * np.linspace(*light, shape[1])[:, None]
    seen = lit @ (np.eye(3) if matrix is None else matrix).T
    shot = noise * np.sqrt(np.abs(seen) + 0.01)
    return (seen + shot * draw.standard_normal(seen.shape)).astype(np.float32)


def background(draw: np.random.Generator, shape: tuple[int, int], clutter: float) -> np.ndarray:
    """A grey wall [H, W, 3] and `clutter` of rectangles and cloudy colours on it."""
    wall = np.full((*shape, 3), 0.25)
    if not clutter:
        return wall
    cloud = resize(draw.uniform(0.05, 0.8, (5, 7, 3)), (*shape, 3), order=1)
    scene = wall + clutter * (cloud - wall)
    for _ in range(round(30 * clutter)):
        top, left = draw.integers(0, shape[0]), draw.integers(0, shape[1])
        size = draw.integers(shape[0] // 30, shape[0] // 4, 2)
        scene[top : top + size[0], left : left + size[1]] = draw.uniform(0, 0.9, 3)
    return scene


def kept_luminance(camera: np.ndarray) -> np.ndarray:
    """The inverse [3, 3] of a camera's matrix that leaves the luminance of the chart's greys."""
    greys = published_colours()[GREYS].sum(0)
    return np.linalg.inv(camera) * luminance(camera @ greys) / luminance(greys)
