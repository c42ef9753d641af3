"""Colour corrections of a capture's cameras from photographs of a colour chart, and their control images.

A chart's image is treated like a frame: decoded by the capture's colour space, less the black level, divided
by the lights' rgb. The light on the chart counts as that of all lights, so it has their mean rgb at luminance
1. Implausible charts are refused.

Without corners, the chart is searched for: spots of one colour on a grid, with the chart's colours. The
colours decide, so other grids are not mistaken for a chart; a chart that is small, dim or half hidden may be
missed. `benchmarks/colour_charts.py` counts both errors.
"""

import hashlib
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.draw import polygon
from skimage.measure import label, regionprops

from facerf_cli.capture.capture import Capture, ChartCorrection, correct_colours, read_frame
from facerf_cli.capture.chart import (
    COLUMNS,
    GREYS,
    MIDDLE_SIDE,
    ROWS,
    ColourFit,
    Patches,
    area_corners,
    fit_colours,
    four_turns,
    homography,
    is_convex,
    project,
    published_colours,
    sample,
    shrunk,
    squares_px,
)
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.images import write_display
from facerf_cli.image.colour import luminance

CAMERA_FIELD = "{camera}"
# Thresholds beyond which a chart's image is refused.
_LEAST_PX = 25  # in the middle of a patch
_LARGEST_NOISE = 0.25  # of a pixel, as a share of the white patch
_LEAST_CHROMA = 0.02  # of a chart's colours; red and blue reach 1 and more
_CLIPPED_SHARE = 0.3  # of a patch's pixels
_CLIPPED_WHITE, _CLIPPED_CHANNEL = (
    0.85,
    0.93,
)  # of the white that the darker greys predict; of another channel
_EXPONENTS = (0.8, 1.25)  # of the greys' brightness over the published one
# Control images.
_SIDE_PX = 1024  # fits a screen
_SQUARES = (MIDDLE_SIDE + 0.08, MIDDLE_SIDE, MIDDLE_SIDE / 2)  # sides of outline, sample and published colour
LARGEST_DELTA_E = 8.0  # mean of the 24 patches; good photographs of a chart have 1 to 4
# The search for spots.
_SEARCHED_PX = 800  # longest side of the searched image
_EDGES = (0.01, 0.02, 0.04, 0.08)  # of the encoded image, change per pixel that ends a spot
_BRIGHT_PERCENTILE, _GAMMA = 99.0, 2.4  # of that encoding
_LEAST_SPOT_PX, _LARGEST_SPOT = 16, 0.045  # area in pixels; share of the image, which a chart may fill
_LEAST_FULL, _LONGEST = 0.68, 3.0  # area over the product of the axes (rectangle: 0.75); ratio of the axes
# The search for grids.
_LEAST_ON_GRID = 12  # of 24; dark patches merge with the chart's frame
_MOST_GRIDS = 4
_NEAREST = 6  # neighbours of a point that are tried
_STEP_OF_SIDE = (0.9, 3.0)  # distance of neighbours over the side of a spot
_LARGEST_SIDE_RATIO = 2.0  # of sides of neighbours, and of steps across to steps along
_LEAST_SINE = 0.8  # of the angle between steps along and across; the diagonals of a grid have 0.7
_MISS = 0.25  # of a step: largest distance of a point from its predicted place

Place = tuple[int, int]


def read_charts(capture: Capture, image: str, corners_px: np.ndarray | None) -> Iterator[ChartCorrection]:
    """Yield the corrections from one image for all cameras, or from one per camera with {camera} in its name.

    corners_px [4, 2] are those of the patches' area, in order around it; None searches for the chart.
    InputError for an image without a usable chart, UsageError for corners with several images.
    """
    if CAMERA_FIELD not in image:
        yield _read_chart(capture, Path(image), tuple(capture.cameras), corners_px, "colour_chart.png")
        return
    if corners_px is not None:
        raise UsageError(
            f"--chart-corners: --colour-chart {image} names an image per camera; omit --chart-corners"
        )
    for camera in capture.cameras:
        named = Path(image.replace(CAMERA_FIELD, camera))
        yield _read_chart(capture, named, (camera,), None, f"colour_chart_{camera}.png")


def _normalise(capture: Capture, decoded: np.ndarray) -> np.ndarray:
    """Subtract the black level from values [..., 3], and divide by the lights' mean rgb at luminance 1."""
    mean = capture.intensities.mean(0)
    return (decoded - capture.black_level) / (mean / luminance(mean)).astype(decoded.dtype)


