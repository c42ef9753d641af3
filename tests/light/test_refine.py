"""The light's refinement by features: its own loss falls, never rises, and stays physical where asked."""

from collections.abc import Sequence

import torch

from facerf_cli.light.estimate import LightEvidence, RefineSettings, refine_light
from tests.light.test_estimate import LIGHTS, lit, shaded_ball, some_weights


def edges(textures: torch.Tensor) -> Sequence[torch.Tensor]:
    """Features of a kind: differences of neighbours, and the values a little."""
    return [textures.diff(dim=-1), textures.diff(dim=-2), 0.1 * textures]


def test_the_loss_falls_and_the_light_comes_nearer() -> None:
    weights = some_weights()
    evidence = lit(shaded_ball(), weights)
    start = (weights + 0.05).roll(1, 1)
    refined = refine_light(evidence, start, edges)
    assert refined.loss_after < 0.2 * refined.loss_before
    assert evidence.residual(evidence.relit(refined.weights)) < evidence.residual(evidence.relit(start))
    assert (refined.weights >= 0).all() and refined.steps > 5


def test_gradients_are_taken_where_the_caller_needs_none() -> None:
    evidence = lit(shaded_ball(), some_weights())
    with torch.no_grad():  # as in `facerf evaluate`
        refined = refine_light(evidence, some_weights() + 0.1, edges)
    assert refined.loss_after < refined.loss_before


def test_a_start_that_is_best_is_given_back() -> None:
    weights = some_weights()
    evidence = lit(shaded_ball(), weights)
    refined = refine_light(evidence, weights, edges)
    assert torch.equal(refined.weights, weights) and refined.loss_after == refined.loss_before


def test_steps_that_only_harm_give_the_start_back() -> None:
    start = some_weights() + 0.01
    evidence = lit(shaded_ball(), some_weights())
    refined = refine_light(evidence, start, edges, settings=RefineSettings(steps=15, learning_rate=1e4))
    assert torch.equal(refined.weights, start) and refined.loss_after == refined.loss_before > 0


def test_it_ends_when_nothing_is_gained() -> None:
    evidence = lit(shaded_ball(), some_weights())
    settings = RefineSettings(steps=500, patience=5, settled=0.9)
    assert refine_light(evidence, some_weights() + 0.1, edges, settings=settings).steps <= 10


def test_signed_weights_may_stay_negative_and_the_others_may_not() -> None:
    truth = some_weights() - 0.02
    evidence = lit(shaded_ball(), truth)
    signed = refine_light(evidence, some_weights(), edges, non_negative=False)
    assert (signed.weights < 0).any()
    assert (refine_light(evidence, some_weights(), edges).weights >= 0).all()


def test_clipped_texels_and_those_beyond_the_mask_ask_for_nothing() -> None:
    truth = some_weights() * 4
    bright = lit(shaded_ball(), truth)
    mask = bright.mask.clone()
    mask[:6] = False
    photo = bright.photo.clamp(max=1)
    photo[:, :6] = 0.7  # hair
    evidence = LightEvidence(bright.directions, bright.olats, photo, mask)
    refined = refine_light(evidence, truth, edges)
    assert refined.loss_before < 1e-9 and torch.equal(refined.weights, truth)


def test_no_light_at_all_is_a_start_too() -> None:
    evidence = lit(shaded_ball(), some_weights())
    refined = refine_light(evidence, torch.zeros(LIGHTS, 3), edges)
    assert refined.loss_after < refined.loss_before and refined.weights.isfinite().all()
