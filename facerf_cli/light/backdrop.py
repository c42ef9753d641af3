"""Backgrounds of portraits: the part of an environment map that a camera sees."""

import math

import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter
from torch import Tensor

from facerf_cli.light.envmap import look_up, mean_radiance

_SHARP_PX = 3.0  # standard deviation of a blur up to which an image is drawn at its full size
_TURN = 2 * math.pi


def backdrop(envmap: Tensor, rays: Tensor, rotate_deg: float = 0.0, blur: float = 0.0) -> Tensor:
    """The map [H, W, 3] seen along viewing rays [h, w, 3] of any length, camera space: radiance [h, w, 3].

    `rotate_deg` is added to every azimuth of the map; `blur` is the standard deviation of a lens's blur as a
    share of the longer side.
    """
    size = (rays.shape[0], rays.shape[1])
    sigma_px = blur * max(size)
    scale = min(1.0, _SHARP_PX / sigma_px) if sigma_px else 1.0
    small = (max(2, round(size[0] * scale)), max(2, round(size[1] * scale)))
    towards = F.interpolate(rays.permute(2, 0, 1)[None], small, mode="area")[0].permute(1, 2, 0)
    towards = F.normalize(towards, dim=-1)
    step = float((towards[0, 0] - towards[-1, -1]).norm()) / math.hypot(*small)  # radians in a pixel
    rows = max(16, round(_TURN / 2 / max(step, 1e-6)))
    seen = look_up(mean_radiance(envmap, rows, rotate_deg), towards.reshape(-1, 3)).view(*small, 3)
    if sigma_px:
        sigma = sigma_px * small[1] / size[1]
        seen = torch.from_numpy(gaussian_filter(seen.numpy(), (sigma, sigma, 0), mode="nearest"))
    if small == size:
        return seen
    return F.interpolate(seen.permute(2, 0, 1)[None], size, mode="bilinear", align_corners=False)[0].permute(
        1, 2, 0
    )
