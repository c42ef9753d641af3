"""The light of a photo: over a rig (paper, 'Light Estimation'), and as its own field explains it.

A flash on the camera lights a face much as a few lamps around it do, and a free fit to a coarse rig takes
these, since the field is not exact: then the field is corrected for shadows that the photo does not have. So
the light by whose quotient a field is corrected to its photo is one lamp, which may be anywhere, and light
from around, which is as even as the photo allows (`source_light`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.baselines import Kind, explain_by_baseline
from facerf_cli.face.head import FaceTexture, Head
from facerf_cli.face.topology import region_mask
from facerf_cli.light.envmap import lights_around
from facerf_cli.light.estimate import (
    LightEvidence,
    RefinedLight,
    estimate_key_light,
    joined,
    key_light_error,
    refine_light,
)
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.network.features import FeatureNetwork
from facerf_cli.network.inputs import exposure_of, resize
from facerf_cli.portrait.correction import Quotient
from facerf_cli.relighting import White
from facerf_cli.relighting.field import SEEN_WELL, Field, balance_of, photo_evidence, shrunk, weighted_sum
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.white import without_baked_in

_AROUND = 32  # lights of the rig from around
_RINGS_DEG = (14.0, 6.0)  # of the search for the lamp, each around the best place so far
_RING = 6  # places on a ring
_ONE_LAMP = 0.8  # share of the lamp in a photo's light from which it may be the light
_AS_WELL = 1.1  # times the error of the rig's lights: one lamp then explains the photo as well
_TINY = 1e-12  # avoids divisions by 0


@dataclass(frozen=True, eq=False)
class SourceLight:
    """The estimated light of a photo, the lamp first, and the field's quotient under it.

    `even` [3, t, t] is the small face under even white light.
    """

    light: RigLight
    quotient: Quotient
    even: Tensor


@torch.no_grad()
def source_light(models: Models, face: FaceTexture, held: RigLight | None = None) -> SourceLight:
    """Estimate the light of a photo, on small textures, and the quotient that corrects the field to it.

    A light that is `held` over the frames of a shot, by `light_of_frames`, is not estimated again.
    """
    frame = _Frame.of(models, face)
    light = _estimated([frame]) if held is None else held
    small = frame.field.face
    lamp, even = frame.under(light.directions[:1]), frame.around.mean(0)
    explained = weighted_sum([lamp, frame.around], light.weights[None])[0]
    skin = small.visible * region_mask("skin", small.texture.shape[-1])
    key = lamp[0].mean(0) / even.mean(0).clamp_min(_TINY)
    plain = without_baked_in(even, small.texture, skin, key, share_of_lamp(light))
    quotient = Quotient.of(small.texture, explained, small.visible, plain)
    return SourceLight(light, quotient, quotient.corrected(frame.around).mean(0))


@torch.no_grad()
def light_of_frames(models: Models, faces: Sequence[FaceTexture]) -> RigLight:
    """Estimate one light, on small textures, from several frames of a shot together."""
    return _estimated([_Frame.of(models, face) for face in faces])


def over_rig(light: RigLight, rig: Tensor) -> Tensor:
    """Weights [L, 3] of a rig's lights that shine as a light of `light_of_frames` does.

    The lamp is shared by the three lights around it, and the light from around keeps its sum.
    """
    weights = torch.zeros(len(rig), 3)
    index, share = lights_around(light.directions[:1], rig)
    weights.index_add_(0, index[0], share[0][:, None].float() * light.weights[:1])
    index, share = lights_around(rig, light.directions[1:])
    even = (share[..., None].float() * light.weights[1:][index]).sum(1)
    return weights + even * (light.weights[1:].sum(0) / even.sum(0).clamp_min(_TINY))


def share_of_lamp(light: RigLight) -> float:
    """The lamp's share of all the light that `light_of_frames` found, 0 to 1."""
    return float(light.weights[0].sum() / light.weights.sum().clamp_min(_TINY))


@dataclass(frozen=True, eq=False)
class _Frame:
    """The network's field of a small texture, and its OLATs [L, 3, t, t] under the rig from around."""

    field: Field
    around: Tensor

    @staticmethod
    def of(models: Models, face: FaceTexture) -> "_Frame":
        field = Field(models, shrunk(face), even_shade=True)
        return _Frame(field, torch.cat(list(field.olats(rig_directions(_AROUND)))))

    def under(self, directions: Tensor) -> Tensor:
        """OLATs [l, 3, t, t] under lights [l, 3]."""
        return torch.cat(list(self.field.olats(directions)))

    def seen(self, images: Tensor) -> Tensor:
        """Texels [..., N] of images [..., t, t] that the photo shows well."""
        return images[..., self.field.face.visible > SEEN_WELL]


def _estimated(frames: Sequence[_Frame]) -> RigLight:
    lamp = _lamp(frames)
    pairs = [(torch.cat([one.under(lamp), one.around]), one) for one in frames]
    olats = torch.cat([one.seen(olats) for olats, one in pairs], -1)
    return RigLight(torch.cat([lamp, rig_directions(_AROUND)]), estimate_key_light(olats, _photo(frames)))


