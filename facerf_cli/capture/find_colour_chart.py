"""Where the 24 patches of a ColorChecker Classic lie between four corners, and what colours they have.

Patches are numbered as the chart is read: six a row, from dark skin to black. Pixel centres lie at
index + 0.5.

The published colours of the ColorChecker Classic, and the matrix that takes a camera's to them.

The matrix is the least squares' among those that keep neutral colours neutral (Finlayson and Drew 1997,
'Constrained least-squares regression in color spaces'). Light that falls off over the chart is fitted beside
it in turn, as a plane in the logarithm of brightness, after Finlayson et al. 2015, 'The alternating least
squares technique for nonuniform intensity color correction'.

Points that lie on a grid, seen in perspective: from one point and its neighbours outward.

Looks for a ColorChecker Classic in a picture: even spots on a grid whose colours are the chart's.

The colours decide: a grid of other things is no chart, so what is found may be believed, and what is not
found (small, dim, half hidden) has to be said. `benchmarks/colour_charts.py` counts both.
"""

import importlib
import math
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import permutations
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.draw import polygon
from skimage.measure import label, regionprops

from facerf_cli.colour import lab_d65, luminance
from facerf_cli.errors import FacerfError

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


CHART_NAME = "ColorChecker24 - After November 2014"
_TURNS = 12  # of matrix and light; 12 leave less than a thousandth
_STEEPEST = 0.3  # of the light's logarithm from patch to patch: what is more is no chart
_LARGEST_COLOUR_RATIO, _LEAST_LEVEL = 1e3, 1e-9


@dataclass(frozen=True, eq=False)
class ColourFit:
    """How 24 measured colours become the chart's."""

    matrix: np.ndarray  # [3, 3]; keeps the luminance of neutral colours
    even: np.ndarray  # [24, 3] the measured colours, evenly lit and as bright as the chart's
    light: np.ndarray  # [24] the light at each patch
    delta_e_before: np.ndarray  # [24] CIE 2000
    delta_e_after: np.ndarray  # [24]


@cache
def colour_science() -> Any:
    """The package, which the type checker need not know; a user sees nothing of its import.

    It comes with the extra `chart`; a FacerfError says so where it is missing.
    """
    try:
        with np.printoptions(), warnings.catch_warnings(), _without("OpenImageIO"):
            warnings.simplefilter("ignore")  # it warns of optional packages that are not there
            return importlib.import_module("colour")
    except ImportError:
        raise FacerfError("--colour-chart needs colour-science; run pip install 'facerf[chart]'") from None


@contextmanager
def _without(name: str) -> Iterator[None]:
    """Hide a module from what is imported in the block.

    colour-science would hold types of OpenImageIO, which it prints as leaks when the program ends.
    """
    modules: dict[str, Any] = sys.modules
    hidden = modules.get(name)
    modules[name] = None  # Python's own way to say that there is none
    try:
        yield
    finally:
        del modules[name]
        if hidden is not None:
            modules[name] = hidden


@cache
def published_colours() -> np.ndarray:
    """Of the chart [24, 3] in linear Rec.709 under D65, by X-Rite's values under D50 and Bradford."""
    science = colour_science()
    chart = science.CCS_COLOURCHECKERS[CHART_NAME]
    xyz = science.xyY_to_XYZ(list(chart.data.values()))
    return np.asarray(science.XYZ_to_RGB(xyz, "ITU-R BT.709", chart.illuminant, "Bradford"), np.float64)


def fit_colours(measured: np.ndarray) -> ColourFit:
    """Fit the matrix and the light over the chart to measured colours [24, 3], linear Rec.709."""
    published = published_colours()
    weight = luminance(published)  # a dark patch has stray light in it
    plane = centres() - centres().mean(0)
    tilt = np.zeros(2)
    for _ in range(_TURNS):
        light = np.exp(plane @ tilt)
        even = measured / light[:, None]
        matrix, level = neutral_matrix(even, published)
        ratio = luminance(even @ matrix.T) / (level * weight)
        height = np.log(ratio.clip(1 / _LARGEST_COLOUR_RATIO, _LARGEST_COLOUR_RATIO))
        sloped = np.linalg.lstsq(np.c_[plane, np.ones(len(plane))] * weight[:, None], height * weight)[0]
        tilt = (tilt + sloped[:2]).clip(-_STEEPEST, _STEEPEST)
    even = even / level
    before, after = delta_e_2000(even, published), delta_e_2000(even @ matrix.T, published)
    return ColourFit(matrix, even, light, before, after)


