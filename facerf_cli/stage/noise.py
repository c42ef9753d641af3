"""Noise and strokes on a window of the chart, in millimetres, so that they look the same at every size."""

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.stage.window import Window


def noise(
    faces: int,
    window: Window,
    bump_mm: float | tuple[float, float],
    generator: torch.Generator,
    octaves: int = 3,
) -> Tensor:
    """Smooth noise [B, 1, T, T] of about unit deviation, bumps that wide (and high), finer octaves."""
    width, height = bump_mm if isinstance(bump_mm, tuple) else (bump_mm, bump_mm)
    side = window.side
    total, power = torch.zeros(faces, 1, side, side), 0.0
    for octave in range(octaves):
        columns = round(side * window.texel_mm[0] / width * 2**octave)
        rows = round(side * window.texel_mm[1] / height * 2**octave)
        if octave and max(rows, columns) > 1.5 * side:
            break
        size = (min(max(rows, 2), side), min(max(columns, 2), side))
        grid = torch.randn(faces, 1, *size, generator=generator)
        if size != (side, side):
            grid = F.interpolate(grid, (side, side), mode="bicubic", align_corners=False)
        total += 0.5**octave * grid
        power += 0.25**octave
    return total / (0.78 * power**0.5)


def splat(window: Window, places: Tensor, area_mm2: Tensor) -> Tensor:
    """How many layers of little areas [N] at places [N, 2] in millimetres lie on each texel [1, 1, T, T]."""
    side = window.side
    at = window.to_texels(places)
    corner = at.floor()
    fraction = at - corner
    column, row = corner.long().unbind(-1)
    total = torch.zeros(side * side, dtype=torch.float64)
    for down in (0, 1):
        for right in (0, 1):
            share = (fraction[:, 0] if right else 1 - fraction[:, 0]) * (
                fraction[:, 1] if down else 1 - fraction[:, 1]
            )
            x, y = column + right, row + down
            seen = (x >= 0) & (x < side) & (y >= 0) & (y < side)
            index = torch.where(seen, y * side + x, 0)
            total += torch.bincount(index, (share * area_mm2 * seen).double(), side * side)
    texel = window.texel_mm[0] * window.texel_mm[1]
    return (total / texel).float().view(1, 1, side, side)


def hairs(
    window: Window, roots: Tensor, angles: Tensor, bends: Tensor, lengths: Tensor, width_mm: float
) -> Tensor:
    """Layers of hair [1, 1, T, T] of N single hairs, tapering to the tip.

    roots [N, 2] and lengths [N] in millimetres; angles [N] at the root, counter-clockwise from the picture's
    right; bends [N]: by how much each has turned at its tip.
    """
    if len(roots) == 0:
        return torch.zeros(1, 1, window.side, window.side)
    steps = max(2, min(40, int(1.3 * float(lengths.max()) / min(window.texel_mm)) + 1))
    along = (torch.arange(steps) + 0.5) / steps  # [S]
    turned = angles[:, None] + bends[:, None] * along / 2  # mean direction from the root to there
    reach = lengths[:, None] * along
    x = roots[:, :1] + reach * turned.cos()
    y = roots[:, 1:] - reach * turned.sin()
    area = lengths[:, None] / steps * width_mm * 1.3 * (1 - along**2).clamp_min(0.1)
    return splat(window, torch.stack([x, y], -1).view(-1, 2), area.reshape(-1))


def blurred(field: Tensor, window: Window, sigma_mm: float) -> Tensor:
    """A field [B, C, T, T] spread by a Gaussian."""
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
    """Slopes [B, 2, T, T] along u and v of a height [B, 1, T, T]."""
    width, height = window.texel_mm
    along_u = (height_mm.roll(-1, -1) - height_mm.roll(1, -1)) / (2 * width)
    along_v = (height_mm.roll(-1, -2) - height_mm.roll(1, -2)) / (2 * height)
    return torch.cat([along_u, along_v], 1)


def plain_noise(size: tuple[int, int], bumps: int, generator: torch.Generator) -> Tensor:
    """Smooth noise [1, H, W] of about unit deviation, `bumps` along the height, with one finer octave."""
    total = torch.zeros(1, 1, *size)
    for octave, weight in ((1, 1.0), (2, 0.5)):
        cells = [max(2, round(octave * bumps * length / size[0])) for length in size]
        grid = torch.randn(1, 1, *cells, generator=generator)
        total += weight * F.interpolate(grid, size, mode="bicubic", align_corners=False)
    return total[0] / 0.87
