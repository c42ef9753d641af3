"""OLATs of held-out people from images in natural light, in the same pose and in others (paper, Table 1).

Each pair of a prepared dataset is a user's photo: its source is unwrapped by its fit and relit by one light
of the target camera's stack. In the same pose the image is that of `facerf relight`, the photo with its face
relit; in another pose it is the face alone, as with `--pose`. The naive method 'lambert' is the source's own
texture under the cosine of the light.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from facerf_cli.composite import Composition, Relit, Target
from facerf_cli.dataset.pairs import Pair
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.crop_view import angle_class, angle_of, turn_class
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.people import CameraCrop, Person
from facerf_cli.face.head import Head
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.light.sphere import RigLight, direction_to_azel
from facerf_cli.metrics import tone_drift_deg

LAMBERT = "lambert"
_NEAR_AXIS_DEG = 25.0  # lights that show the skin's colour rather than its shape
_WHITE = torch.ones(1, 1, 3)


@dataclass(frozen=True, eq=False)
class _Question:
    """A pair's target: its light [3], the turn [3, 3] of the head to its pose, and its crop."""

    light: Tensor
    turn: Tensor
    crop: CameraCrop
    same_pose: bool


@torch.no_grad()
def compare_olats(
    person: Person, pairs: Iterable[Pair], methods: Sequence[Method], network_alone: bool
) -> Iterator[Comparison]:
    """The person's pairs: each method's image under one light next to the stack's own, unclipped."""
    for pair in pairs:
        fit = person.crop(pair.source_camera).view.fit
        crop = person.posed_as(fit, pair.target_camera)
        light = torch.from_numpy(crop.header.directions[pair.target_light]).float()
        same_pose = pair.source_camera == pair.target_camera
        asked = _Question(light, fit.turn_to(crop.view.fit.rotation), crop, same_pose)
        yield _compare(person, pair, asked, methods, network_alone)


def _compare(
    person: Person, pair: Pair, asked: _Question, methods: Sequence[Method], network_alone: bool
) -> Comparison:
    image = person.source(pair)
    head, view = person.head(pair, image), asked.crop.view
    photo = image if asked.same_pose else None
    target = Target() if asked.same_pose else Target(view.fit, "face")
    directions = asked.light[None]
    predictions = {
        method.name: next(method.images(photo, head, directions, _WHITE, target, network_alone))
        for method in methods
    }
    predictions[LAMBERT] = _lambert(person, head, asked)
    stack = person.dataset.stack_path(pair.subject, pair.target_camera)
    truth = read_olats(stack, slice(pair.target_light, pair.target_light + 1))[0].float()
    comparison = Comparison(
        Case(f"{pair.subject}/{pair.index:05d}", pair.subject, _facts(person, pair, asked)),
        truth.permute(1, 2, 0).numpy(),
        view.mask,
        predictions,
        source=image,
    )
    return _with_drift(comparison, person.albedo, view.region("skin"))


def _lambert(person: Person, head: Head, asked: _Question) -> np.ndarray:
    """The source's texture under the light's cosine, rendered in the target's crop."""
    cosine = torch.einsum("c,cd,dij->ij", asked.light, asked.turn, head.face.normals).clamp_min(0)
    composition = Composition(person.model, None, head, Target(asked.crop.view.fit, "face"))
    relit = Relit(head.face.texture * cosine)
    return composition.image(RigLight(asked.light[None], _WHITE[0]), relit).pixels


def _facts(person: Person, pair: Pair, asked: _Question) -> dict[str, str | float]:
    light = asked.light
    turn_deg = angle_of(asked.turn)
    angle_deg = float(torch.rad2deg(light[2].clamp(-1, 1).acos()))
    azimuth_deg, elevation_deg = direction_to_azel(light)
    return {
        "pose": "same pose" if asked.same_pose else "different pose",
        "angle": angle_class(angle_deg),
        "turn": turn_class(turn_deg),
        **person.facts,
        "turn_deg": turn_deg,
        "angle_deg": angle_deg,
        "azimuth_deg": float(azimuth_deg),
        "elevation_deg": float(elevation_deg),
    }


def _with_drift(comparison: Comparison, albedo: np.ndarray | None, skin: np.ndarray) -> Comparison:
    """Add the drift of the skin tone (ITA on true albedo) if the light is near the camera's axis."""
    near = float(comparison.case.facts["angle_deg"]) <= _NEAR_AXIS_DEG
    if albedo is None or not near:
        return comparison
    extra = {}
    for name, image in comparison.predictions.items():
        drift = tone_drift_deg(image, comparison.truth, skin * comparison.mask, albedo)
        if drift is not None:
            extra[name] = {"tone_drift_deg": abs(drift), "tone_shift_deg": drift}
    return replace(comparison, extra=extra)
