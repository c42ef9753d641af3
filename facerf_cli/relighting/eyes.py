"""Eyes: replace the photo's catchlights by reflections of the new light in the cornea.

The cornea is a sphere in front of the iris that reflects a fixed fraction of the light. Lights appear in it
as discs, as blurred as the photo is, and fade toward the lids, whose lashes shade them. Everything is linear
in the light.

The face mesh locates an iris within a tenth of its radius; the border to the white of the eye is searched
around that. A catchlight is far brighter than the iris at the same distance from its centre. It is filled
with the colours of that ring, in the shading around it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import (
    binary_dilation,
    gaussian_filter,
    label,
    map_coordinates,
    maximum_filter,
    minimum_filter,
)
from skimage.draw import polygon2mask
from torch import Tensor

from facerf_cli.image.colour import luminance
from facerf_cli.image.strips import Rows, Window, block_means
from facerf_cli.light.light import is_of_rig
from facerf_cli.light.sphere import RIG_LIGHTS
from facerf_cli.portrait.find import SeenEyes
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.raster.texture import inpaint, smoothstep

_SHIFTS, _SIZES = np.linspace(-0.2, 0.2, 9), np.linspace(0.85, 1, 4)  # searched outlines, in radii
_SIDES_DEG = 50.0  # angle from the horizontal within which an outline is visible; lids cover the rest
_ACROSS = 0.12  # distance on both sides of an outline whose brightness is compared, in radii
_MOVED = 0.15  # rise, over the brightest pixel, that a shifted circle must gain per radius
_RINGS = 8  # rings of an iris, each at least a pixel wide
_TYPICAL = 0.3  # quantile of a ring's brightness that no catchlight reaches
_CATCHLIGHT = (1.6, 2.5, 4.0, 6.0)  # brightness over the ring's above which pixels are a catchlight
_MOST_SHADE = 2.0  # limit of the brightness around a catchlight over the ring's
_FINE = 4  # subpixels along each side of a pixel at the lids
_IRIS_OF_CORNEA = 5.9 / 7.8  # ratio of their radii in mm
_REFLECTED = 0.025  # fraction of light reflected at normal incidence (Fresnel)
_SIDE = 64  # pixels of the reflection
_RIG_RAD = math.acos(1 - 2 / RIG_LIGHTS)  # radius of a disc that fills a cell of a map's rig
_LIGHT_RAD = math.radians(7.0)  # radius for any other light: two such discs fill the grid of a soft light
_SOFT = 0.9  # fraction of a disc's solid angle over which it fades on both sides of its border
_LEAST_PX = 2.0  # radius of an iris below which nothing is visible in it
_AROUND = 2.0  # reach of the window around an iris, in radii
_LASHES = 0.08  # standard deviation of the lids' shadow, in radii


def outlined(light: np.ndarray, iris_px: np.ndarray, between: np.ndarray) -> np.ndarray:
    """Return the circle [3], centre and radius, near an iris across which luminance [h, w] rises most.

    The rise must appear on both the left and the right. Only pixels `between` [h, w] the lids count.
    """
    turns = np.radians(np.linspace(-_SIDES_DEG, _SIDES_DEG, 13))
    turns = np.concatenate([turns, turns + math.pi])
    x_px, y_px, radius_px = iris_px
    circles = np.array([(*at, size) for *at, size in product(_SHIFTS, _SHIFTS, _SIZES)])
    root = np.sqrt(light)

    def brightness(scale: float) -> np.ndarray:
        reach = circles[:, 2, None] * scale * radius_px
        x = x_px + circles[:, :1] * radius_px + reach * np.cos(turns)
        y = y_px + circles[:, 1:2] * radius_px + reach * np.sin(turns)
        inside = map_coordinates(between, [y - PIXEL_CENTRE, x - PIXEL_CENTRE], order=1, mode="nearest")
        values = map_coordinates(root, [y - PIXEL_CENTRE, x - PIXEL_CENTRE], order=1, mode="nearest")
        return np.where(inside > 0.5, values, np.nan)

    rise = brightness(1 + _ACROSS) - brightness(1 - _ACROSS)
    moved = np.hypot(circles[:, 0], circles[:, 1]) + np.abs(circles[:, 2] - 1)
    score = np.median(np.nan_to_num(rise).reshape(-1, 2, 13), 2).min(1) - _MOVED * root.max() * moved
    best = circles[score.argmax()]
    return iris_px + radius_px * np.array([best[0], best[1], best[2] - 1])


def opening(lids_px: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
    """Return the coverage [h, w] of the opening between lids, an outline [N, 2], in a window of the photo."""
    size = rows.stop - rows.start, columns.stop - columns.start
    corners = (lids_px - (columns.start, rows.start)) * _FINE - PIXEL_CENTRE
    inside = polygon2mask((size[0] * _FINE, size[1] * _FINE), corners[:, ::-1])
    return block_means(inside[..., None], _FINE)[..., 0]


def blur_px(light: np.ndarray, radius_px: float) -> float:
    """Measure the standard deviation of a photo's blur in pixels by the sharpest edge of luminance [h, w]."""
    span = 2 * max(1, round(radius_px / 4)) + 1
    steps = maximum_filter(light, span) - minimum_filter(light, span)
    slopes = np.hypot(*np.gradient(light))
    sure = steps > 0.3 * steps.max()
    widths = steps[sure] / np.maximum(slopes[sure], 1e-9) / math.sqrt(2 * math.pi)
    return float(np.clip(np.quantile(widths, 0.02), 0.5, radius_px / 4)) if sure.any() else 0.5


