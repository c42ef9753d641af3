"""Make the four environment maps of the examples: `python tools/make_maps.py [FOLDER]`.

Scene-linear Rec.709, OpenEXR's lat-long convention (the centre is +z, behind the camera). Each is built from
directions, not from pictures, so nothing in them belongs to anyone. Their mean radiance over the sphere is 1.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.files.write import write_exr
from facerf_cli.light.sphere import azel_to_direction, latlong_directions, latlong_solid_angles

HEIGHT_PX, SAMPLES = 128, 4  # samples x samples in a pixel
WARM, COOL, WHITE = (1.0, 0.62, 0.32), (0.45, 0.65, 1.0), (1.0, 0.97, 0.93)


def colour(rgb: tuple[float, float, float], amount: Tensor) -> Tensor:
    """Light of one colour [..., 3] where amount [...] is."""
    return amount[..., None] * torch.tensor(rgb)


def step(value: Tensor, edge: float, width: float) -> Tensor:
    """0 below the edge, 1 above, smoothly over `width`."""
    x = ((value - edge) / width + 0.5).clamp(0, 1)
    return x * x * (3 - 2 * x)


def disc(directions: Tensor, azimuth_deg: float, elevation_deg: float, radius_deg: float) -> Tensor:
    """1 inside a round light."""
    cosine = directions @ azel_to_direction(azimuth_deg, elevation_deg)
    return step(-torch.rad2deg(cosine.clamp(-1, 1).acos()), -radius_deg, 0.3 * radius_deg)


def softbox(directions: Tensor, azimuth_deg: float, elevation_deg: float, wide: float, high: float) -> Tensor:
    """1 inside a flat rectangle of half sizes `wide` and `high` at distance 1, brighter in its middle."""
    ahead = azel_to_direction(azimuth_deg, elevation_deg)
    right = azel_to_direction(azimuth_deg + 90.0, 0.0)
    up = torch.linalg.cross(ahead, right)
    depth = (directions @ ahead).clamp(min=1e-3)
    x, y = directions @ right / depth / wide, directions @ up / depth / high
    inside = step(1 - x.abs(), 0, 0.08) * step(1 - y.abs(), 0, 0.08) * (directions @ ahead > 0)
    return inside * (1 - 0.3 * (x * x + y * y))


def low_sun(directions: Tensor) -> Tensor:
    """A late sun on the picture's right, a blue sky that warms toward it, dry ground."""
    height = directions[..., 1]
    sun = azel_to_direction(65.0, 14.0)
    toward = (directions @ sun).clamp(min=0)
    sky = colour((0.20, 0.38, 0.80), 0.5 + 0.5 * height) + colour(
        WARM, 0.8 * (1 - height.abs()) ** 6 * toward
    )
    sky = (
        sky + colour(WARM, 2.0 * toward**40) + colour((1.0, 0.72, 0.45), 420 * disc(directions, 65, 14, 2.2))
    )
    above = step(height, 0, 0.02)[..., None]
    return above * sky + (1 - above) * colour((0.30, 0.24, 0.17), 0.5 + 0.8 * toward)


def studio(directions: Tensor) -> Tensor:
    """A large key on the picture's left, a strip behind on the right, a low fill, dark walls."""
    walls = colour((0.03, 0.03, 0.035), torch.ones(directions.shape[:-1]))
    key = colour(WHITE, 22 * softbox(directions, -42, 32, 0.55, 0.75))
    rim = colour((0.9, 0.95, 1.0), 30 * softbox(directions, 128, 15, 0.16, 0.9))
    fill = colour(WHITE, 2.5 * softbox(directions, 40, -8, 0.8, 0.5))
    return walls + key + rim + fill


def overcast(directions: Tensor) -> Tensor:
    """The CIE's standard overcast sky over grey ground."""
    height = directions[..., 1]
    above = step(height, 0, 0.02)
    dome = (1 + 2 * height.clamp(min=0)) / 3 * above
    return colour((0.88, 0.95, 1.0), dome) + colour((0.10, 0.10, 0.09), 1 - above)


def stage(directions: Tensor) -> Tensor:
    """Magenta from the picture's left, cyan from its right, an amber lamp above, black elsewhere."""
    dark = colour((0.01, 0.01, 0.02), torch.ones(directions.shape[:-1]))
    left = colour((1.0, 0.08, 0.55), 40 * disc(directions, -75, 12, 13))
    right = colour((0.05, 0.60, 1.0), 40 * disc(directions, 75, 12, 13))
    top = colour((1.0, 0.55, 0.12), 30 * disc(directions, 0, 62, 10))
    return dark + left + right + top


MAPS: dict[str, Callable[[Tensor], Tensor]] = {
    "low_sun": low_sun,
    "overcast": overcast,
    "stage": stage,
    "studio": studio,
}


def make_map(radiance: Callable[[Tensor], Tensor]) -> np.ndarray:
    """A map [H, W, 3]: averaged over each pixel, then scaled to mean radiance 1 over the sphere."""
    fine = radiance(latlong_directions(HEIGHT_PX * SAMPLES, 2 * HEIGHT_PX * SAMPLES)).permute(2, 0, 1)
    envmap = torch.nn.functional.avg_pool2d(fine, SAMPLES).permute(1, 2, 0)
    share = latlong_solid_angles(HEIGHT_PX, 2 * HEIGHT_PX)[..., None] / (4 * torch.pi)
    return (envmap / (envmap.mean(-1, keepdim=True) * share).sum()).numpy()


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1] / "examples/maps"
    for name, radiance in MAPS.items():
        write_exr(folder / f"{name}.exr", make_map(radiance), metadata={"Software": "facerf make_maps.py"})
