"""Protocol `yale-b`: relight real faces of Extended Yale B to real point lights.

A source is an image under one flash, or under a soft light, summed from the subject's images; its targets are
single flashes or environments. The images are nearly linear in light and treated as linear. All definitions
match the benchmark that publishes other methods' results, so results are comparable. Directions are in camera
space (docs/design.md).
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
ANGLES_DEG = (0, 15, 30, 45, 60, 80)  # classes of the angle between flash and camera axis
FRONTAL = Flash(0, 0)
SOFT_SOURCES = ("dome", "win_left", "win_right", "overhead")
ENVIRONMENT_SOURCES = ("frontal", "win_left")
ENVIRONMENTS = ("env_key_fill", "env_under", "env_two_side", "env_sky")
_SOFT_TARGETS = tuple(
    Flash(*angles)
    for angles in (
        (0, 0), (-25, 0), (25, 0), (-50, 0), (50, 0), (-70, 0), (70, 0), (-35, 40), (35, 40), (0, -35)
    )
)  # fmt: skip
_WIDEST_DEG, _HIGHEST_DEG = 75, 40  # beyond these angles, most of the face is dark
_SPHERE_POINTS = 20_000  # samples of an environment
_WHITE, _WHITE_PERCENTILE = 0.9, 99  # value of bright skin in an environment's image, and its percentile

Radiance = Callable[[np.ndarray], np.ndarray]  # from directions [N, 3] to values [N]


def _lobe(azimuth_deg: float, elevation_deg: float, sharpness: float) -> Radiance:
    """Return a soft light around a direction, with value 1 at its centre."""
    angles = torch.tensor([azimuth_deg, elevation_deg], dtype=torch.float64)
    centre = azel_to_direction(angles[0], angles[1]).numpy()
    return lambda directions: np.exp(sharpness * (directions @ centre - 1))


def _ahead(directions: np.ndarray) -> np.ndarray:
    return (directions[:, 2] > 0).astype(float)


_RADIANCES: Mapping[str, tuple[tuple[float, Radiance], ...]] = {  # weighted sums in an arbitrary unit
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
    """Names of a source and its target light."""

    column: str  # of the tables: 'frontal', 'soft' or 'environment'
    source: str
    light: str  # a flash or an environment

    def case(self, subject: str) -> Case:
        """Return the case, named like the benchmark's file of its prediction.

        Only cases with the frontal source have an angle class.
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
    """Undamaged grey images `olats` [L, 192, 168] in 0..1 of a subject under `flashes`, and their sums."""

    def __init__(self, database: YaleB, name: str) -> None:
        self._folder = database.folder / name
        self.flashes, self.olats = database.flashes(name), database.images(name)
        self._weights = {light: environment_weights(light, self.flashes) for light in _RADIANCES}

    def image(self, light: str) -> np.ndarray:
        """Return the subject's image [192, 168], float32, under a flash, 'frontal' or an environment.

        An environment's image is a weighted sum, exposed for bright skin and clipped at white. Raises
        InputError for a flash without an undamaged image.
        """
        flash = FRONTAL if light == "frontal" else Flash.named(light)
        if flash is None:
            total = np.einsum("l,lij->ij", self.weights(light), self.olats)
            white = np.percentile(total[face_mask()], _WHITE_PERCENTILE)
            return (total * _WHITE / white).clip(0, 1).astype(np.float32)
        if flash not in self.flashes:
            raise InputError(f"{self._folder}: no undamaged image under {flash.name}; remove the subject")
        return self.olats[self.flashes.index(flash)]

    def weights(self, light: str) -> np.ndarray:
        """Return the weight [L] of each flash in a flash or an environment; the sum is 1."""
        if light in self._weights:
            return self._weights[light]
        return np.array([float(flash.name == light) for flash in self.flashes])

    def relightings(self) -> Iterator[Relighting]:
        for flash in self.flashes:
            within = abs(flash.azimuth_deg) <= _WIDEST_DEG and abs(flash.elevation_deg) <= _HIGHEST_DEG
            if within and flash != FRONTAL:
                yield Relighting("frontal", "frontal", flash.name)
        for source in SOFT_SOURCES:
            targets = [flash.name for flash in _SOFT_TARGETS if flash in self.flashes]
            yield from (Relighting("soft", source, target) for target in targets)
        for source in ENVIRONMENT_SOURCES:
            yield from (Relighting("environment", source, environment) for environment in ENVIRONMENTS)