def without_catchlights(
    pixels: np.ndarray, away: np.ndarray, coverage: np.ndarray, radius_px: float, blur: float
) -> np.ndarray:
    """Return the pixels [h, w, 3] of an iris without its catchlights.

    `away` [h, w] is the distance from the centre of the iris in radii, `coverage` [h, w] the fraction of each
    pixel that the iris covers, and `blur` the standard deviation of the photo's blur in pixels.
    """
    light, visible = luminance(pixels), coverage > 0.5
    rings = np.arange(int(min(_RINGS, radius_px)))
    number = np.minimum(away * len(rings), len(rings) - 1).astype(int)

    def typical(values: np.ndarray, among: np.ndarray, quantile: float) -> np.ndarray:
        """Return a quantile [R] of values [h, w] in each ring."""
        parts = [values[among & (number == ring)] for ring in rings]
        known = [ring for ring in rings if len(parts[ring])]
        return np.interp(rings, known, [np.quantile(parts[ring], quantile) for ring in known]).clip(1e-6)

    if not visible.any():
        return pixels
    dark = maximum_filter(typical(light, visible, _TYPICAL), 3)  # the pupil's border is not a catchlight
    over, bright = light / dark[number], np.zeros_like(visible)
    for least in _CATCHLIGHT:  # a catchlight that touches the white is separate at a higher threshold
        parts, _ = label(over > least)
        inside = np.bincount(parts.ravel(), visible.ravel()) > np.bincount(parts.ravel()) / 2
        bright |= (parts > 0) & inside[parts]
    bright = visible & binary_dilation(bright, iterations=math.ceil(1.5 * blur))
    clear = visible & ~bright
    if not bright.any() or not clear.any():
        return pixels
    colours = np.stack([typical(pixels[..., channel], clear, 0.5) for channel in range(3)], -1)[number]
    own = light / luminance(colours)
    known, mask = (
        torch.from_numpy(values.astype(np.float32)) for values in (own.clip(max=_MOST_SHADE), clear)
    )
    shade = inpaint(known[None], mask)[0].numpy()
    return np.where(bright[..., None], colours * np.minimum(shade, own)[..., None], pixels)


def mirrored_in_cornea(directions: Tensor, weights: Tensor, visible: Tensor) -> Tensor:
    """Return the radiance [M, 3, s, s] that an iris reflects under M sums, [M, L, 3], of lights [L, 3].

    `visible` [L] is the fraction of each light that reaches the iris, past nose, brows and lids. The square
    surrounds the iris as the camera sees it; the eye looks at the camera. Uniform light is not reflected: it
    has no structure and would cover dark irises with a grey disc.
    """
    at = 2 * (torch.arange(_SIDE) + PIXEL_CENTRE) / _SIDE - 1
    down, right = torch.meshgrid(at, at, indexing="ij")
    x, y = right * _IRIS_OF_CORNEA, -down * _IRIS_OF_CORNEA
    normals = torch.stack([x, y, (1 - x * x - y * y).clamp_min(0).sqrt()])
    reflected = 2 * normals[2] * normals - normals.new_tensor([0.0, 0.0, 1.0]).view(3, 1, 1)
    inside = (right.square() + down.square()) < 1
    radii = torch.where(is_of_rig(directions, RIG_LIGHTS), _RIG_RAD, _LIGHT_RAD)[:, None, None]
    away = (1 - torch.einsum("lc,cij->lij", directions, reflected)) / (1 - radii.cos())
    discs = inside * smoothstep((1 + _SOFT - away) / (2 * _SOFT))
    # a disc that gives a white surface radiance 1 has itself the radiance 1 / sin^2
    images = discs * (_REFLECTED / radii.sin().square())
    return torch.einsum("mlc,l,lij->mcij", weights, visible * ~is_of_rig(directions), images)


