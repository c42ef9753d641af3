"""Lists of a stage's lights beside its images, for drafts of `stage.json`.

Vectors of a list (`files.texts.read_light_list`) are directions, or positions relative to the object. Where
they lie on a sphere about another place, they are positions in the axes of the stage: in metres or, if that
would be too large a stage, in millimetres.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from facerf_cli.files.texts import ListedLight, Vector

_DIGITS = 6
_LARGEST_STAGE = 20.0  # radius in metres: larger ones are in millimetres
_ASIDE, _OFF = 0.05, 0.1  # of the radius: a middle farther away is a place; lights are so near to the sphere
_FEWEST = 8  # lights that determine a sphere


@dataclass(frozen=True)
class DraftLights:
    """Entries of lights as `stage.json` has them, by their ids; `centre_m` is where intensities hold."""

    entries: dict[str, dict[str, Vector]] = field(default_factory=dict)
    centre_m: Vector | None = None
    unit_m: float | None = None  # of the list, where that is of positions
    kind: str = "directions"
    assumed: str = "x right, y up, z toward the camera, as world space"


def draft_lights(found: Mapping[str, Vector], everything: Sequence[Vector]) -> DraftLights:
    """Describe lights by their vectors, which are some of all of a list's."""
    vectors = np.array(everything)
    middle = sphere_middle(vectors) if len(vectors) >= _FEWEST else np.zeros(3)
    distances = np.linalg.norm(vectors - middle, axis=1)
    radius = float(distances.mean())
    if np.linalg.norm(middle) < _ASIDE * radius or np.abs(distances / radius - 1).max() > _OFF:
        entries = {light: {"direction": _rounded(_unit(vector))} for light, vector in found.items()}
        words = DraftLights.assumed
        if abs(radius - 1) > _ASIDE:
            words += ", whose lengths are left out: a light that is near needs its 'position' in metres"
        return DraftLights(entries, assumed=words)
    unit_m, unit = (1e-3, "millimetres") if radius > _LARGEST_STAGE else (1.0, "metres")
    entries = {light: {"position": _rounded(unit_m * np.array(vector))} for light, vector in found.items()}
    words = f"taken as {unit} in the axes of the cameras; 'centre' is the middle of their sphere"
    return DraftLights(entries, _rounded(unit_m * middle), unit_m, "positions", words)


def sphere_middle(points: np.ndarray) -> np.ndarray:
    """The middle [3] of the sphere nearest to points [N, 3], by linear least squares."""
    terms = np.column_stack([2 * points, np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(terms, (points**2).sum(1), rcond=None)[0][:3])


def match_lights(
    listed: Sequence[ListedLight], light_ids: Sequence[str], light_of_stem: Mapping[str, str]
) -> dict[str, Vector]:
    """Assign listed vectors to lights by name; a list without names goes by the order of the lights.

    `light_of_stem` maps the stem of an image's file name to its light.
    """
    if not any(name for name, _ in listed):
        pairs = zip(light_ids, listed, strict=True) if len(listed) == len(light_ids) else ()
        return {light: vector for light, (_, vector) in pairs}
    known = {**light_of_stem, **{light: light for light in light_ids}}
    found = {}
    for path, vector in listed:
        name = path.replace("\\", "/").split("/")[-1]
        light = known.get(name) or known.get(name.rpartition(".")[0])
        if light is not None:
            found[light] = vector
    return found


def _unit(vector: Vector) -> np.ndarray:
    return np.array(vector) / np.linalg.norm(vector)


def _rounded(values: np.ndarray) -> Vector:
    rounded: Vector = (values.round(_DIGITS) + 0.0).tolist()  # turns -0.0 into 0.0
    return rounded
