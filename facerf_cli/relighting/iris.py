"""Irises of a photo: their outline, the sharpness there, and their look without catchlights.

The mesh of a face places an iris to a tenth of its radius; the border of the white is searched around that.
What is far brighter than an iris at the same distance from its centre is a catchlight; it is filled by the
colours of that ring, in the shade that is around it.
"""

import math
from itertools import product

import numpy as np
import torch
from scipy.ndimage import binary_dilation, label, map_coordinates, maximum_filter, minimum_filter
from skimage.draw import polygon2mask

from facerf_cli.image.colour import luminance
from facerf_cli.image.strips import block_means
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.raster.texture import inpaint

_SHIFTS, _SIZES = np.linspace(-0.2, 0.2, 9), np.linspace(0.85, 1, 4)  # of an outline, in radii
_SIDES_DEG = 50.0  # from the horizontal, where an outline is seen: above and below are lids
_ACROSS = 0.12  # distance on both sides of an outline whose brightness is compared, in radii
_MOVED = 0.15  # rise, over the brightest, that a circle elsewhere must gain for each radius
_RINGS = 8  # of an iris, each of a pixel's width or more
_TYPICAL = 0.3  # quantile of a ring's brightness that no catchlight reaches
_CATCHLIGHT = (1.6, 2.5, 4.0, 6.0)  # brightness over the ring's from which on pixels are a catchlight
_MOST_SHADE = 2.0  # brightness around a catchlight over the ring's
_FINE = 4  # parts of a pixel at the lids, along each side


def outlined(light: np.ndarray, iris_px: np.ndarray, between: np.ndarray) -> np.ndarray:
    """The circle [3], centre and radius, near a given one at which luminance [h, w] rises most outward.

    It rises on both sides; only what lies `between` [h, w] the lids counts.
    """
    turns = np.radians(np.linspace(-_SIDES_DEG, _SIDES_DEG, 13))
    turns = np.concatenate([turns, turns + math.pi])
    x_px, y_px, radius_px = iris_px
    found = np.array([(*at, size) for *at, size in product(_SHIFTS, _SHIFTS, _SIZES)])
    root = np.sqrt(light)

    def seen(scale: float) -> np.ndarray:
        reach = found[:, 2, None] * scale * radius_px
        x = x_px + found[:, :1] * radius_px + reach * np.cos(turns)
        y = y_px + found[:, 1:2] * radius_px + reach * np.sin(turns)
        inside = map_coordinates(between, [y - PIXEL_CENTRE, x - PIXEL_CENTRE], order=1, mode="nearest")
        values = map_coordinates(root, [y - PIXEL_CENTRE, x - PIXEL_CENTRE], order=1, mode="nearest")
        return np.where(inside > 0.5, values, np.nan)

    rise = seen(1 + _ACROSS) - seen(1 - _ACROSS)
    moved = np.hypot(found[:, 0], found[:, 1]) + np.abs(found[:, 2] - 1)
    score = np.median(np.nan_to_num(rise).reshape(-1, 2, 13), 2).min(1) - _MOVED * root.max() * moved
    best = found[score.argmax()]
    return iris_px + radius_px * np.array([best[0], best[1], best[2] - 1])


def opening(lids_px: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
    """Share [h, w] of the opening between lids, an outline [N, 2], in a window of the photo."""
    size = rows.stop - rows.start, columns.stop - columns.start
    corners = (lids_px - (columns.start, rows.start)) * _FINE - PIXEL_CENTRE
    inside = polygon2mask((size[0] * _FINE, size[1] * _FINE), corners[:, ::-1])
    return block_means(inside[..., None], _FINE)[..., 0]


def blur_px(light: np.ndarray, radius_px: float) -> float:
    """Standard deviation in pixels of the blur of a photo, by the sharpest edge of luminance [h, w]."""
    span = 2 * max(1, round(radius_px / 4)) + 1
    steps = maximum_filter(light, span) - minimum_filter(light, span)
    slopes = np.hypot(*np.gradient(light))
    sure = steps > 0.3 * steps.max()
    widths = steps[sure] / np.maximum(slopes[sure], 1e-9) / math.sqrt(2 * math.pi)
    return float(np.clip(np.quantile(widths, 0.02), 0.5, radius_px / 4)) if sure.any() else 0.5


def without_catchlights(
    pixels: np.ndarray, away: np.ndarray, share: np.ndarray, radius_px: float, blur: float
) -> np.ndarray:
    """Pixels [h, w, 3] of an iris without its catchlights.

    `away` [h, w] is the distance from its centre in radii, `share` [h, w] its share of the pixels, `blur`
    that of the photo in pixels.
    """
    light, seen = luminance(pixels), share > 0.5
    rings = np.arange(int(min(_RINGS, radius_px)))
    number = np.minimum(away * len(rings), len(rings) - 1).astype(int)

    def typical(values: np.ndarray, of: np.ndarray, quantile: float) -> np.ndarray:
        """Quantiles [R] of values [h, w] in the rings among some pixels."""
        parts = [values[of & (number == ring)] for ring in rings]
        known = [ring for ring in rings if len(parts[ring])]
        return np.interp(rings, known, [np.quantile(parts[ring], quantile) for ring in known]).clip(1e-6)

    if not seen.any():
        return pixels
    dark = maximum_filter(typical(light, seen, _TYPICAL), 3)  # the pupil's border is no catchlight
    over, bright = light / dark[number], np.zeros_like(seen)
    for least in _CATCHLIGHT:  # one that touches the white of the eye is apart where it is brightest
        parts, _ = label(over > least)
        inside = np.bincount(parts.ravel(), seen.ravel()) > np.bincount(parts.ravel()) / 2
        bright |= (parts > 0) & inside[parts]
    bright = seen & binary_dilation(bright, iterations=math.ceil(1.5 * blur))
    clear = seen & ~bright
    if not bright.any() or not clear.any():
        return pixels
    colours = np.stack([typical(pixels[..., channel], clear, 0.5) for channel in range(3)], -1)[number]
    own = light / luminance(colours)
    known, mask = (
        torch.from_numpy(values.astype(np.float32)) for values in (own.clip(max=_MOST_SHADE), clear)
    )
    shade = inpaint(known[None], mask)[0].numpy()
    return np.where(bright[..., None], colours * np.minimum(shade, own)[..., None], pixels)
