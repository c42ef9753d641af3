"""OLATs of held-out people from images in natural light, in the same pose and in others (paper, Table 1).

The source of each pair of a prepared dataset is a user's photo: the face is found in it, fitted or regressed,
and relit by one light of the target camera's stack. In the same pose the image is that of `facerf relight`,
the photo with its face relit; in another pose it is the face alone, as with `--pose`. The naive method
'lambert' is the source's own texture under the cosine of the light.
"""

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from facerf_cli.composite import Composition, Relit, Target
from facerf_cli.dataset.pairs import Pair
from facerf_cli.errors import InputError
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.crop_view import CropView, angle_class, angle_of, turn_class
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.people import Person, Portrait, common_mask
from facerf_cli.face.head import Head
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.light.sphere import direction_to_azel
from facerf_cli.logs import LOGGER_NAME
from facerf_cli.metrics import tone_drift_deg
from facerf_cli.models import Models

LAMBERT = "lambert"
_NEAR_AXIS_DEG = 25.0  # lights that show the skin's colour rather than its shape
log = logging.getLogger(LOGGER_NAME)
_WHITE = torch.ones(1, 1, 3)


@dataclass(frozen=True, eq=False)
class _Question:
    """A pair's source and its target: a light [3] in the target's camera, and its pose, if it is another."""

    pair: Pair
    source: Portrait
    light: Tensor
    target: Portrait | None

    def view(self, models: Models) -> CropView:
        """The source's head, by a method's models, in the pose that is asked for."""
        sitting = self.source.by(models)
        return sitting.view if self.target is None else self.target.posed_as(sitting.view.fit, models)


@torch.no_grad()
def compare_olats(
    person: Person, pairs: Iterable[Pair], methods: Sequence[Method], network_alone: bool
) -> Iterator[Comparison]:
    """The person's pairs: each method's image under one light next to the stack's own, unclipped."""
    for pair, source in person.portraits(pairs):
        light = torch.from_numpy(person.header(pair.target_camera).directions[pair.target_light]).float()
        same_pose = pair.source_camera == pair.target_camera
        try:
            target = None if same_pose else person.lit(pair.target_camera)
            yield _compare(person, _Question(pair, source, light, target), methods, network_alone)
        except InputError as error:
            log.warning("%s/%05d: %s; left out", pair.subject, pair.index, error)


def _compare(person: Person, asked: _Question, methods: Sequence[Method], network_alone: bool) -> Comparison:
    pair, photo = asked.pair, asked.source.photo.pixels
    stack = person.dataset.stack_path(pair.subject, pair.target_camera)
    truth = read_olats(stack, slice(pair.target_light, pair.target_light + 1))[0].float()
    predictions, views = {}, []
    for method in methods:
        head, view = asked.source.by(method.models).head, asked.view(method.models)
        directions = asked.light[None]
        if asked.target is None:  # the image of `facerf relight`, cropped as the truth is
            of_photo = method.images(photo, head, directions, _WHITE, Target(), network_alone)
            image = view.fit.crop.apply(next(of_photo))
        else:
            target = Target(view.fit, "face")
            image = next(method.images(None, head, directions, _WHITE, target, network_alone))
        predictions[method.name] = image
        views.append(view)
    first, models = views[0], methods[0].models
    head = asked.source.by(models).head
    predictions[LAMBERT] = _lambert(models, head, asked.light, first)
    comparison = Comparison(
        Case(f"{pair.subject}/{pair.index:05d}", pair.subject, _facts(person, asked, head, first)),
        first.fit.crop.apply(truth.permute(1, 2, 0).numpy()),
        common_mask(views),
        predictions,
        source=head.cropped,
    )
    return _with_drift(comparison, person.albedo, first.region("skin"))


def _lambert(models: Models, head: Head, light: Tensor, view: CropView) -> np.ndarray:
    """The source's texture under the cosine of a light [3], rendered in the target's crop."""
    turn = head.fit.turn_to(view.fit.rotation)
    cosine = torch.einsum("c,cd,dij->ij", light, turn, head.face.normals).clamp_min(0)
    composition = Composition(models.face, None, head, Target(view.fit, "face"))
    relit = Relit(head.face.texture * cosine)
    return composition.image(relit).pixels


def _facts(person: Person, asked: _Question, head: Head, view: CropView) -> dict[str, str | float]:
    light = asked.light
    turn_deg = angle_of(head.fit.turn_to(view.fit.rotation))
    angle_deg = float(torch.rad2deg(light[2].clamp(-1, 1).acos()))
    azimuth_deg, elevation_deg = direction_to_azel(light)
    return {
        "pose": "same pose" if asked.target is None else "different pose",
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
