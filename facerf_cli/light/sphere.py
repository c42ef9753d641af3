"""Directions of light, lat-long maps and rigs; all conventions are defined here.

A light direction is the unit vector from the face toward the light, in camera space (x to the image's right,
y up, z toward the camera). Lat-long maps are OpenEXR's ENVMAP_LATLONG: the centre is +z (behind the camera),
u = 0.25 is +x, v = 0 is +y; u runs right and v down over [0, 1], pixel centres at (index + 0.5) / size.
"""

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

RIG_LIGHTS = 150  # of the paper's light stage
_RELAX_STEPS, _RELAX_NEIGHBOURS = 200, 18  # steps of repulsion, and lights that repel each light
LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear Rec.709
_STORED_RIGS = Path(__file__).parent.parent / "assets" / "rigs.npz"
_BLUR_DEG = 12.0  # of `brightest_direction`; less than the rig's spacing of 18 degrees
_BLUR_ROWS = 90  # of its grid of directions


@dataclass(frozen=True, eq=False)
class RigLight:
    """A weighted sum of single lights: unit directions [L, 3] in camera space, rgb weights [L, 3].

    A light of weight 1 gives a white Lambertian surface that faces it radiance 1. Weights are non-negative,
    except when they come from spherical harmonics.
    """

    directions: Tensor
    weights: Tensor


def azel_to_direction(azimuth_deg: Tensor | float, elevation_deg: Tensor | float) -> Tensor:
    """Return d = (cos el sin az, sin el, cos el cos az) [..., 3]; azimuth > 0 is to the image's right."""
    azimuth = torch.deg2rad(torch.as_tensor(azimuth_deg))
    return _on_sphere(azimuth, torch.deg2rad(torch.as_tensor(elevation_deg)) + torch.zeros_like(azimuth))


def _on_sphere(azimuth: Tensor, elevation: Tensor) -> Tensor:
    ring = elevation.cos()
    return torch.stack([ring * azimuth.sin(), elevation.sin(), ring * azimuth.cos()], -1)


def direction_to_azel(directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return azimuth (-180 to 180) and elevation (-90 to 90) in degrees of directions [..., 3]."""
    x, y, z = directions.unbind(-1)
    return torch.rad2deg(torch.atan2(x, z)), torch.rad2deg(torch.atan2(y, torch.hypot(x, z)))


def uv_to_direction(uv: Tensor) -> Tensor:
    """Convert lat-long positions [..., 2] to unit directions: azimuth 180 - 360 u, elevation 90 - 180 v."""
    return _on_sphere(math.pi * (1 - 2 * uv[..., 0]), math.pi * (0.5 - uv[..., 1]))


def direction_to_uv(directions: Tensor) -> Tensor:
    """Convert directions [..., 3] of any length to lat-long positions [..., 2] in [0, 1]."""
    azimuth_deg, elevation_deg = direction_to_azel(directions)
    return torch.stack([0.5 - azimuth_deg / 360, 0.5 - elevation_deg / 180], -1)


def latlong_directions(height: int, width: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return the unit directions [H, W, 3] of a lat-long map's pixel centres."""
    v = (torch.arange(height, dtype=torch.float64) + 0.5) / height
    u = (torch.arange(width, dtype=torch.float64) + 0.5) / width
    grid_v, grid_u = torch.meshgrid(v, u, indexing="ij")
    return uv_to_direction(torch.stack([grid_u, grid_v], -1)).to(dtype)


def latlong_solid_angles(height: int, width: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return exact solid angles [H, W] in steradians of a lat-long map's pixels; they sum to 4 pi."""
    elevation = math.pi * (0.5 - torch.arange(height + 1, dtype=torch.float64) / height)
    band = elevation[:-1].sin() - elevation[1:].sin()
    return (band * (2 * math.pi / width))[:, None].expand(height, width).to(dtype)


def rig_directions(n: int = RIG_LIGHTS) -> Tensor:
    """Return unit directions [n, 3] float32, uniform on the sphere and the same in every call.

    A golden spiral around +y is followed by a fixed number of steps in which neighbouring lights repel each
    other.
    """
    if n < 1:
        raise ValueError(f"a rig needs at least one light, not {n}")
    return torch.from_numpy(_relaxed(n)).float()


@cache  # hundreds of steps
def _relaxed(n: int) -> np.ndarray:
    """Return a rig's directions [n, 3]: stored for the numbers that a photo needs, otherwise computed."""
    with np.load(_STORED_RIGS) as stored:
        return np.asarray(stored[str(n)]) if str(n) in stored else repelled(n)


def repelled(n: int) -> np.ndarray:
    """Compute the directions [n, 3] of a rig."""
    points = golden_spiral(n)
    for step in range(_RELAX_STEPS if n > 1 else 0):
        points = _repel(points, 0.2 * (1 - step / _RELAX_STEPS))
    return points


def golden_spiral(points: int) -> np.ndarray:
    """Return unit vectors [points, 3] on a spiral around +y, each with an equal fraction of the sphere."""
    index = np.arange(points)
    azimuth = index * math.pi * (3 - math.sqrt(5))
    y = 1 - (2 * index + 1) / points
    ring = np.sqrt(1 - y * y)
    return np.stack([ring * np.sin(azimuth), y, ring * np.cos(azimuth)], -1)


def _repel(points: np.ndarray, step: float) -> np.ndarray:
    """Move unit vectors [L, 3] apart by at most `step` times their mean spacing."""
    from scipy.spatial import cKDTree  # not needed for a photo

    spacing = math.sqrt(4 * math.pi / len(points))
    distance, neighbour = cKDTree(points).query(points, k=min(_RELAX_NEIGHBOURS + 1, len(points)))
    away = points[:, None] - points[neighbour[:, 1:]]
    force = (away * (spacing / distance[:, 1:, None]) ** 6 / spacing).sum(1)
    force -= (force * points).sum(-1, keepdims=True) * points
    length = np.linalg.norm(force, axis=-1, keepdims=True)
    moved = points + step * spacing * force / (1 + length)
    return moved / np.linalg.norm(moved, axis=-1, keepdims=True)


def brightest_direction(light: RigLight) -> Tensor:
    """Return the unit direction [3] with the greatest blurred luminance; 0 for a dark light.

    The blur, a von Mises-Fisher lobe, adds the weights of neighbouring lights that represent the same source.
    """
    luminance = light.weights.double() @ torch.tensor(LUMINANCE, dtype=torch.float64)
    where = latlong_directions(_BLUR_ROWS, 2 * _BLUR_ROWS, torch.float64).reshape(-1, 3)
    sharpness = 1 / math.radians(_BLUR_DEG) ** 2
    blurred = torch.exp(sharpness * (where @ light.directions.double().T - 1)) @ luminance
    best = int(blurred.argmax())
    return (where[best] if blurred[best] > 0 else torch.zeros(3, dtype=torch.float64)).float()
