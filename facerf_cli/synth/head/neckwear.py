"""Turtlenecks and scarves: cloth around the neck of a synthetic head, over its garment."""

import numpy as np

from facerf_cli.synth.head.hull import Hull, hull_of
from facerf_cli.synth.head.mesh import HeadMesh, joined, ring_surface

NECKWEAR = ("turtleneck", "scarf")

_AROUND = 144  # vertices around the neck
_ROWS = 26  # rings of a surface
_FLARE_M = 0.03  # below the chin the neck is at its narrowest


def draw_neckwear(head: HeadMesh, chin_m: float, random: np.random.Generator) -> HeadMesh:
    """Draw a turtleneck or a scarf for a bare head whose chin is at this height, as part "cloth"."""
    if random.choice(NECKWEAR) == "turtleneck":
        return _turtleneck(hull_of(head), chin_m, random)
    return draw_wraps(head, chin_m, int(random.integers(1, 3)), random)


def draw_wraps(head: HeadMesh, chin_m: float, count: int, random: np.random.Generator) -> HeadMesh:
    """Draw turns of a scarf around the neck of a bare head, each below the one before."""
    hull = hull_of(head)
    return joined(*(_wrap(hull, chin_m, index, random) for index in range(count)))


def _turtleneck(hull: Hull, chin_m: float, random: np.random.Generator) -> HeadMesh:
    """A band that stands around the neck and is folded over at its upper edge."""
    azimuth = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    slope = 0.012 * ((1 - np.cos(azimuth)) / 2) ** 0.8  # lower at the front than at the back
    top = chin_m - random.uniform(0.014, 0.028) + slope
    fold = random.uniform(0.055, 0.075)
    share = np.linspace(0, 1, _ROWS)[:, None]
    inner = share[:6] / share[5]
    level = np.concatenate([top - 0.03 + 0.03 * inner, top - fold * share[1:]])
    bulge = 0.0035 + 0.005 * np.sqrt(np.sin(np.pi * np.clip(share[1:], 0.02, 0.98)))
    off = np.concatenate([0.002 + 0 * inner, bulge])
    off = off + 0.0006 * np.sin(azimuth * 60) * (off > 0.003)  # ribs
    return _loft(hull, chin_m, azimuth, level, off)


def _wrap(hull: Hull, chin_m: float, index: int, random: np.random.Generator) -> HeadMesh:
    """One turn of a scarf: a soft roll, hanging lower in front, with folds along it."""
    azimuth = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    around = np.linspace(0, 2 * np.pi, _ROWS)[:, None]
    high, deep = random.uniform(0.022, 0.032), random.uniform(0.022, 0.034)
    hang = random.uniform(0.01, 0.04) * ((1 + np.cos(azimuth)) / 2) ** 2
    roll = np.zeros((_ROWS, _AROUND))
    for _ in range(5):
        phase = random.integers(1, 5) * azimuth + random.integers(1, 6) * around + random.uniform(0, 6.3)
        roll += random.uniform(0.2, 0.6) * (1 - 2 * np.abs(np.sin(phase / 2)) ** 0.7)
    level = chin_m - 0.034 - 0.024 * index - hang + high * np.sin(around)
    off = 0.003 + deep * (1 - np.cos(around)) / 2 * (1 + 0.08 * roll)
    return _loft(hull, chin_m, azimuth, level, off)


def _loft(hull: Hull, chin_m: float, azimuth: np.ndarray, level: np.ndarray, off: np.ndarray) -> HeadMesh:
    """Mesh rings at heights [R, N] and distances [R, N] off the hull, at azimuths [N]."""
    level = np.broadcast_to(level, off.shape)
    outward = np.stack([np.sin(azimuth), 0 * azimuth, np.cos(azimuth)], -1)
    far = outward + np.array([0, 0, hull.middle[2]])
    far = np.stack([np.broadcast_to(far[:, 0], off.shape), level, np.broadcast_to(far[:, 2], off.shape)], -1)
    neck = np.maximum(level, chin_m - _FLARE_M)  # further down the shoulders begin
    on_neck = np.stack([far[..., 0], neck, far[..., 2]], -1)
    rings = far - ((hull.height(on_neck) - off)[..., None]) * outward
    return ring_surface("cloth", rings if _faces_out(rings, outward) else rings[::-1])


def _faces_out(rings: np.ndarray, outward: np.ndarray) -> bool:
    """Test if rings [R, N, 3] go down on their outer side; outward [N, 3]: away from the neck."""
    reach = (rings * outward).sum(-1).mean(1)
    outer = int(reach.argmax())
    inner = rings[max(outer - 1, 0) : outer + 2, :, 1].mean(1)
    return bool(inner[0] > inner[-1])