@dataclass(frozen=True, eq=False)
class _Iris:
    """Window of the photo that contains an iris."""

    number: int  # among the person's irises
    window: Window
    kept: np.ndarray  # factor [h, w, 3] that removes the catchlights
    mirrors: np.ndarray  # weight [h, w] of the reflection
    grid: Tensor  # [1, h, w, 2] coordinates in the reflection
    radius_px: float
    blur: float  # standard deviation of the photo's blur in pixels


class Eyes:
    """Irises of a person, as far as they are visible between the lids in a photo [H, W, 3]."""

    def __init__(self, photo: Rows, eyes: SeenEyes, size_px: tuple[int, ...]) -> None:
        every = (_iris(photo, eyes, number, size_px) for number in range(len(eyes.irises_px)))
        self._irises = [iris for iris in every if iris is not None]

    def precompute(self, reflections: Tensor) -> list[np.ndarray]:
        """Return the reflections [N, 3, s, s] of the corneas in the windows of the irises, each [h, w, 3]."""
        return [_placed(iris, reflections[iris.number]) for iris in self._irises]

    def lit(self, pixels: np.ndarray, images: Sequence[np.ndarray], window: Window) -> np.ndarray:
        """Draw precomputed reflections into a window [h, w, 3] of a relit image, in place, and return it."""
        for iris, image in zip(self._irises, images, strict=True):
            part = window.common(iris.window)
            eye, own = pixels[part.inside(window)], part.inside(iris.window)
            eye *= iris.kept[own]
            eye += image[own]
        return pixels


def _iris(photo: Rows, eyes: SeenEyes, number: int, size_px: tuple[int, ...]) -> _Iris | None:
    """Locate an iris in a photo [H, W, 3]; return None if too little of it is visible."""
    x_px, y_px, radius_px = eyes.irises_px[number].tolist()
    rows, columns = (
        slice(max(0, math.floor(middle - reach)), min(length, math.ceil(middle + reach)))
        for middle, length in zip((y_px, x_px), size_px, strict=True)
        for reach in (_AROUND * radius_px,)
    )
    if radius_px < _LEAST_PX or rows.start >= rows.stop or columns.start >= columns.stop:
        return None
    pixels = photo[rows][:, columns]
    light, between = luminance(pixels), opening(eyes.lids_px[number], rows, columns)
    corner = np.array([columns.start, rows.start, 0])
    x_px, y_px, radius_px = outlined(light, eyes.irises_px[number] - corner, between)
    y, x = (
        (torch.arange(length) + PIXEL_CENTRE - middle) / radius_px
        for length, middle in zip(light.shape, (y_px, x_px), strict=True)
    )
    away = (x[None].square() + y[:, None].square()).sqrt().numpy()
    coverage = (((1 - away) * radius_px + 0.5).clip(0, 1) * between).astype(np.float32)
    if not (coverage > 0.5).any():
        return None
    blur = blur_px(light, radius_px)
    kept = (without_catchlights(pixels, away, coverage, radius_px, blur) / pixels.clip(1e-6)).clip(0, 1)
    shade = gaussian_filter(coverage, _LASHES * radius_px, mode="constant")
    grid = torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], -1)[None]
    mirrors = coverage * (2 * shade - 1).clip(0)
    kept = 1 + coverage[..., None] * (kept - 1)
    return _Iris(number, Window(rows, columns), kept, mirrors, grid.float(), radius_px, blur)


def _placed(iris: _Iris, reflection: Tensor) -> np.ndarray:
    """Return the reflection [h, w, 3] in the window of an iris, as blurred as the photo."""
    side = max(2, min(_SIDE, round(2 * iris.radius_px)))
    small = F.interpolate(reflection[None], (side, side), mode="area")
    framed = F.grid_sample(small, iris.grid, padding_mode="zeros", align_corners=False)
    image = gaussian_filter(framed[0].permute(1, 2, 0).numpy(), (iris.blur, iris.blur, 0), mode="constant")
    return np.asarray(iris.mirrors[..., None] * image)
