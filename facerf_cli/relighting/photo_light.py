"""Estimate the light of a photo: over a rig (paper, 'Light Estimation'), and for a field's ratio image.

A flash on the camera lights a face much like a few lights around it, and a free fit to a coarse rig prefers
these, because the field is not exact. The field would then be corrected for shadows that the photo does not
have. So the light that defines a field's ratio image is one key light from any direction plus ambient light
that is as uniform as the photo allows (`source_light`).
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
from facerf_cli.light.light import UNIFORM_LIGHTS
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.network.features import FeatureNetwork
from facerf_cli.network.inputs import exposure_of, resize
from facerf_cli.portrait.correction import Quotient
from facerf_cli.relighting import BalanceMode
from facerf_cli.relighting.field import (
    SEEN_WELL,
    Field,
    Predicted,
    balance_of,
    photo_evidence,
    shrunk,
    weighted_sum,
)
from facerf_cli.relighting.models import TEXTURE_SIDE, Models
from facerf_cli.relighting.white import without_baked_in

_RINGS_DEG = (14.0, 6.0)  # rings of the search for the key light, each around the best direction so far
_RING = 6  # directions per ring
_ONE_KEY = 0.8  # fraction of the key light in a photo's light above which it may be the only light
_AS_WELL = 1.1  # error over that of the rig's lights up to which one key light explains the photo as well
_TINY = 1e-12  # avoids divisions by 0


@dataclass(frozen=True, eq=False)
class SourceLight:
    """Estimated light of a photo, key light first, and the field's ratio image under it.

    `uniform` [3, t, t] is the small face under uniform white light. `known` holds the face as the
    network predicts it under each of its lights; None if its texture is larger than usual.
    """

    light: RigLight
    quotient: Quotient
    uniform: Tensor
    known: Predicted | None


@torch.no_grad()
def source_light(models: Models, face: FaceTexture, held: RigLight | None = None) -> SourceLight:
    """Estimate the light of a photo, and the ratio image that corrects the field to it, on small textures.

    If a light is `held` over the frames of a shot (`light_of_frames`), it is not estimated.
    """
    is_usual = face.texture.shape[-1] <= TEXTURE_SIDE
    field = Field(models, face if is_usual else shrunk(face, TEXTURE_SIDE), remove_shade_colour=True)
    known = field.predict(rig_directions(UNIFORM_LIGHTS))
    frame = _Frame.of(replace(field, known=known))
    if held is None:
        light, (key,) = _estimated([frame])
    else:
        light, key = held, frame.under(held.directions[:1])
    small, ambient = frame.small, frame.ambient.mean(0)
    explained = weighted_sum([key, frame.ambient], light.weights[None])[0]
    skin = small.visible * region_mask("skin", small.texture.shape[-1])
    shading = key[0].mean(0) / ambient.mean(0).clamp_min(_TINY)
    plain = without_baked_in(ambient, small.texture, skin, shading, key_light_fraction(light))
    quotient = Quotient.of(small.texture, explained, small.visible, plain)
    return SourceLight(
        light, quotient, quotient.corrected(frame.ambient).mean(0), known if is_usual else None
    )


@torch.no_grad()
def light_of_frames(models: Models, faces: Sequence[FaceTexture]) -> RigLight:
    """Estimate one light from several frames of a shot together, on small textures."""
    return _estimated([_Frame.of(Field(models, face, remove_shade_colour=True)) for face in faces])[0]


def over_rig(light: RigLight, rig: Tensor) -> Tensor:
    """Return weights [L, 3] of a rig that reproduce a light of `light_of_frames`.

    The key light is split among the three lights around it. The sum of the ambient light is preserved.
    """
    weights = torch.zeros(len(rig), 3)
    index, part = lights_around(light.directions[:1], rig)
    weights.index_add_(0, index[0], part[0][:, None].float() * light.weights[:1])
    index, part = lights_around(rig, light.directions[1:])
    ambient = (part[..., None].float() * light.weights[1:][index]).sum(1)
    return weights + ambient * (light.weights[1:].sum(0) / ambient.sum(0).clamp_min(_TINY))


def key_light_fraction(light: RigLight) -> float:
    """Return the fraction of a light of `light_of_frames` that is its key light, 0 to 1."""
    return float(light.weights[0].sum() / light.weights.sum().clamp_min(_TINY))


@dataclass(frozen=True, eq=False)
class _Frame:
    """The network's field of a face, and the small face, with its OLATs [L, 3, t, t] under ambient lights."""

    field: Field
    small: FaceTexture
    ambient: Tensor

    @staticmethod
    def of(field: Field) -> "_Frame":
        small, rig = shrunk(field.face), rig_directions(UNIFORM_LIGHTS)
        return _Frame(field, small, _small_olats(field, rig, small.visible.shape))

    def under(self, directions: Tensor) -> Tensor:
        """Return OLATs [l, 3, t, t] under lights [l, 3]."""
        return _small_olats(self.field, directions, self.small.visible.shape)

    def well_observed_texels(self, images: Tensor) -> Tensor:
        """Return the texels [..., N] of images [..., t, t] that are clearly visible in the photo."""
        return images[..., self.small.visible > SEEN_WELL]


def _small_olats(field: Field, directions: Tensor, size: tuple[int, ...]) -> Tensor:
    return torch.cat([F.interpolate(olats, size, mode="area") for olats in field.olats(directions)])


