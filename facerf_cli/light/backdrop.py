"""Backgrounds of portraits: the part of an environment map that a camera sees."""

import math
from collections.abc import Callable

import numpy as np
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter
from torch import Tensor

from facerf_cli.image.strips import Band, enlarged, whole
from facerf_cli.light.envmap import look_up, mean_radiance

_SHARP_PX = 3.0  # standard deviation of a blur up to which an image is drawn at its full size
_TURN = 2 * math.pi


def backdrop(
    envmap: Tensor,
    size: tuple[int, int],
    rays: Callable[[tuple[int, int], slice], Tensor],
    rotate_deg: float = 0.0,
    blur: float = 0.0,
) -> Band:
    """The map [H, W, 3] in a frame of a size, by rows: radiance.

    `rays` gives viewing rays of any length, camera space, of some rows of the frame at another size.
    `rotate_deg` is added to every azimuth of the map; `blur` is the standard deviation of a lens's blur as a
    share of the longer side.
    """
    sigma_px = blur * max(size)
    scale = min(1.0, _SHARP_PX / sigma_px) if sigma_px else 1.0
    small = max(2, round(size[0] * scale)), max(2, round(size[1] * scale))

    def towards(rows: slice) -> Tensor:
        return F.normalize(rays(small, rows), dim=-1)

    first, last = (towards(slice(row, row + 1)) for row in (0, small[0] - 1))
    step = float((first[0, 0] - last[0, -1]).norm()) / math.hypot(*small)  # radians in a pixel
    mean = mean_radiance(envmap, max(16, round(_TURN / 2 / max(step, 1e-6))), rotate_deg)

    def drawn(rows: slice) -> np.ndarray:
        directions = towards(rows)
        return look_up(mean, directions.reshape(-1, 3)).view(directions.shape).numpy()

    if not sigma_px:
        return drawn
    sigma = sigma_px * small[1] / size[1]
    soft = gaussian_filter(whole(drawn, *small), (sigma, sigma, 0), mode="nearest")
    maps = soft.transpose(2, 0, 1)
    return lambda rows: np.moveaxis(enlarged(maps, size, rows), 0, -1)
