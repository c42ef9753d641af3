"""Procedural envmaps by seed and index: lat-long images [H, 2 H, 3], scene-linear Rec.709.

`light/sphere.py` defines their directions.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from facerf_cli.errors import UsageError
from facerf_cli.synth.random_fields import Random
from facerf_cli.synth.sky.interiors import hall, stage, studio, windows
from facerf_cli.synth.sky.outdoors import dusk, night, overcast, sun
from facerf_cli.synth.sky.painting import Grid, make_grid

_PEAK = 60000.0  # below the largest half float, 65504
KINDS: dict[str, Callable[[Grid, Random], np.ndarray]] = {
    kind.__name__: kind for kind in (sun, dusk, overcast, windows, hall, studio, night, stage)
}
# Mix of the kinds, which are drawn evenly from this list.
MIX = (*4 * ("sun",), *2 * ("dusk", "overcast", "windows", "hall", "studio"), "night", "stage")


def kind_of(index: int, seed: int, kinds: Sequence[str] = MIX) -> str:
    """Draw the kind of map number `index`, a function of only (seed, index)."""
    return kinds[int(np.random.default_rng([seed, index, 0]).integers(len(kinds)))]


def draw_sky(index: int, seed: int, width_px: int, kinds: Sequence[str] = MIX) -> tuple[np.ndarray, str]:
    """Draw map number `index`, [width / 2, width, 3] float32, and its kind.

    The mean radiance over the sphere is 1, or less where the brightest pixel would overflow half floats.
    """
    kind, grid = kind_of(index, seed, kinds), make_grid(width_px)
    radiance = KINDS[kind](grid, np.random.default_rng([seed, index, 1]))
    mean = (radiance.mean(-1) * grid.solid_angles_sr).sum() / (4 * np.pi)
    return (radiance / max(mean, radiance.max() / _PEAK)).astype(np.float32), kind


@dataclass(frozen=True)
class ProceduralMaps:
    """Sequence of `maps` procedural envmaps, each drawn on access."""

    maps: int
    seed: int
    width_px: int

    def __len__(self) -> int:
        return self.maps

    def __getitem__(self, index: int) -> np.ndarray:
        if not 0 <= index < self.maps:
            raise IndexError(index)
        return draw_sky(index, self.seed, self.width_px)[0]


def parse_envmaps(text: str, seed: int, width_px: int = 256) -> ProceduralMaps:
    """Parse `procedural:N`, which stands for N procedural envmaps in place of files."""
    match = re.fullmatch(r"procedural:([1-9]\d{0,8})", text)
    if not match:
        raise UsageError(f"{text}: not a set of procedural maps; write procedural:N, such as procedural:100")
    return ProceduralMaps(int(match[1]), seed, width_px)