def environment_weights(name: str, flashes: Sequence[Flash]) -> np.ndarray:
    """Sum an environment's radiance over each flash's Voronoi cell on the sphere [L], normalised to 1."""
    # The benchmark's samples, on which the cells depend: a golden spiral about +y.
    index = np.arange(_SPHERE_POINTS) + 0.5
    y = 1 - 2 * index / _SPHERE_POINTS
    ring, angle = np.sqrt(1 - y * y), np.pi * (1 + 5**0.5) * index
    directions = np.stack([ring * np.cos(angle), y, ring * np.sin(angle)], 1)
    nearest = np.argmax(directions @ np.stack([flash.direction for flash in flashes]).T, 1)
    radiance = sum(weight * part(directions) for weight, part in _RADIANCES[name])
    summed = np.bincount(nearest, weights=radiance, minlength=len(flashes))
    return summed / summed.sum()


def face_mask() -> np.ndarray:
    """Return the compared pixels of all images, bool [192, 168]: an ellipse."""
    y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX] + 0.5
    return ((x - 84) / 70) ** 2 + ((y - 98) / 88) ** 2 <= 1


def choose_subjects(options: YaleOptions, inputs: Sequence[str]) -> Chosen:
    """Choose the named subjects of the database's folder, by default all."""
    database = read_yale_b(Path(inputs[0]), None if options.shifts is None else read_shifts(options.shifts))
    subjects = database.subjects
    if unknown := sorted(set(options.subjects) - set(subjects)):
        raise UsageError(
            f"--subjects {', '.join(unknown)}: not in {database.folder}; choose from {', '.join(subjects)}"
        )
    chosen = [name for name in subjects if not options.subjects or name in options.subjects]
    return Chosen({options.item(database.folder / name, name): (database, name) for name in chosen})


def compare_subject(options: YaleOptions, bench: Bench, subject: tuple[YaleB, str]) -> Iterator[Comparison]:
    """Yield all cases of a subject, source by source: each method's image and the subject's true image.

    All sources use the landmarks, or the box, of the subject's frontal image. Raises InputError without a
    face, and for unreadable images.
    """
    database, name = subject
    images = YaleSubject(database, name)
    relightings = list(images.relightings())
    face = bench.find(_rgb(images.image("frontal")), str(database.folder / name))
    landmarks_px = None if bench.geometry == "network" else face.landmarks_px
    for source in dict.fromkeys(relighting.source for relighting in relightings):
        of_source = [relighting for relighting in relightings if relighting.source == source]
        photo = _rgb(images.image(source))
        lights = _lights(images, of_source, options.ambient)
        relit = {
            method.name: [
                image.mean(-1).clip(min=0) for image in method.images(photo, head, lights, Target())
            ]
            for method, head in bench.heads(photo, face)
        }
        for row, relighting in enumerate(of_source):
            yield Comparison(
                case=relighting.case(name),
                truth=_rgb(images.image(relighting.light)),
                mask=face_mask().astype(np.float32),
                predictions={method: _rgb(greys[row]) for method, greys in relit.items()},
                source=photo,
                landmarks_px=landmarks_px,
                source_face=None if landmarks_px is None else (face_mask(), landmarks_px),
            )


def _rgb(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[..., None], 3, -1).astype(np.float32)


def _lights(subject: YaleSubject, relightings: Sequence[Relighting], ambient: float) -> Light:
    """Return the targets as sums of flashes, each with uniform light of the fraction `ambient`."""
    weights = torch.from_numpy(np.stack([subject.weights(target.light) for target in relightings])).float()
    used = weights.sum(0) > 0
    directions = torch.from_numpy(np.stack([flash.direction for flash in subject.flashes])).float()[used]
    weights = weights[:, used]
    if ambient:
        around, weight = far_samples(StudioLight())
        directions = torch.cat([directions, around])
        weights = torch.cat([weights, ambient * weight * weights.sum(1, keepdim=True)], 1)
    return Light(directions, weights[..., None].expand(-1, -1, 3))
