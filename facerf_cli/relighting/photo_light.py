"""The light of a photo over a rig (paper, 'Light Estimation')."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from facerf_cli.baselines import Kind
from facerf_cli.baselines.base import Explained
from facerf_cli.face.head import Head
from facerf_cli.light.estimate import LightEvidence, RefinedLight, joined, refine_light
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.network.features import FeatureNetwork
from facerf_cli.network.inputs import exposure_of, resize
from facerf_cli.portrait.correction import Quotient
from facerf_cli.relighting import White
from facerf_cli.relighting.field import Field, balance_of, photo_evidence, shrunk
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.reflectance import explain_by_baseline, reflectance_of
from facerf_cli.relighting.source_light import light_of_frames, over_rig, share_of_lamp


@dataclass(frozen=True, eq=False)
class Estimator:
    """Settings of estimating the light of a photo over a rig.

    Without `non_negative` by the paper's least squares, whose weights may be negative. `features` (V_f or
    S_f) refines the weights (paper, 'Light Estimation').
    """

    non_negative: bool = True
    features: FeatureNetwork | None = None


DEFAULT_ESTIMATOR = Estimator()
_ONE_LAMP = 0.8  # share of the lamp in a photo's light from which it may be the light
_AS_WELL = 1.1  # times the error of the rig's lights: one lamp then explains the photo as well


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

    Where one lamp and light from around explain the photo as well, they are its light (`source_light.py`).
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


def explain(
    models: Models,
    head: Head,
    kind: Kind = "field",
    network_alone: bool = True,
    estimator: Estimator = DEFAULT_ESTIMATOR,
) -> Explained:
    """Read both reflectance and light of a head's photo, as far as the model can separate them."""
    if kind != "field":
        return explain_by_baseline(models, head, kind)
    light = estimate_light(models, head, estimator=estimator).light
    return Explained(reflectance_of(models, head, kind, network_alone), light)
