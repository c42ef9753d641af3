"""The cases of Extended Yale B: sources, targets and the mask, for real faces under real point lights.

A source is an image under one flash, or under a soft light summed from the subject's own images; its targets
are single flashes or environments. Images are close to linear in light and taken as linear. All definitions
are those of the benchmark whose README publishes other methods' figures, so that figures can be compared;
directions are in camera space (docs/design.md).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from facerf_cli.capture.yale_b import HEIGHT_PX, WIDTH_PX, Flash, YaleB, read_shifts, read_yale_b
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.measure import Case, Comparison
from facerf_cli.evaluation.options import Chosen, YaleOptions
from facerf_cli.evaluation.people import Bench
from facerf_cli.light.entries import StudioLight
from facerf_cli.light.light import Light, far_samples
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.person import Target

SETTINGS_SUBJECTS = ("yaleB05", "yaleB15", "yaleB22", "yaleB30")  # settings may be chosen on these
ANGLES_DEG = (0, 15, 30, 45, 60, 80)  # between flash and camera
FRONTAL = Flash(0, 0)
SOFT_SOURCES = ("dome", "win_left", "win_right", "overhead")
ENVIRONMENT_SOURCES = ("frontal", "win_left")
ENVIRONMENTS = ("env_key_fill", "env_under", "env_two_side", "env_sky")
_CORE = tuple(  # targets of the soft sources
    Flash(*angles)
    for angles in (
        (0, 0), (-25, 0), (25, 0), (-50, 0), (50, 0), (-70, 0), (70, 0), (-35, 40), (35, 40), (0, -35)
    )
)  # fmt: skip
_WIDEST_DEG, _HIGHEST_DEG = 75, 40  # beyond these angles most of the face is dark
_SPHERE_POINTS = 20_000  # samples of an environment
_WHITE, _WHITE_PERCENTILE = 0.9, 99  # an environment's image is exposed so that bright skin has this value

Radiance = Callable[[np.ndarray], np.ndarray]  # from directions [N, 3] to values [N]


def _lobe(azimuth_deg: float, elevation_deg: float, sharpness: float) -> Radiance:
    """A soft light around a direction, 1 at its centre."""
    angles = torch.tensor([azimuth_deg, elevation_deg], dtype=torch.float64)
    centre = azel_to_direction(angles[0], angles[1]).numpy()
    return lambda directions: np.exp(sharpness * (directions @ centre - 1))


def _ahead(directions: np.ndarray) -> np.ndarray:
    return (directions[:, 2] > 0).astype(float)


_RADIANCES: Mapping[str, tuple[tuple[float, Radiance], ...]] = {  # weighted sums, of any unit
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
class Relighting:
    """A source and its target light, each by name; `column` is that of the tables."""

    column: str  # 'frontal', 'soft' or 'environment'
    source: str
    light: str  # a flash or an environment

    def case(self, subject: str) -> Case:
        """The case, named by the path of its prediction in the benchmark.

        Angles are those between a flash and the camera's axis; classes are of the frontal source alone.
        """
        facts: dict[str, str | float] = {"column": self.column, "source": self.source}
        flash = Flash.named(self.light)
        for low, high in pairwise(ANGLES_DEG):
            if flash is not None and self.column == "frontal" and low <= flash.angle_deg < high:
                facts["angle"] = f"{low}-{high} deg"
        facts["subjects"] = "settings" if subject in SETTINGS_SUBJECTS else "test"
        if flash is not None:
            facts["angle_deg"] = flash.angle_deg
        return Case(f"{subject}/{self.source}/{self.light}", subject, facts)


class YaleSubject:
    """A subject of the database: images under the `flashes` that have an undamaged one, and their sums.

    `olats` [L, 192, 168] are those images, grey, in 0..1.
    """

    def __init__(self, database: YaleB, name: str) -> None:
        self._folder = database.folder / name
        self.flashes, self.olats = database.flashes(name), database.images(name)
        self._weights = {light: environment_weights(light, self.flashes) for light in _RADIANCES}

    def image(self, light: str) -> np.ndarray:
        """The subject's image [192, 168], float32, under a flash by name, 'frontal', or an environment.

        Raises InputError for a flash without an undamaged image.
        """
        flash = FRONTAL if light == "frontal" else Flash.named(light)
        if flash is None:
            return self._exposed(light)
        if flash not in self.flashes:
            raise InputError(f"{self._folder}: no undamaged image under {flash.name}; leave it out")
        return self.olats[self.flashes.index(flash)]

    def _exposed(self, environment: str) -> np.ndarray:
        """The images' weighted sum under an environment, bright skin at 0.9, clipped at white."""
        total = np.einsum("l,lij->ij", self.weights(environment), self.olats)
        white = np.percentile(total[face_mask()], _WHITE_PERCENTILE)
        return (total * _WHITE / white).clip(0, 1).astype(np.float32)

    def weights(self, light: str) -> np.ndarray:
        """The weight [L] of each flash in a target, which is a flash or an environment; they sum to 1."""
        if light in self._weights:
            return self._weights[light]
        return np.array([float(flash.name == light) for flash in self.flashes])

    def relightings(self) -> Iterator[Relighting]:
        """Yield every case of the subject."""
        for flash in self.flashes:
            within = abs(flash.azimuth_deg) <= _WIDEST_DEG and abs(flash.elevation_deg) <= _HIGHEST_DEG
            if within and flash != FRONTAL:
                yield Relighting("frontal", "frontal", flash.name)
        for source in SOFT_SOURCES:
            yield from (Relighting("soft", source, flash.name) for flash in _CORE if flash in self.flashes)
        for source in ENVIRONMENT_SOURCES:
            yield from (Relighting("environment", source, environment) for environment in ENVIRONMENTS)


