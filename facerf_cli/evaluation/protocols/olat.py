"""OLATs of held-out people from pictures in natural light, in the same pose and in others (paper, Table 1).

A pair of a prepared dataset is taken as a user's photo is: its source is unwrapped by its fit, the method
relights it by one light of the target camera's stack, and the texture is rendered into that camera's crop.
Beside the methods stands a naive twin, 'lambert': the source's own texture under the light's cosine.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facerf_cli.dataset.pairs import Pair
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.methods import Method, angle_class, angle_of, turn_class
from facerf_cli.evaluation.people import Person, Shot
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.light.sphere import direction_to_azel
from facerf_cli.metrics import tone_drift_deg
from facerf_cli.pipeline import turn_to

LAMBERT = "lambert"
_NEAR_AXIS_DEG = 25.0  # lights that show the skin's colour rather than its shape


@dataclass(frozen=True)
class _Question:
    """A pair's target: its light [3], the turn [3, 3] to its pose, and its crop."""

    light: Tensor
    turn: Tensor
    shot: Shot


@torch.no_grad()
def compare_olats(
    person: Person, pairs: Iterable[Pair], methods: Sequence[Method], held_to_photo: bool
) -> Iterator[Comparison]:
    """The person's pairs: each method's picture under one light beside the stack's own, unclipped."""
    for pair in pairs:
        source = person.shot(pair.source_camera)
        shot = person.posed_as(source.view.fit, pair.target_camera)
        light = torch.from_numpy(shot.header.directions[pair.target_light]).float()
        asked = _Question(light, turn_to(source.view.fit, shot.view.fit.rotation), shot)
        yield _compare(person, pair, asked, methods, held_to_photo)


def _compare(
    person: Person, pair: Pair, asked: _Question, methods: Sequence[Method], held_to_photo: bool
) -> Comparison:
    image, face = person.source(pair)
    fit, white = person.shot(pair.source_camera).view.fit, torch.ones(1, 1, 3)
    cosine = torch.einsum("c,cd,dij->ij", asked.light, asked.turn, face.normals).clamp_min(0)
    textures = {
        method.name: method.reflectance(fit, face, held_to_photo).relit(asked.light[None], white, asked.turn)[
            0
        ]
        for method in methods
    }
    textures[LAMBERT] = face.texture * cosine
    stack = person.dataset.stack_path(pair.subject, pair.target_camera)
    truth = read_olats(stack, slice(pair.target_light, pair.target_light + 1))[0].float()
    view = asked.shot.view
    predictions = {name: view.image(texture) for name, texture in textures.items()}
    comparison = Comparison(
        Case(f"{pair.subject}/{pair.index:05d}", pair.subject, _facts(person, pair, asked)),
        truth.permute(1, 2, 0).numpy(),
        view.mask,
        predictions,
        source=image,
    )
    return _with_drift(comparison, person.albedo, view.region("skin"))


def _facts(person: Person, pair: Pair, asked: _Question) -> dict[str, str | float]:
    light, same = asked.light, pair.source_camera == pair.target_camera
    turn_deg = angle_of(asked.turn)
    angle_deg = float(torch.rad2deg(light[2].clamp(-1, 1).acos()))
    azimuth_deg, elevation_deg = direction_to_azel(light)
    return {
        "pose": "same pose" if same else "different pose",
        "angle": angle_class(angle_deg),
        "turn": turn_class(turn_deg),
        **person.facts,
        "turn_deg": turn_deg,
        "angle_deg": angle_deg,
        "azimuth_deg": float(azimuth_deg),
        "elevation_deg": float(elevation_deg),
    }


def _with_drift(comparison: Comparison, albedo: np.ndarray | None, skin: np.ndarray) -> Comparison:
    """With the drift of the skin's tone (ITA on true albedo), where the light is near the camera's axis."""
    near = float(comparison.case.facts["angle_deg"]) <= _NEAR_AXIS_DEG
    if albedo is None or not near:
        return comparison
    extra = {}
    for name, image in comparison.predictions.items():
        drift = tone_drift_deg(image, comparison.truth, skin * comparison.mask, albedo)
        if drift is not None:
            extra[name] = {"tone_drift_deg": abs(drift), "tone_shift_deg": drift}
    return Comparison(**{**comparison.__dict__, "extra": extra})
