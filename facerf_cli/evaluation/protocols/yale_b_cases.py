"""What is asked of real faces under real point lights: sources, targets and mask on Extended Yale B.

The cases of the benchmark beside which we stand (its README publishes the peers' figures): from a picture
under one flash, or under a soft light summed from the subject's own pictures, to single flashes or to an
environment. Pictures are close to linear in light and taken as linear. The definitions are the benchmark's to
the letter, so that figures can stand side by side; directions are DESIGN's.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise

import numpy as np
import torch

from facerf_cli.capture.yale_b import HEIGHT_PX, WIDTH_PX, Flash, YaleB
from facerf_cli.errors import InputError
from facerf_cli.light.sphere import azel_to_direction

SETTINGS_SUBJECTS = ("yaleB05", "yaleB15", "yaleB22", "yaleB30")  # on whom settings may be chosen
ANGLES_DEG = (0, 15, 30, 45, 60, 80)  # between flash and camera
FRONTAL = Flash(0, 0)
SOFT_SOURCES = ("dome", "win_left", "win_right", "overhead")
ENVIRONMENT_SOURCES = ("frontal", "win_left")
ENVIRONMENTS = ("env_key_fill", "env_under", "env_two_side", "env_sky")
_CORE = tuple(  # what soft sources are relit to
    Flash(*angles)
    for angles in (
        (0, 0), (-25, 0), (25, 0), (-50, 0), (50, 0), (-70, 0), (70, 0), (-35, 40), (35, 40), (0, -35)
    )
)  # fmt: skip
_WIDEST_DEG, _HIGHEST_DEG = 75, 40  # flashes beyond leave most of the face dark
_SPHERE_POINTS = 20_000  # that an environment is summed over
_WHITE, _WHITE_PERCENTILE = 0.9, 99  # an environment's picture is exposed for its bright skin

Radiance = Callable[[np.ndarray], np.ndarray]  # of directions [N, 3]


def _lobe(azimuth_deg: float, elevation_deg: float, sharpness: float) -> Radiance:
    """A soft lamp about a direction of DESIGN's axes, 1 at its middle."""
    angles = torch.tensor([azimuth_deg, elevation_deg], dtype=torch.float64)
    middle = azel_to_direction(angles[0], angles[1]).numpy()
    return lambda directions: np.exp(sharpness * (directions @ middle - 1))


def _ahead(directions: np.ndarray) -> np.ndarray:
    return (directions[:, 2] > 0).astype(float)


_RADIANCES: Mapping[str, tuple[tuple[float, Radiance], ...]] = {  # sums, in units of their own
    "dome": ((1, _ahead),),
    "win_left": ((1, _lobe(-60, 15, 8)), (0.06, _ahead)),
    "win_right": ((1, _lobe(60, 15, 8)), (0.06, _ahead)),
    "overhead": ((1, _lobe(0, 65, 6)), (0.06, _ahead)),
    "env_key_fill": ((1, _lobe(-45, 30, 20)), (0.25, _lobe(50, 5, 12)), (0.02, _ahead)),
    "env_under": ((1, _lobe(15, -35, 12)), (0.04, _ahead)),
    "env_two_side": ((1, _lobe(-80, 5, 12)), (0.7, _lobe(80, 5, 12)), (0.02, _ahead)),
    "env_sky": ((1, lambda directions: directions[:, 1].clip(0)), (0.25, lambda d: np.ones(len(d)))),
}


@dataclass(frozen=True)
class Question:
    """A source and the light that it is to be relit to, each by name; `column` is the table's."""

    column: str  # 'frontal', 'soft' or 'environment'
    source: str
    light: str  # a flash or an environment

    @property
    def angle_deg(self) -> float | None:
        """Between the flash and the camera; None for an environment."""
        flash = Flash.named(self.light)
        return None if flash is None else flash.angle_deg

    @property
    def angle_bin(self) -> str | None:
        """Of a single flash from the frontal source."""
        if self.column != "frontal" or self.angle_deg is None:
            return None
        bins = (f"{low}-{high} deg" for low, high in pairwise(ANGLES_DEG) if low <= self.angle_deg < high)
        return next(bins, None)


@dataclass(frozen=True, eq=False)
class Sitter:
    """A subject of the database: all pictures, and what is made of them. Grey, in 0..1."""

    database: YaleB
    name: str

    @cached_property
    def flashes(self) -> list[Flash]:
        """Those that the subject has a sound picture under."""
        return self.database.flashes(self.name)

    @cached_property
    def olats(self) -> np.ndarray:
        """The subject under each of the flashes [L, 192, 168]."""
        return self.database.images(self.name)

    def image(self, light: str) -> np.ndarray:
        """The subject [192, 168] under a flash, by name, or 'frontal', or an environment: float32."""
        flash = FRONTAL if light == "frontal" else Flash.named(light)
        if flash is None:
            return self._exposed(light)
        if flash not in self.flashes:
            raise InputError(f"{self.database.folder / self.name}: has no sound picture under {flash.name}")
        return self.olats[self.flashes.index(flash)]

    def _exposed(self, environment: str) -> np.ndarray:
        """The pictures' sum under an environment, bright skin at 0.9, clipped at white."""
        total = np.einsum("l,lij->ij", self.weights(environment), self.olats)
        white = np.percentile(total[face_mask()], _WHITE_PERCENTILE)
        return (total * _WHITE / white).clip(0, 1).astype(np.float32)

    def weights(self, light: str) -> np.ndarray:
        """The weight [L] of each flash under one of them, or under an environment (they sum to 1)."""
        if light in _RADIANCES:
            return environment_weights(light, tuple(self.flashes))
        return np.array([float(flash.name == light) for flash in self.flashes])

    def questions(self) -> Iterator[Question]:
        """Every case of the benchmark."""
        for flash in self.flashes:
            within = abs(flash.azimuth_deg) <= _WIDEST_DEG and abs(flash.elevation_deg) <= _HIGHEST_DEG
            if within and flash != FRONTAL:
                yield Question("frontal", "frontal", flash.name)
        for source in SOFT_SOURCES:
            yield from (Question("soft", source, flash.name) for flash in _CORE if flash in self.flashes)
        for source in ENVIRONMENT_SOURCES:
            yield from (Question("environment", source, environment) for environment in ENVIRONMENTS)


@cache
def environment_weights(name: str, flashes: tuple[Flash, ...]) -> np.ndarray:
    """An environment's radiance summed over each flash's Voronoi cell on the sphere [L]; they sum to 1."""
    directions = _spiral(_SPHERE_POINTS)
    nearest = np.argmax(directions @ np.stack([flash.direction for flash in flashes]).T, 1)
    radiance = sum(share * part(directions) for share, part in _RADIANCES[name])
    summed = np.bincount(nearest, weights=radiance, minlength=len(flashes))
    return summed / summed.sum()


def _spiral(points: int) -> np.ndarray:
    """Directions [N, 3], a golden spiral about +y; the benchmark's, whose cells the weights hang on."""
    index = np.arange(points) + 0.5
    y = 1 - 2 * index / points
    ring, angle = np.sqrt(1 - y * y), np.pi * (1 + 5**0.5) * index
    return np.stack([ring * np.cos(angle), y, ring * np.sin(angle)], 1)


@cache
def face_mask() -> np.ndarray:
    """Where pictures are compared, bool [192, 168]: one ellipse for all."""
    y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX] + 0.5
    return ((x - 84) / 70) ** 2 + ((y - 98) / 88) ** 2 <= 1
