"""Fields painted on a window of UV space: region masks, smooth noise and single hairs.

Sizes are in millimetres on the unrolled mean face, so that a field looks the same at every resolution.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.topology import LANDMARK_UV, UV_SIZE_MM, inside_mm
from facerf_cli.raster.texture import texel_centres_uv

# Range of u and of v: the UV map of the face, and the wider canvas for the skin of the whole head.
UV_SPAN, CANVAS_SPAN = (0.0, 1.0), (-0.5, 1.5)
LANDMARK_MM = (LANDMARK_UV - [0.5, 0]) * UV_SIZE_MM  # [68, 2], as `places_mm`
Random = np.random.Generator
_PAIRED = ("eyes", "brows", "nostrils")  # `inside_mm` covers only the left part of these


def generators(*seeds: int) -> tuple[Random, torch.Generator]:
    """Make generators for numpy and for torch, a function of the numbers."""
    random = np.random.default_rng(seeds)
    return random, torch.Generator().manual_seed(int(random.integers(1 << 62)))


@dataclass(frozen=True, eq=False)
class Uniform:
    """Uniform random numbers of a default `shape`, which a call may override."""

    generator: torch.Generator
    shape: tuple[int, ...] = ()

    def __call__(self, low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape or self.shape, generator=self.generator)


@dataclass(frozen=True)
class Window:
    """`side` x `side` texels over (u, v) in `span`, with v down.

    Positions in millimetres lie on the unrolled mean face: x from the midline to the image's right, y down
    from the upper edge of the UV map.
    """

    side: int
    span: tuple[float, float] = UV_SPAN

    @property
    def texel_mm(self) -> tuple[float, float]:
        """Width and height of a texel, in millimetres."""
        texel = UV_SIZE_MM * (self.span[1] - self.span[0]) / self.side
        return float(texel[0]), float(texel[1])

    def to_texels(self, mm: Tensor) -> Tensor:
        """Convert positions [..., 2] from millimetres to texels, whose centres are at integers."""
        origin = torch.tensor([(self.span[0] - 0.5) * UV_SIZE_MM[0], self.span[0] * UV_SIZE_MM[1]])
        return (mm - origin.float()) / torch.tensor(self.texel_mm) - 0.5


def places_mm(window: Window) -> tuple[Tensor, Tensor]:
    """Compute x and y [T, T] of every texel centre, in millimetres."""
    low, high = window.span
    u, v = (low + (high - low) * texel_centres_uv(window.side)).unbind(-1)
    return (u - 0.5) * float(UV_SIZE_MM[0]), v * float(UV_SIZE_MM[1])


@lru_cache(maxsize=64)  # all people of a run share it
def inside(window: Window, region: str) -> Tensor:
    """Compute the signed distance [1, 1, T, T] in millimetres to the outline of a region, positive inside.

    The field is symmetric. Outside the UV map it repeats the value at the nearest edge.
    """
    side = max(8, min(256, int(window.side / (window.span[1] - window.span[0]))))
    distance = inside_mm(region, texel_centres_uv(side, torch.float64).numpy())
    mirrored = distance[:, ::-1]
    both = np.maximum(distance, mirrored) if region in _PAIRED else (distance + mirrored) / 2
    x, y = places_mm(window)
    at = torch.stack([x / float(UV_SIZE_MM[0]) + 0.5, y / float(UV_SIZE_MM[1])], -1)
    field = torch.from_numpy(both).float()[None, None]
    return F.grid_sample(field, 2 * at[None] - 1, padding_mode="border", align_corners=False)


def mask(window: Window, region: str, edge_mm: float, grow_mm: float = 0.0) -> Tensor:
    """Compute a mask [1, 1, T, T] of a region grown by `grow_mm`, with an edge at least a texel wide."""
    ramp = (inside(window, region) + grow_mm) / max(edge_mm, max(window.texel_mm)) + 0.5
    return smooth(ramp)


def smooth(ramp: Tensor) -> Tensor:
    """Map a ramp to 0 below 0 and 1 above 1, with a smooth step between."""
    ramp = ramp.clamp(0, 1)
    return ramp * ramp * (3 - 2 * ramp)


@lru_cache(maxsize=64)  # all people of a run share it
def blob(window: Window, at: int | tuple[float, float], radius_mm: float, tall: float = 1.0) -> Tensor:
    """Compute a Gaussian bump [1, 1, T, T] of peak 1 at a landmark or (u, v); `tall` is height over width."""
    u, v = LANDMARK_UV[at] if isinstance(at, int) else at
    x, y = places_mm(window)
    dx, dy = x - float((u - 0.5) * UV_SIZE_MM[0]), y - float(v * UV_SIZE_MM[1])
    return torch.exp(-((dx / radius_mm) ** 2) - (dy / (radius_mm * tall)) ** 2)[None, None]


def blobs(window: Window, u: float, v: float, radius_mm: float, tall: float = 1.0) -> Tensor:
    """Compute two Gaussian bumps [1, 1, T, T], at u and 1 - u."""
    return blob(window, (u, v), radius_mm, tall) + blob(window, (1 - u, v), radius_mm, tall)


def noise(
    faces: int,
    window: Window,
    bump_mm: float | tuple[float, float],
    generator: torch.Generator,
    octaves: int = 3,
) -> Tensor:
    """Draw smooth noise [B, 1, T, T] of standard deviation about 1; `bump_mm` is the size of coarse bumps."""
    width, height = bump_mm if isinstance(bump_mm, tuple) else (bump_mm, bump_mm)
    side = window.side
    total, power = torch.zeros(faces, 1, side, side), 0.0
    for octave in range(octaves):
        columns = round(side * window.texel_mm[0] / width * 2**octave)
        rows = round(side * window.texel_mm[1] / height * 2**octave)
        if octave and max(rows, columns) > 1.5 * side:
            break
        size = [side if n > 0.6 * side else max(n, 2) for n in (rows, columns)]
        grid = torch.randn(faces, 1, *size, generator=generator)
        total += 0.5**octave * _enlarged(grid, side)
        power += 0.25**octave
    return total / (0.78 * power**0.5)


def _enlarged(grid: Tensor, side: int) -> Tensor:
    """Enlarge a grid [B, 1, h, w] to [B, 1, side, side], bicubic; by matrix products where that is faster."""
    rows, columns = grid.shape[-2:]
    if rows == columns == side:
        return grid
    if side > 256 and rows * columns > side * side / 9:
        return F.interpolate(grid, (side, side), mode="bicubic", align_corners=False)
    return _bicubic(rows, side) @ (grid @ _bicubic(columns, side).T)


@lru_cache(maxsize=256)  # every noise needs it
def _bicubic(cells: int, side: int) -> Tensor:
    """Bicubic interpolation matrix [side, cells]."""
    each = torch.eye(cells)[None, None]
    return F.interpolate(each, (side, cells), mode="bicubic", align_corners=False)[0, 0]


def splat(
    window: Window, places: Tensor, area_mm2: Tensor, face: Tensor | None = None, faces: int = 1
) -> Tensor:
    """Splat small areas [N] at positions [N, 2] (mm) onto texels: layers of cover [B, 1, T, T].

    `face` [N] is the index of the face of each area, below `faces`.
    """
    side = window.side
    at = window.to_texels(places)
    corner = at.floor()
    right, down = (at - corner).unbind(-1)
    column, row = corner.long().unbind(-1)
    first = 0 if face is None else face * side * side
    total = torch.zeros(faces * side * side, dtype=torch.float64)
    for dy, share_y in ((0, 1 - down), (1, down)):
        y = row + dy
        weight_y = share_y * area_mm2 * ((y >= 0) & (y < side))
        for dx, share_x in ((0, 1 - right), (1, right)):
            x = column + dx
            weight = weight_y * share_x * ((x >= 0) & (x < side))
            index = y.clamp(0, side - 1) * side + x.clamp(0, side - 1) + first
            total += torch.bincount(index, weight.double(), len(total))
    texel = window.texel_mm[0] * window.texel_mm[1]
    return (total / texel).float().view(faces, 1, side, side)


@dataclass(frozen=True)
class Strokes:
    """N single hairs on a window: roots [N, 2], lengths [N] and widths [N] at the root, in millimetres.

    angles [N] hold the direction at the root, in radians counter-clockwise from the image's right; bends [N]
    the change of direction from root to tip.
    """

    roots: Tensor
    angles: Tensor
    bends: Tensor
    lengths: Tensor
    widths: Tensor


def hairs(window: Window, strokes: Strokes, face: Tensor | None = None, faces: int = 1) -> Tensor:
    """Paint single hairs that taper to their tips: layers of cover [B, 1, T, T]."""
    if len(strokes.roots) == 0:
        return torch.zeros(faces, 1, window.side, window.side)
    longest = float(strokes.lengths.max())
    steps = max(2, min(40, int(1.2 * longest / min(window.texel_mm)) + 1))
    along = (torch.arange(steps) + 0.5) / steps  # [S]
    turned = strokes.angles[:, None] + strokes.bends[:, None] * along / 2  # mean direction from the root
    reach = strokes.lengths[:, None] * along
    x = strokes.roots[:, :1] + reach * turned.cos()
    y = strokes.roots[:, 1:] - reach * turned.sin()
    taper = 1.3 * (1 - along**2).clamp_min(0.1) / steps
    area = (strokes.lengths * strokes.widths)[:, None] * taper
    face_of_area = None if face is None else face.repeat_interleave(steps)
    return splat(window, torch.stack([x, y], -1).view(-1, 2), area.reshape(-1), face_of_area, faces)


def blurred(field: Tensor, window: Window, sigma_mm: float) -> Tensor:
    """Blur a field [B, C, T, T] by a Gaussian of standard deviation `sigma_mm`."""
    for axis, texel in ((-1, window.texel_mm[0]), (-2, window.texel_mm[1])):
        sigma = sigma_mm / texel
        reach = int(3 * sigma + 0.5)
        if reach == 0:
            continue
        offset = torch.arange(-reach, reach + 1)
        kernel = torch.exp(-0.5 * (offset / sigma) ** 2)
        kernel = (kernel / kernel.sum()).view(1, 1, *((1, -1) if axis == -1 else (-1, 1)))
        pad = (reach, reach, 0, 0) if axis == -1 else (0, 0, reach, reach)
        b, c, h, w = field.shape
        flat = F.pad(field.reshape(b * c, 1, h, w), pad, mode="replicate")
        field = F.conv2d(flat, kernel).view(b, c, h, w)
    return field


def slopes(height_mm: Tensor, window: Window) -> Tensor:
    """Compute slopes [B, 2, T, T] along u and v of a height field [B, 1, T, T] in millimetres."""
    width, height = window.texel_mm
    along_u = (height_mm.roll(-1, -1) - height_mm.roll(1, -1)) / (2 * width)
    along_v = (height_mm.roll(-1, -2) - height_mm.roll(1, -2)) / (2 * height)
    return torch.cat([along_u, along_v], 1)


def plain_noise(size: tuple[int, int], bumps: int, generator: torch.Generator) -> Tensor:
    """Draw two octaves of smooth noise [1, H, W], standard deviation about 1, `bumps` along the height."""
    total = torch.zeros(1, 1, *size)
    for octave, weight in ((1, 1.0), (2, 0.5)):
        cells = [max(2, round(octave * bumps * length / size[0])) for length in size]
        grid = torch.randn(1, 1, *cells, generator=generator)
        total += weight * F.interpolate(grid, size, mode="bicubic", align_corners=False)
    return total[0] / 0.87