def _estimated(frames: Sequence[_Frame]) -> tuple[RigLight, list[Tensor]]:
    """Return the light, and each frame [1, 3, t, t] under its key light of rgb 1."""
    direction = _key_direction(frames)
    keys = [one.under(direction) for one in frames]
    each = zip(frames, keys, strict=True)
    olats = torch.cat([one.well_observed_texels(torch.cat([key, one.ambient])) for one, key in each], -1)
    weights = estimate_key_light(olats, _photo(frames))
    return RigLight(torch.cat([direction, rig_directions(UNIFORM_LIGHTS)]), weights), keys


def _key_direction(frames: Sequence[_Frame]) -> Tensor:
    """Return the direction [1, 3] of the key light that explains the frames best, with ambient light."""
    photo = _photo(frames).mean(0)
    ambient = torch.cat([one.well_observed_texels(one.ambient.mean((0, 1))) for one in frames], -1)

    def errors(olats: Sequence[Tensor]) -> list[float]:
        """Return the error of each key light from its OLATs [l, 3, t, t] in each frame."""
        pairs = zip(olats, frames, strict=True)
        texels = torch.cat([one.well_observed_texels(of_one.mean(1)) for of_one, one in pairs], -1)
        return [key_light_error(key, ambient, photo) for key in texels]

    if not len(photo):  # too little is visible
        return rig_directions(UNIFORM_LIGHTS)[:1]
    directions, each = rig_directions(UNIFORM_LIGHTS), errors([one.ambient for one in frames])
    for ring_deg in _RINGS_DEG:
        best = directions[each.index(min(each))]
        ring = _ring(best, ring_deg)
        each = [min(each), *errors([one.under(ring) for one in frames])]
        directions = torch.cat([best[None], ring])
    return directions[each.index(min(each))][None]


def _photo(frames: Sequence[_Frame]) -> Tensor:
    return torch.cat([one.well_observed_texels(one.small.texture) for one in frames], -1)


def _ring(axis: Tensor, degrees: float) -> Tensor:
    """Return directions [_RING, 3] at an angle from a direction [3]."""
    across = F.normalize(torch.linalg.cross(axis, torch.eye(3)[axis.abs().argmin()]), dim=0)
    other = torch.linalg.cross(axis, across)
    turns = torch.arange(_RING)[:, None] * (2 * math.pi / _RING)
    sideways = turns.cos() * across + turns.sin() * other
    return F.normalize(axis + math.tan(math.radians(degrees)) * sideways, dim=-1)


@dataclass(frozen=True, eq=False)
class Estimator:
    """Settings for estimating a photo's light over a rig."""

    non_negative: bool = True  # the paper's least squares allow negative weights
    features: FeatureNetwork | None = None  # V_f or S_f refine the weights (paper, 'Light Estimation')


DEFAULT_ESTIMATOR = Estimator()


@dataclass(frozen=True, eq=False)
class LightEstimate:
    """Estimated light of a photo, and the evidence that it was estimated from."""

    light: RigLight
    evidence: LightEvidence
    explained: Tensor  # texture [3, t, t] of the face under the light
    refined: RefinedLight | None = None  # the refinement by features, if any
    least_squares: Tensor | None = None  # weights [L, 3] before that refinement
    key_share: float | None = None  # fraction of the key light, if it was estimated


def estimate_light(
    models: Models,
    head: Head,
    kind: Kind = "field",
    rig: Tensor | None = None,
    estimator: Estimator = DEFAULT_ESTIMATOR,
    keep_eyes: bool = False,
    more: Sequence[Head] = (),
    white_balance: BalanceMode | None = None,
) -> LightEstimate:
    """Estimate the light of a head's photo over a rig (paper, 'Light Estimation', Eq. leastsq).

    If one key light plus ambient light (`light_of_frames`) explains the photo as well, that is the result.

    Args:
        models: Networks and face model.
        head: Head in its photo.
        kind: The field, or a comparison model, which estimates its own light.
        rig: Unit directions [L, 3] in camera space; 150 by default.
        estimator: How the least squares are solved and refined.
        keep_eyes: Whether to use the eyes, which the paper leaves out.
        more: Heads in other frames of a shot, used together.
        white_balance: White balance of the skin that the light falls on (`white.py`).

    Raises:
        InputError: Too little of the face is visible.
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
        replace(photo, directions=rig, olats=torch.cat(list(Field(models, shrunk(one.face)).olats(rig))))
        for one, photo in heads
    ]
    evidence, features = frames[0], estimator.features
    whole = joined(frames)
    weights, key_share = whole.least_squares(estimator.non_negative), None
    if estimator.non_negative:
        own = light_of_frames(models, [one.face for one, _ in heads])
        key_share, one_key = key_light_fraction(own), over_rig(own, rig)
        errors = [whole.residual(whole.relit(either)) for either in (weights, one_key)]
        if key_share > _ONE_KEY and errors[1] < _AS_WELL * errors[0]:
            weights = one_key

    def balanced(weights: Tensor) -> RigLight:
        """Return the light of weights [L, 3] that falls on white-balanced skin."""
        if white_balance is None:
            return RigLight(rig, weights)
        quotient = Quotient.of(evidence.photo, evidence.relit(weights), shrunk(head.face).visible)
        uniform = quotient.corrected(evidence.olats).mean(0)
        return RigLight(rig, weights / balance_of(white_balance, [(head.face, uniform)]).gain)

    if features is None:
        return LightEstimate(balanced(weights), evidence, evidence.relit(weights), key_share=key_share)

    def layers(x: Tensor) -> list[Tensor]:
        return features.layers((x / exposure).to(models.device))

    exposure = exposure_of(evidence.photo[None], evidence.mask[None, None].float())  # as in their training
    refined = refine_light(evidence, weights, layers, estimator.non_negative)
    relit = evidence.relit(refined.weights)
    return LightEstimate(balanced(refined.weights), evidence, relit, refined, weights, key_share)