def environment_weights(name: str, flashes: Sequence[Flash]) -> np.ndarray:
    """Sum an environment's radiance over each flash's Voronoi cell on the sphere [L]; the sum is 1."""
    # Directions on a golden spiral about +y, as in the benchmark: the cells depend on them.
    index = np.arange(_SPHERE_POINTS) + 0.5
    y = 1 - 2 * index / _SPHERE_POINTS
    ring, angle = np.sqrt(1 - y * y), np.pi * (1 + 5**0.5) * index
    directions = np.stack([ring * np.cos(angle), y, ring * np.sin(angle)], 1)
    nearest = np.argmax(directions @ np.stack([flash.direction for flash in flashes]).T, 1)
    radiance = sum(share * part(directions) for share, part in _RADIANCES[name])
    summed = np.bincount(nearest, weights=radiance, minlength=len(flashes))
    return summed / summed.sum()


def face_mask() -> np.ndarray:
    """The mask of the comparison, bool [192, 168]: one ellipse for all images."""
    y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX] + 0.5
    return ((x - 84) / 70) ** 2 + ((y - 98) / 88) ** 2 <= 1


def choose_subjects(options: YaleOptions, inputs: Sequence[str]) -> Chosen:
    """Choose subjects of a folder of the database, all if none are named."""
    database = read_yale_b(Path(inputs[0]), None if options.shifts is None else read_shifts(options.shifts))
    if unknown := sorted(set(options.subjects) - set(database.subjects)):
        there = ", ".join(database.subjects)
        raise UsageError(f"--subjects {', '.join(unknown)}: not in {database.folder}; give some of {there}")
    chosen = [name for name in database.subjects if not options.subjects or name in options.subjects]
    return Chosen({options.item(database.folder / name, name): (database, name) for name in chosen})


def compare_subject(database: YaleB, name: str, bench: Bench, room: float = 0.0) -> Iterator[Comparison]:
    """Yield all of a subject's cases, a source at a time: each method's image next to the subject's own.

    A subject's sources share the landmarks, or the box, of its frontal image. `room` is what comes back from
    all around, as a share of what a flash sends. Raises InputError where no face is found, or an image cannot
    be read.
    """
    subject = YaleSubject(database, name)
    relightings = list(subject.relightings())
    face = bench.find(_rgb(subject.image("frontal")), str(database.folder / name))
    places_px = None if bench.geometry == "network" else face.landmarks_px
    for source in dict.fromkeys(one.source for one in relightings):
        of_source = [one for one in relightings if one.source == source]
        photo = _rgb(subject.image(source))
        lights = _lights(subject, of_source, room)
        relit = {
            method.name: [
                image.mean(-1).clip(min=0) for image in method.images(photo, head, lights, Target())
            ]
            for method, head in bench.heads(photo, face)
        }
        for row, one in enumerate(of_source):
            yield Comparison(
                case=one.case(name),
                truth=_rgb(subject.image(one.light)),
                mask=face_mask().astype(np.float32),
                predictions={method: _rgb(images[row]) for method, images in relit.items()},
                source=photo,
                landmarks_px=places_px,
                source_face=None if places_px is None else (face_mask(), places_px),
            )


def _rgb(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[..., None], 3, -1).astype(np.float32)


def _lights(subject: YaleSubject, relightings: Sequence[Relighting], room: float) -> Light:
    """A sum of flashes for each target, with the room's share of each."""
    weights = torch.from_numpy(np.stack([subject.weights(one.light) for one in relightings])).float()
    used = weights.sum(0) > 0
    directions = torch.from_numpy(np.stack([flash.direction for flash in subject.flashes])).float()[used]
    weights = weights[:, used]
    if room:
        around, share = far_samples(StudioLight())
        directions = torch.cat([directions, around])
        weights = torch.cat([weights, room * share * weights.sum(1, keepdim=True)], 1)
    return Light(directions, weights[..., None].expand(-1, -1, 3))