def _lamp(frames: Sequence[_Frame]) -> Tensor:
    """Direction [1, 3] of the lamp that explains the frames best, together with even light from around."""
    photo = _photo(frames).mean(0)
    around = torch.cat([one.seen(one.around.mean((0, 1))) for one in frames], -1)

    def errors(olats: Sequence[Tensor]) -> list[float]:
        """Errors of lamps, given their OLATs [l, 3, t, t] of each frame."""
        lamps = torch.cat([one.seen(of_one.mean(1)) for of_one, one in zip(olats, frames, strict=True)], -1)
        return [key_light_error(lamp, around, photo) for lamp in lamps]

    if not len(photo):  # nothing is visible enough
        return rig_directions(_AROUND)[:1]
    places, found = rig_directions(_AROUND), errors([one.around for one in frames])
    for ring_deg in _RINGS_DEG:
        best = places[found.index(min(found))]
        ring = _ring(best, ring_deg)
        found = [min(found), *errors([one.under(ring) for one in frames])]
        places = torch.cat([best[None], ring])
    return places[found.index(min(found))][None]


def _photo(frames: Sequence[_Frame]) -> Tensor:
    """Texels [3, N] that the photos of frames show well."""
    return torch.cat([one.seen(one.field.face.texture) for one in frames], -1)


def _ring(axis: Tensor, degrees: float) -> Tensor:
    """Directions [_RING, 3] at an angle from a direction [3]."""
    across = F.normalize(torch.linalg.cross(axis, torch.eye(3)[axis.abs().argmin()]), dim=0)
    other = torch.linalg.cross(axis, across)
    turns = torch.arange(_RING)[:, None] * (2 * math.pi / _RING)
    sideways = turns.cos() * across + turns.sin() * other
    return F.normalize(axis + math.tan(math.radians(degrees)) * sideways, dim=-1)


@dataclass(frozen=True, eq=False)
class Estimator:
    """Settings of estimating the light of a photo over a rig.

    Without `non_negative` by the paper's least squares, whose weights may be negative. `features` (V_f or
    S_f) refines the weights (paper, 'Light Estimation').
    """

    non_negative: bool = True
    features: FeatureNetwork | None = None


DEFAULT_ESTIMATOR = Estimator()


@dataclass(frozen=True, eq=False)
class LightEstimate:
    """The light of a photo, the evidence for it, and the texture [3, t, t] of the face under it.

    If features refined the weights, `refined` holds the refinement, and `least_squares` [L, 3] are those
    before. `key_share` is the share of the key light, where that was asked.
    """

    light: RigLight
    evidence: LightEvidence
    explained: Tensor
    refined: RefinedLight | None = None
    least_squares: Tensor | None = None
    key_share: float | None = None


def estimate_light(
    models: Models,
    head: Head,
    kind: Kind = "field",
    rig: Tensor | None = None,
    estimator: Estimator = DEFAULT_ESTIMATOR,
    keep_eyes: bool = False,
    more: Sequence[Head] = (),
    white: White | None = None,
) -> LightEstimate:
    """Estimate the light of a head's photo over a rig (paper, 'Light Estimation', Eq. leastsq).

    Args:
        models: The networks and the face model.
        head: The head in its photo.
        kind: The field, or a baseline of the paper, which estimates its own light.
        rig: Unit directions [L, 3], camera space; by default 150.
        estimator: How the least squares are solved and refined.
        keep_eyes: Eyes take part, which the paper leaves out.
        more: Heads of other frames of a shot, which take part.
        white: The light is that over the photo's or over skin's own colours (`white.py`).

    Where one lamp and light from around explain the photo as well, they are its light (`light_of_frames`).
    Raises InputError where too little of the face is visible.
    """
    evidence = photo_evidence(head.face, keep_eyes)
    if kind != "field":
        explained = explain_by_baseline(models, head, kind)
        texture = explained.reflectance.relit(explained.light.directions, explained.light.weights[None])
        small = resize(texture, evidence.photo.shape[-1])[0]
        return LightEstimate(explained.light, evidence, small)
    rig = rig_directions() if rig is None else rig
    heads = [(head, evidence), *((one, photo_evidence(one.face, keep_eyes)) for one in more)]
    frames = [
        replace(seen, directions=rig, olats=torch.cat(list(Field(models, shrunk(one.face)).olats(rig))))
        for one, seen in heads
    ]
    evidence, features = frames[0], estimator.features
    whole = joined(frames)
    weights, share = whole.least_squares(estimator.non_negative), None
    if estimator.non_negative:
        own = light_of_frames(models, [one.face for one, _ in heads])
        share, one_lamp = share_of_lamp(own), over_rig(own, rig)
        left = [whole.residual(whole.relit(either)) for either in (weights, one_lamp)]
        if share > _ONE_LAMP and left[1] < _AS_WELL * left[0]:
            weights = one_lamp

    def balanced(weights: Tensor) -> RigLight:
        """The light of weights [L, 3] over a face of the white that is wanted."""
        if white is None:
            return RigLight(rig, weights)
        quotient = Quotient.of(evidence.photo, evidence.relit(weights), shrunk(head.face).visible)
        even = quotient.corrected(evidence.olats).mean(0)
        return RigLight(rig, weights / balance_of(white, [(head.face, even)]).gain)

    if features is None:
        return LightEstimate(balanced(weights), evidence, evidence.relit(weights), key_share=share)

    def layers(x: Tensor) -> list[Tensor]:
        return features.layers((x / exposure).to(models.device))

    exposure = exposure_of(evidence.photo[None], evidence.mask[None, None].float())  # as in their training
    refined = refine_light(evidence, weights, layers, estimator.non_negative)
    shown = evidence.relit(refined.weights)
    return LightEstimate(balanced(refined.weights), evidence, shown, refined, weights, share)
