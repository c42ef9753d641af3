"""Single lights predicted for held-out people, in the same pose and in others (paper, Tables 1 and 3).

The source of each pair of a prepared dataset is a user's photo: the face is found in it, fitted or regressed,
and relit by one light of the target camera's stack. In the same pose the image is that of `facerf relight`,
the photo with its face relit; in another pose it is the face alone, as with `--pose`. The naive method
'lambert' is the source's own texture under the cosine of the light.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from facerf_cli.evaluation.measure import Comparison
from facerf_cli.evaluation.people import (
    CropView,
    Method,
    Portrait,
    SourceFace,
    angle_class,
    angle_of,
    common_mask,
    turn_class,
)
from facerf_cli.evaluation.summary import PublishedFigure
from facerf_cli.face.head import Head
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.image.metrics import tone_drift_deg
from facerf_cli.light.sphere import direction_to_azel
from facerf_cli.relighting.composition import Composition, Relit, Target
from facerf_cli.relighting.models import Models

LAMBERT = "lambert"
_NEAR_AXIS_DEG = 25.0  # lights that show the skin's colour rather than its shape
_WHITE = torch.ones(1, 1, 3)
_LIGHT_STAGE = "people in a light stage; other data than ours"
_SAME, _DIFFERENT = ("pose", "same pose"), ("pose", "different pose")

TABLE_1 = (
    PublishedFigure("the paper's", "si_mse", 0.00070, 0.00059, _SAME, "Table 1", _LIGHT_STAGE),
    PublishedFigure("the paper's", "si_mse", 0.00084, 0.00088, _DIFFERENT, "Table 1", _LIGHT_STAGE),
)
TABLE_3 = (
    PublishedFigure("without normals", "si_mse", 0.00113, 0.00093, _SAME, "Table 3", _LIGHT_STAGE),
    PublishedFigure("without normals", "si_mse", 0.00126, 0.00116, _DIFFERENT, "Table 3", _LIGHT_STAGE),
)


@torch.no_grad()
def compare_olats(
    faces: Sequence[SourceFace], methods: Sequence[Method], network_alone: bool
) -> Iterator[Comparison]:
    """A source: each method's image under the target's light next to the stack's own, unclipped."""
    (face,) = faces
    assert face.origin is not None
    person, pair = face.origin
    light = torch.from_numpy(person.header(pair.target_camera).directions[pair.target_light]).float()
    target = None if pair.source_camera == pair.target_camera else person.lit(pair.target_camera)
    stack = person.dataset.stack_path(pair.subject, pair.target_camera)
    truth = read_olats(stack, slice(pair.target_light, pair.target_light + 1))[0].float()
    predictions, views = {}, []
    for method in methods:
        head, view = face.portrait.by(method.models).head, _view(face.portrait, target, method.models)
        if target is None:  # the image of `facerf relight`, cropped as the truth is
            of_photo = method.images(
                face.portrait.photo.pixels, head, light[None], _WHITE, Target(), network_alone
            )
            image = view.fit.crop.apply(next(of_photo))
        else:
            alone = Target(view.fit, "face")
            image = next(method.images(None, head, light[None], _WHITE, alone, network_alone))
        predictions[method.name] = image
        views.append(view)
    first, models = views[0], methods[0].models
    head = face.portrait.by(models).head
    predictions[LAMBERT] = _lambert(models, head, light, first)
    pose = "same pose" if target is None else "different pose"
    comparison = Comparison(
        replace(face.case, facts={"pose": pose, **_angles(light, head, first), **face.case.facts}),
        first.fit.crop.apply(truth.permute(1, 2, 0).numpy()),
        common_mask(views),
        predictions,
        source=head.cropped,
    )
    yield _with_drift(comparison, person.albedo, first.region("skin"))


def _view(source: Portrait, target: Portrait | None, models: Models) -> CropView:
    """The source's head, by a method's models, in the target's pose."""
    view = source.by(models).view
    return view if target is None else target.posed_as(view.fit, models)


def _lambert(models: Models, head: Head, light: Tensor, view: CropView) -> np.ndarray:
    """The source's texture under the cosine of a light [3], rendered in the target's crop."""
    turn = head.fit.turn_to(view.fit.rotation)
    cosine = torch.einsum("c,cd,dij->ij", light, turn, head.face.normals).clamp_min(0)
    composition = Composition(models.face, None, head, Target(view.fit, "face"))
    return composition.image(Relit(head.face.texture * cosine)).pixels


def _angles(light: Tensor, head: Head, view: CropView) -> dict[str, str | float]:
    """Facts on the direction of the light and the turn of the head from the source's pose."""
    turn_deg = angle_of(head.fit.turn_to(view.fit.rotation))
    angle_deg = float(torch.rad2deg(light[2].clamp(-1, 1).acos()))
    azimuth_deg, elevation_deg = direction_to_azel(light)
    return {
        "angle": angle_class(angle_deg),
        "turn": turn_class(turn_deg),
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