def _read_chart(
    capture: Capture, image: Path, cameras: tuple[str, ...], corners_px: np.ndarray | None, overlay: str
) -> ChartCorrection:
    raw = read_frame(image, capture.colour_space)
    if corners_px is None:
        corners_px = find_chart(_normalise(capture, raw))
        if corners_px is None:
            raise InputError(
                f"{image}: no ColorChecker Classic found; give the corners of its 24 patches with "
                "--chart-corners 'x,y x,y x,y x,y'"
            )
    _require_quadrilateral(image, raw, corners_px)
    tries = []
    for turned in four_turns(corners_px):
        patches = sample(raw, turned)
        fit = fit_colours(_normalise(capture, patches.colours))
        tries.append((float(fit.delta_e_after.mean()), turned, patches, fit))
    _, corners_px, patches, fit = min(tries, key=lambda found: found[0])
    _require_light(image, patches, capture.black_level)
    _require_chart(image, patches, fit, capture.colour_space)
    return ChartCorrection(
        image=image,
        image_sha256=hashlib.sha256(image.read_bytes()).hexdigest(),
        cameras=cameras,
        corners_px=_rows(corners_px, 2),
        matrix=_rows(fit.matrix, 6),  # rounded, so that datasets agree between processors
        delta_e_before=_mean_and_max(fit.delta_e_before),
        delta_e_after=_mean_and_max(fit.delta_e_after),
        light_span=round(float(fit.light.max() / fit.light.min()), 3),
        overlay=overlay,
    )


def _rows(values: np.ndarray, digits: int) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(round(float(value), digits) for value in row) for row in values)


def _mean_and_max(delta_e: np.ndarray) -> tuple[float, float]:
    return round(float(delta_e.mean()), 2), round(float(delta_e.max()), 2)


def _require_quadrilateral(image: Path, raw: np.ndarray, corners_px: np.ndarray) -> None:
    height, width = raw.shape[:2]
    if not ((corners_px >= 0) & (corners_px <= [width, height])).all():
        raise InputError(f"{image}: --chart-corners lie outside its {width} x {height} pixels; correct them")
    if not is_convex(corners_px):
        raise InputError(
            f"{image}: --chart-corners make no convex quadrilateral; give them in order around the chart"
        )


def _require_light(image: Path, patches: Patches, black_level: float) -> None:
    """Raise for patches that are too small, dark, noisy, clipped or grey to measure."""
    if patches.counts.min() < _LEAST_PX:
        raise InputError(
            f"{image}: a patch of the chart has only {patches.counts.min()} pixels in its middle; "
            f"photograph it larger, {_LEAST_PX} are needed"
        )
    greys = patches.colours[GREYS]
    brightest = (greys - black_level).max(0)
    if brightest.min() <= 0 or patches.noise[GREYS].max() > _LARGEST_NOISE * brightest[1]:
        raise InputError(f"{image}: the chart is too dark, or too noisy; expose it longer")
    clipped = int((patches.at_white > _CLIPPED_SHARE).sum())
    header = read_header(image) if clipped else None
    if header and not header.is_floating:  # floating-point values may exceed 1
        raise InputError(f"{image}: {clipped} of the chart's patches are clipped at white; expose it less")
    spread = np.ptp(patches.colours, -1) / greys.max()
    if spread.max() < _LEAST_CHROMA:
        raise InputError(f"{image}: is grey; give a photograph in colour")


def _require_chart(image: Path, patches: Patches, fit: ColourFit, colour_space: str) -> None:
    """Raise for colours that are not those of a chart, not linear, or clipped."""
    mean = fit.delta_e_after.mean()
    if mean > LARGEST_DELTA_E:
        raise InputError(
            f"{image}: the patches' colours differ from a ColorChecker Classic's by a mean CIE delta E 2000 "
            f"of {mean:.0f}; check the corners and the colour space '{colour_space}'"
        )
    greys, published = luminance(fit.even[GREYS]), luminance(published_colours()[GREYS])
    lit = slice(0, -1)  # stray light distorts black
    exponent = np.polyfit(np.log(published[lit]), np.log(greys[lit].clip(1e-6)), 1)[0]
    if not _EXPONENTS[0] < exponent < _EXPONENTS[1]:
        raise InputError(
            f"{image}: the chart's greys are not linear (they follow their power {exponent:.2f}); check the "
            f"colour space '{colour_space}', and look for a shadow or highlight on them"
        )
    values, wanted = fit.even[GREYS], published_colours()[GREYS]
    slopes = (values[1:4] * wanted[1:4]).sum(0) / (wanted[1:4] ** 2).sum(0)
    white = values[0] / (slopes * wanted[0])  # [3]; 1 in proportion to the darker greys
    if white.min() < max(_CLIPPED_WHITE, _CLIPPED_CHANNEL * white.max()):
        raise InputError(f"{image}: the chart's white patch is clipped; expose it less")


def write_chart_overlays(capture: Capture, folder: Path) -> None:
    """Write the control image of each chart under its name `ChartCorrection.overlay`."""
    for chart in capture.charts:
        write_display(folder / chart.overlay, chart_overlay(capture, chart))


def chart_overlay(capture: Capture, chart: ChartCorrection) -> np.ndarray:
    """Corrected image [h, w, 3] of a chart, linear and of screen size, with its samples outlined."""
    linear = _normalise(capture, read_frame(chart.image, capture.colour_space))
    small, scale = shrunk(correct_colours([chart], chart.cameras[0], linear), _SIDE_PX)
    return outline_patches(small, np.array(chart.corners_px) / scale)