def neutral_matrix(measured: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, float]:
    """The matrix [3, 3] that takes 24 colours [24, 3] to the wanted ones times a level, and that level.

    The sum of the greys becomes exactly what it should be, and keeps its luminance: so is the level set. Each
    row is the least-norm solution of that, and the least squares' in the two directions that it leaves free.
    """
    grey, wanted_grey = measured[GREYS].sum(0), wanted[GREYS].sum(0)
    level = max(float(luminance(grey) / luminance(wanted_grey)), _LEAST_LEVEL)
    along = level * np.outer(wanted_grey, grey) / max(float(grey @ grey), _LEAST_LEVEL**2)
    free = np.linalg.svd(grey[None])[2][1:]  # [2, 3], orthogonal to the greys
    left = level * wanted - measured @ along.T
    return along + np.linalg.lstsq(measured @ free.T, left)[0].T @ free, level


def delta_e_2000(linear: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """CIE delta E 2000 [N] of linear Rec.709 colours [N, 3] under D65; white is 1."""
    return np.asarray(colour_science().delta_E(lab_d65(linear), lab_d65(wanted), method="CIE 2000"))


Place = tuple[int, int]

_NEAREST = 6  # neighbours of a point that may be its grid's
_STEP_OF_SIDE = (0.9, 3.0)  # from point to point, in sides of what is at the point
_LARGEST_SIDE_RATIO = 2.0  # of sides, and of steps across to steps along
_LEAST_SINE = 0.8  # of the angle between steps along and across; a grid's diagonals have 0.7
_MISS = 0.25  # of a step, that a point may lie beside where it is looked for


def find_lattices(points: np.ndarray, sides: np.ndarray, least: int, reach: int) -> list[dict[Place, int]]:
    """Grids among points [N, 2] of things with sides [N]: index by place, `least` at least; the best first.

    Places count from the point that a grid was begun at, `reach` either way: along, then across, clockwise
    from it on the screen.
    """
    if len(points) < least:
        return []
    tree = cKDTree(points)
    found: dict[frozenset[int], dict[Place, int]] = {}
    done: set[int] = set()  # in a grid already
    for seed in range(len(points)):
        if seed in done:
            continue
        grown = [_grow(tree, sides, seed, reach, *steps) for steps in _steps(tree, sides, seed)]
        best = max(grown, key=_weight, default={})
        if len(best) >= least:
            found[frozenset(best.values())] = best
            done.update(best.values())
    return sorted(found.values(), key=_weight, reverse=True)


def _weight(grid: dict[Place, int]) -> float:
    """How many places a grid has, times how full it is: one grown along a diagonal has many and is not."""
    return len(grid) ** 2 / float(np.prod(np.ptp(list(grid), axis=0) + 1))


def _steps(tree: cKDTree, sides: np.ndarray, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of steps [2] from a point to two neighbours about square to each other, the second clockwise."""
    low, high = (share * sides[seed] for share in _STEP_OF_SIDE)
    off, near = tree.query(tree.data[seed], k=min(_NEAREST + 1, len(sides)))
    kept = near[(off > low) & (off < high) & _alike(sides[near], sides[seed])]
    for one, other in permutations(kept, 2):
        along, across = tree.data[one] - tree.data[seed], tree.data[other] - tree.data[seed]
        lengths = np.hypot(*along), np.hypot(*across)
        sine = (along[0] * across[1] - along[1] * across[0]) / (lengths[0] * lengths[1])
        if sine > _LEAST_SINE and _alike(*lengths):
            yield along, across


def _alike(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return (one < _LARGEST_SIDE_RATIO * other) & (other < _LARGEST_SIDE_RATIO * one)


def _grow(
    tree: cKDTree, sides: np.ndarray, seed: int, reach: int, along: np.ndarray, across: np.ndarray
) -> dict[Place, int]:
    """The grid that a point and two steps begin; each step is taken as long as the one before it was."""
    grid, steps = {(0, 0): seed}, {(0, 0): (along, across)}
    todo, members = [(0, 0)], {seed}
    while todo:
        place = todo.pop(0)
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            there = (place[0] + sign * (axis == 0), place[1] + sign * (axis == 1))
            if there in grid or max(map(abs, there)) > reach:
                continue
            step = steps[place][axis]
            start = tree.data[grid[place]]
            off, index = tree.query(start + sign * step)
            fits = off < _MISS * np.hypot(*step) and _alike(sides[index], sides[grid[place]])
            if index in members or not fits:
                continue
            members.add(index)
            taken = sign * (tree.data[index] - start)
            grid[there] = int(index)
            steps[there] = (taken, steps[place][1]) if axis == 0 else (steps[place][0], taken)
            todo.append(there)
    return grid


LARGEST_DELTA_E = 8.0  # mean of the patches'; a chart that was photographed well has 1 to 4
_SEARCHED_PX = 800  # a picture is made no longer than that
_EDGES = (0.01, 0.02, 0.04, 0.08)  # changes a pixel, of the encoded picture, that bound an even spot
_BRIGHT_PERCENTILE, _GAMMA = 99.0, 2.4
_LEAST_SPOT_PX, _LARGEST_SPOT = 16, 0.045  # the latter of the picture: a chart may fill it
_LEAST_FULL, _LONGEST = 0.68, 3.0  # area over the product of the axes, 0.75 for a rectangle; and their ratio
_LEAST_ON_GRID = 12  # of 24; the dark ones are lost in the chart's frame
_MOST_GRIDS = 4


def find_chart(pixels: np.ndarray) -> np.ndarray | None:
    """The corners [4, 2] of the patches' area, clockwise from dark skin's; None where no chart is seen.

    pixels [H, W, 3] are linear. The 24 colours are the chart's to a mean delta E of `LARGEST_DELTA_E`.
    """
    small, scale = shrunk(pixels, _SEARCHED_PX)
    points, sides = even_spots(small)
    grids = find_lattices(points, sides, _LEAST_ON_GRID, COLUMNS - 1)[:_MOST_GRIDS]
    tries = [
        (float(fit_colours(sample(small, turned).colours).delta_e_after.mean()), turned)
        for grid in grids
        for corners_px in _placed(grid, points)
        if ((corners_px > 0) & (corners_px < small.shape[1::-1])).all()
        for turned in four_turns(corners_px)[::2]
    ]
    delta_e, best = min(tries, key=lambda found: found[0], default=(np.inf, np.empty(0)))
    return best * scale if delta_e <= LARGEST_DELTA_E else None


def even_spots(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres [N, 2] and sides [N] in pixels of spots of one colour with an edge around them."""
    bright = max(float(np.percentile(pixels, _BRIGHT_PERCENTILE)), 1e-12)
    encoded = (pixels / bright).clip(0, 1) ** (1 / _GAMMA)
    slope = np.max([ndimage.gaussian_gradient_magnitude(encoded[..., c], 1.0) for c in range(3)], 0)
    centres, sides = np.zeros((0, 2)), np.zeros(0)
    for edge in _EDGES:
        for spot in _spots(slope < edge):
            centre, side = np.array(spot.centroid)[::-1] + 0.5, np.sqrt(spot.area)
            if not len(centres) or np.hypot(*(centres - centre).T).min() > side / 3:  # else known already
                centres, sides = np.r_[centres, centre[None]], np.r_[sides, side]
    return centres, sides


def _spots(even: np.ndarray) -> Iterator[Any]:
    """Connected parts of a mask [H, W] that are about as wide as long, and full."""
    for spot in regionprops(label(even, connectivity=1)):
        if not _LEAST_SPOT_PX <= spot.area <= _LARGEST_SPOT * even.size:
            continue
        long, short = spot.axis_major_length, spot.axis_minor_length
        if long < _LONGEST * short and spot.area > _LEAST_FULL * long * short:
            yield spot


def _placed(grid: dict[Place, int], points: np.ndarray) -> Iterator[np.ndarray]:
    """Where a chart can lie on a grid that shows only some of its patches: corners [4, 2] of each place."""
    places, images = np.array(list(grid)), points[list(grid.values())]
    for upright in (places, np.stack([places[:, 1], -places[:, 0]], -1)):  # on its side, the other way
        low, high = upright.min(0), upright.max(0) - [COLUMNS - 1, ROWS - 1]
        for first_column in range(min(low[0], high[0]), max(low[0], high[0]) + 1):
            for first_row in range(min(low[1], high[1]), max(low[1], high[1]) + 1):
                local = upright - [first_column, first_row]
                inside = ((local >= 0) & (local < [COLUMNS, ROWS])).all(-1)
                if inside.sum() >= _LEAST_ON_GRID:
                    matrix = homography(local[inside].astype(float), images[inside])
                    yield project(matrix, area_corners())
