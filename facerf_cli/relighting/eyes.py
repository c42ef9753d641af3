"""Eyes: the photo's catchlights give way to the mirror image of the new light in the cornea.

The cornea is a ball before the iris that reflects a fixed share of the light; lights are seen in it as discs,
as blurred as the photo is, and fade toward the lids, whose lashes shade them. All is linear in light.

The mesh of a face places an iris to a tenth of its radius; the border of the white is searched around that.
What is far brighter than an iris at the same distance from its centre is a catchlight; it is filled by the
colours of that ring, in the shade that is around it.
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

_SHIFTS, _SIZES = np.linspace(-0.2, 0.2, 9), np.linspace(0.85, 1, 4)  # of an outline, in radii
_SIDES_DEG = 50.0  # from the horizontal, where an outline is seen: above and below are lids
_ACROSS = 0.12  # distance on both sides of an outline whose brightness is compared, in radii
_MOVED = 0.15  # rise, over the brightest, that a circle elsewhere must gain for each radius
_RINGS = 8  # of an iris, each of a pixel's width or more
_TYPICAL = 0.3  # quantile of a ring's brightness that no catchlight reaches
_CATCHLIGHT = (1.6, 2.5, 4.0, 6.0)  # brightness over the ring's from which on pixels are a catchlight
_MOST_SHADE = 2.0  # brightness around a catchlight over the ring's
_FINE = 4  # parts of a pixel at the lids, along each side
_IRIS_OF_CORNEA = 5.9 / 7.8  # their radii, mm
_REFLECTED = 0.025  # by Fresnel's law, of light that arrives at a right angle
_SIDE = 64  # of the mirror image
_RIG_RAD = math.acos(1 - 2 / RIG_LIGHTS)  # radius of a disc that fills a cell of the rig of a map
_LIGHT_RAD = math.radians(7.0)  # and of any other light: two discs of it fill the grid of a soft light
_SOFT = 0.9  # share of a disc, in solid angle, in which it fades on both sides of its border
_LEAST_PX = 2.0  # radius of an iris in which something can be seen
_AROUND = 2.0  # reach of the window around an iris, in radii
_LASHES = 0.08  # standard deviation of the shade of the lids, in radii


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


def mirrored_in_cornea(directions: Tensor, weights: Tensor, arrives: Tensor) -> Tensor:
    """Radiance [M, 3, s, s] that an iris mirrors under M sums, rgb weights [M, L, 3], of lights [L, 3].

    `arrives` [L] is the share of each light that reaches the iris, past nose, brows and lids. The square lies
    around the iris, as the camera sees it; the eye looks at the camera. The same light from all around, as a
    room's, is not mirrored: it has nothing to show, and would lie before dark irises as a grey disc.
    """
    at = 2 * (torch.arange(_SIDE) + PIXEL_CENTRE) / _SIDE - 1
    down, right = torch.meshgrid(at, at, indexing="ij")
    x, y = right * _IRIS_OF_CORNEA, -down * _IRIS_OF_CORNEA
    normals = torch.stack([x, y, (1 - x * x - y * y).clamp_min(0).sqrt()])
    seen = 2 * normals[2] * normals - normals.new_tensor([0.0, 0.0, 1.0]).view(3, 1, 1)
    inside = (right.square() + down.square()) < 1
    radii = torch.where(is_of_rig(directions, RIG_LIGHTS), _RIG_RAD, _LIGHT_RAD)[:, None, None]
    away = (1 - torch.einsum("lc,cij->lij", directions, seen)) / (1 - radii.cos())
    discs = inside * smoothstep((1 + _SOFT - away) / (2 * _SOFT))
    # a disc that gives a white surface radiance 1 has itself the radiance 1 / sin^2
    shown = discs * (_REFLECTED / radii.sin().square())
    return torch.einsum("mlc,l,lij->mcij", weights, arrives * ~is_of_rig(directions), shown)


@dataclass(frozen=True, eq=False)
class _Iris:
    """A window of the photo: what stays without catchlights [h, w, 3], the share that mirrors lights [h, w].

    `grid` [1, h, w, 2] are places in the mirror image; `blur` is that of the photo in pixels.
    """

    number: int  # among the person's irises
    window: Window
    kept: np.ndarray
    mirrors: np.ndarray
    grid: Tensor
    radius_px: float
    blur: float


class Eyes:
    """The irises of a person's eyes, as far as they show between the lids in a photo [H, W, 3]."""

    def __init__(self, photo: Rows, eyes: SeenEyes, size_px: tuple[int, ...]) -> None:
        found = (_iris(photo, eyes, number, size_px) for number in range(len(eyes.irises_px)))
        self._irises = [iris for iris in found if iris is not None]

    def ready(self, mirrored: Tensor) -> list[np.ndarray]:
        """Mirror images [h, w, 3] in the windows of the irises, of those [N, 3, s, s] of the corneas."""
        return [_placed(iris, mirrored[iris.number]) for iris in self._irises]

    def lit(self, pixels: np.ndarray, images: Sequence[np.ndarray], window: Window) -> np.ndarray:
        """A window [h, w, 3] of a relit image, in place, with the mirror images in its eyes."""
        for iris, image in zip(self._irises, images, strict=True):
            part = window.common(iris.window)
            shown, own = pixels[part.inside(window)], part.inside(iris.window)
            shown *= iris.kept[own]
            shown += image[own]
        return pixels


def _iris(photo: Rows, eyes: SeenEyes, number: int, size_px: tuple[int, ...]) -> _Iris | None:
    """An iris of a photo [H, W, 3]; None where too little of it shows."""
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
    share = (((1 - away) * radius_px + 0.5).clip(0, 1) * between).astype(np.float32)
    if not (share > 0.5).any():
        return None
    blur = blur_px(light, radius_px)
    kept = (without_catchlights(pixels, away, share, radius_px, blur) / pixels.clip(1e-6)).clip(0, 1)
    shade = gaussian_filter(share, _LASHES * radius_px, mode="constant")
    grid = torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], -1)[None]
    mirrors = share * (2 * shade - 1).clip(0)
    kept = 1 + share[..., None] * (kept - 1)
    return _Iris(number, Window(rows, columns), kept, mirrors, grid.float(), radius_px, blur)


def _placed(iris: _Iris, mirrored: Tensor) -> np.ndarray:
    """The mirror image [h, w, 3] in the window of an iris, without what is finer than the photo shows."""
    side = max(2, min(_SIDE, round(2 * iris.radius_px)))
    small = F.interpolate(mirrored[None], (side, side), mode="area")
    found = F.grid_sample(small, iris.grid, padding_mode="zeros", align_corners=False)
    image = gaussian_filter(found[0].permute(1, 2, 0).numpy(), (iris.blur, iris.blur, 0), mode="constant")
    return np.asarray(iris.mirrors[..., None] * image)