def outline_patches(pixels: np.ndarray, corners_px: np.ndarray) -> np.ndarray:
    """Scale an image [H, W, 3] to the published white, and outline the sampled middles of the patches.

    The published colour fills the centre of each outline, so a good correction makes it hard to see.
    """
    white, published = sample(pixels, corners_px).colours[GREYS][0], published_colours()
    plain = pixels * (luminance(published[GREYS][0]) / luminance(white))
    shown = plain.copy()
    squares = np.stack([squares_px(corners_px, side) for side in _SQUARES], 1) - 0.5
    for nested, colour in zip(squares, published, strict=True):
        outer, middle, inner = (polygon(one[:, 1], one[:, 0], shown.shape[:2]) for one in nested)
        shown[outer] = 0 if luminance(colour) > 0.2 else 0.8
        shown[middle] = plain[middle]
        shown[inner] = colour
    return shown


def find_chart(pixels: np.ndarray) -> np.ndarray | None:
    """Find a chart in a linear image [H, W, 3]; its 24 colours match to a mean delta E of `LARGEST_DELTA_E`.

    Returns the corners [4, 2] of the patches' area, clockwise from the dark skin patch; None without a chart.
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
    """Find spots of one colour with an edge around them: centres [N, 2] and sides [N], in pixels."""
    bright = max(float(np.percentile(pixels, _BRIGHT_PERCENTILE)), 1e-12)
    encoded = (pixels / bright).clip(0, 1) ** (1 / _GAMMA)
    slope = np.max([ndimage.gaussian_gradient_magnitude(encoded[..., c], 1.0) for c in range(3)], 0)
    centres, sides = np.zeros((0, 2)), np.zeros(0)
    for edge in _EDGES:
        for spot in _spots(slope < edge):
            centre, side = np.array(spot.centroid)[::-1] + 0.5, np.sqrt(spot.area)
            if (
                not len(centres) or np.hypot(*(centres - centre).T).min() > side / 3
            ):  # else a spot of a lower threshold
                centres, sides = np.r_[centres, centre[None]], np.r_[sides, side]
    return centres, sides


def _spots(even: np.ndarray) -> Iterator[Any]:
    """Connected regions of a mask [H, W] that are about as wide as long, and filled."""
    for spot in regionprops(label(even, connectivity=1)):
        if not _LEAST_SPOT_PX <= spot.area <= _LARGEST_SPOT * even.size:
            continue
        long, short = spot.axis_major_length, spot.axis_minor_length
        if long < _LONGEST * short and spot.area > _LEAST_FULL * long * short:
            yield spot


def _placed(grid: dict[Place, int], points: np.ndarray) -> Iterator[np.ndarray]:
    """Corners [4, 2] of all charts that a grid, which may lack rows or columns of patches, can belong to."""
    places, images = np.array(list(grid)), points[list(grid.values())]
    for upright in (places, np.stack([places[:, 1], -places[:, 0]], -1)):  # a chart on its side
        low, high = upright.min(0), upright.max(0) - [COLUMNS - 1, ROWS - 1]
        for first_column in range(min(low[0], high[0]), max(low[0], high[0]) + 1):
            for first_row in range(min(low[1], high[1]), max(low[1], high[1]) + 1):
                local = upright - [first_column, first_row]
                inside = ((local >= 0) & (local < [COLUMNS, ROWS])).all(-1)
                if inside.sum() >= _LEAST_ON_GRID:
                    matrix = homography(local[inside].astype(float), images[inside])
                    yield project(matrix, area_corners())


def find_lattices(points: np.ndarray, sides: np.ndarray, least: int, reach: int) -> list[dict[Place, int]]:
    """Find grids of `least` points or more among points [N, 2] of spots with sides [N], best first.

    A grid is a dict from place to index of the point. A place counts steps from the first point, at most
    `reach` in each direction: first along, then across, which is clockwise from it on the screen.
    """
    if len(points) < least:
        return []
    tree = cKDTree(points)
    found: dict[frozenset[int], dict[Place, int]] = {}
    done: set[int] = set()  # in a grid
    for seed in range(len(points)):
        if seed in done:
            continue
        grown = [_grow(tree, sides, seed, reach, *steps) for steps in _steps(tree, sides, seed)]
        best = max(grown, key=_score, default={})
        if len(best) >= least:
            found[frozenset(best.values())] = best
            done.update(best.values())
    return sorted(found.values(), key=_score, reverse=True)


def _score(grid: dict[Place, int]) -> float:
    """Number of points of a grid times the share of filled places, which is low for one along a diagonal."""
    return len(grid) ** 2 / float(np.prod(np.ptp(list(grid), axis=0) + 1))


def _steps(tree: cKDTree, sides: np.ndarray, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of steps [2] from a point to two neighbours at about a right angle, the second clockwise."""
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
    """Grow a grid from a point and two steps; each step is predicted by the one before it."""
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
