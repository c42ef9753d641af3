from collections.abc import Sequence

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from facerf_cli.errors import InputError
from facerf_cli.light import estimate
from facerf_cli.light.estimate import (
    LightEvidence,
    estimate_key_light,
    estimate_signed_weights,
    estimate_smooth_weights,
    key_light_error,
    least_non_negative,
    refine_light,
)
from facerf_cli.light.sphere import rig_directions
from facerf_cli.portrait.correction import Quotient
from tests.refusals import refused

LIGHTS = 24


def _normals(side: int = 24) -> tuple[torch.Tensor, torch.Tensor]:
    """Of a ball that fills a texture [3, side, side], and where it is [side, side]."""
    along = (torch.arange(side) + 0.5) * (2 / side) - 1
    y, x = torch.meshgrid(-along, along, indexing="ij")
    z2 = 1 - x * x - y * y
    return torch.stack([x, y, z2.clamp_min(0).sqrt()]), z2 > 0.01


def shaded_ball(lights: int = LIGHTS) -> LightEvidence:
    """Lambert's images of a ball with a coloured albedo, and no photo yet."""
    normals, inside = _normals()
    albedo = 0.2 + 0.6 * torch.rand(3, *inside.shape, generator=torch.Generator().manual_seed(0))
    cosines = torch.einsum("lc,cij->lij", rig_directions(lights), normals).clamp_min(0)
    olats = cosines[:, None] * albedo
    return LightEvidence(rig_directions(lights), olats, torch.zeros_like(albedo), inside)


def lit(evidence: LightEvidence, weights: torch.Tensor) -> LightEvidence:
    """The evidence with the photo that these weights [L, 3] make."""
    return LightEvidence(evidence.directions, evidence.olats, evidence.relit(weights), evidence.mask)


def some_weights() -> torch.Tensor:
    weights = torch.zeros(LIGHTS, 3)
    facing = rig_directions(LIGHTS)[:, 2].topk(4).indices
    weights[facing] = torch.tensor([[3.0, 2.0, 1.0], [0.5, 0.5, 0.5], [0.0, 1.0, 0.0], [2.0, 0.1, 0.3]])
    return weights / 10


def flat(evidence: LightEvidence) -> tuple[torch.Tensor, torch.Tensor]:
    return evidence.olats[..., evidence.mask], evidence.photo[:, evidence.mask]


def free_weights(olats: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
    """Non-negative weights [L, 3] that nothing else holds."""
    pairs = zip(olats.unbind(1), image, strict=True)
    solved = [nnls(lights.T.double().numpy(), one.double().numpy())[0] for lights, one in pairs]
    return torch.from_numpy(np.stack(solved, -1)).float()


def test_the_plain_form_is_exact_where_lights_can_be_told_apart_even_if_they_are_negative() -> None:
    evidence = shaded_ball(12)
    facing = evidence.directions[:, 2] > 0.2
    weights = torch.randn(12, 3) * facing[:, None]
    seen = LightEvidence(
        evidence.directions[facing], evidence.olats[facing], evidence.relit(weights), evidence.mask
    )
    assert torch.allclose(estimate_signed_weights(*flat(seen)), weights[facing], atol=1e-4)
    assert torch.allclose(seen.least_squares(non_negative=False), weights[facing], atol=1e-4)
    assert (seen.least_squares() >= 0).all()


def test_noise_does_not_blow_up_the_plain_form() -> None:
    """150 images of a ball have a rank of about 9: the others would only fit the noise."""
    evidence = shaded_ball(150)
    weights = 0.2 + torch.rand(150, 3, generator=torch.Generator().manual_seed(1))
    olats, image = flat(lit(evidence, weights))
    noise = 0.01 * image.mean() * torch.randn(image.shape, generator=torch.Generator().manual_seed(2))
    found = estimate_signed_weights(olats, image + noise)
    assert found.norm() < 2 * weights.norm()
    explained = torch.einsum("lc,lcn->cn", found, olats)
    assert (explained - image).norm() < 0.02 * image.norm()


def test_where_the_face_is_not_reached_the_light_goes_on() -> None:
    """Weights behind the ball lie between those around them, and none is zero."""
    evidence = lit(shaded_ball(150), torch.full((150, 3), 0.2))
    weights = evidence.least_squares()
    radiance = evidence.olats[..., evidence.mask].mean((1, 2))
    hidden = radiance < 0.05 * radiance.max()
    assert hidden.sum() > 10
    assert weights[hidden].min() > 0.1 and weights[hidden].max() < 0.4
    turned = evidence.directions[:, 0] + 1.5  # brighter to the right: so it is behind
    behind = lit(shaded_ball(150), (0.2 * turned)[:, None].expand(-1, 3)).least_squares()[hidden].mean(1)
    right = evidence.directions[hidden, 0] > 0.2
    left = evidence.directions[hidden, 0] < -0.2
    assert right.any() and left.any() and behind[right].mean() > 1.1 * behind[left].mean()


def test_a_covered_image_gives_the_same_light() -> None:
    evidence = lit(shaded_ball(), torch.full((LIGHTS, 3), 0.2))
    olats, image = flat(evidence)
    spoilt = image.clone()
    spoilt[:, ::10] = 0.0  # hair
    none = torch.zeros_like(image, dtype=torch.bool)
    first = estimate_key_light(olats, spoilt)
    for found in (first, estimate_smooth_weights(evidence.directions, olats, spoilt, none)):
        remade = torch.einsum("lc,lcn->cn", found, olats)
        assert (remade - image).norm() < 0.05 * image.norm()


def test_of_clipped_highlights_only_darkness_is_an_error() -> None:
    weights = some_weights() * 6
    evidence = lit(shaded_ball(), weights)
    assert float((evidence.photo > 1).float().mean()) > 0.05
    clipped = LightEvidence(evidence.directions, evidence.olats, evidence.photo.clamp(max=1), evidence.mask)
    assert clipped.clipped.any() and not evidence.clipped.any()  # beyond 1 nothing was clipped at 1
    found = evidence.relit(clipped.least_squares())
    blind = estimate_smooth_weights(
        clipped.directions, *flat(clipped), torch.zeros_like(flat(clipped)[1], dtype=torch.bool)
    )
    at_white = clipped.clipped
    truth = evidence.photo[at_white]
    assert (found[at_white] - truth).norm() < 0.6 * (evidence.relit(blind)[at_white] - truth).norm()
    assert clipped.residual(evidence.photo) == 0 < clipped.residual(0.9 * evidence.photo)


def test_what_the_face_leaves_open_is_smooth_and_of_one_colour() -> None:
    weights = torch.tensor([0.3, 0.2, 0.1]) * (0.2 + (rig_directions(150)[:, 1:2] + 1))
    evidence = lit(shaded_ball(150), weights)
    found = evidence.least_squares()
    assert evidence.residual(evidence.relit(found)) < 0.05
    assert (found - weights).norm() < 0.15 * weights.norm()
    colour = found / found.sum(1, keepdim=True)
    assert (colour - torch.tensor([0.5, 1 / 3, 1 / 6])).abs().mean() < 0.03


def test_a_lone_light_is_not_smeared_out(monkeypatch: pytest.MonkeyPatch) -> None:
    light = int((rig_directions(150) @ torch.tensor([0.6, 0.0, 0.8])).argmax())
    weights = torch.full((150, 3), 0.004)
    weights[light] += 0.8
    evidence = lit(shaded_ball(150), weights)
    around = rig_directions(150) @ rig_directions(150)[light] > 0.93  # the light and its six neighbours
    found = evidence.least_squares()[around].sum() / weights[around].sum()
    monkeypatch.setattr("facerf_cli.light.estimate._STANDS_OUT", 1e9)
    smeared = evidence.least_squares()[around].sum() / weights[around].sum()
    assert 0.75 < found < 1.05 and smeared < 0.8 * found


def test_a_black_image_and_none_have_no_light() -> None:
    assert estimate_key_light(*flat(shaded_ball())).abs().max() == 0
    evidence = shaded_ball()
    red = LightEvidence(
        evidence.directions,
        evidence.olats,
        evidence.relit(torch.tensor([0.2, 0, 0]).expand(LIGHTS, 3)),
        evidence.mask,
    )
    found = red.least_squares()
    assert found[:, 0].max() > 0.05 and found[:, 1:].abs().max() < 1e-3
    evidence = lit(shaded_ball(), some_weights())
    evidence.require_a_face()
    hidden = LightEvidence(
        evidence.directions, evidence.olats, evidence.photo, torch.zeros_like(evidence.mask)
    )
    refused(InputError, "too little of the face is visible", hidden.require_a_face)
    refused(InputError, "black", shaded_ball().require_a_face)


@pytest.mark.filterwarnings("error")
def test_where_nothing_is_seen_there_is_no_light() -> None:
    found = estimate_key_light(torch.zeros(24, 3, 0), torch.zeros(3, 0))
    assert found.shape == (24, 3) and (found == 0).all()


def test_light_from_around_is_even_as_far_as_the_image_allows() -> None:
    """24 images of a ball have a rank of about 9: free weights would be anything; lamps stay free."""
    evidence = shaded_ball()
    weights = torch.full((LIGHTS, 3), 0.1)
    lamp = int(evidence.directions[:, 2].argmax())
    weights[lamp] = 0.9
    olats, image = flat(lit(evidence, weights))
    first = [lamp, *(k for k in range(LIGHTS) if k != lamp)]
    noise = 0.02 * image.mean() * torch.randn(image.shape, generator=torch.Generator().manual_seed(3))
    even = estimate_key_light(olats[first], image + noise)
    free = free_weights(olats[first], image + noise)
    assert even[1:].std() < 0.005 < 0.03 < free[1:].std()
    assert (even[0] - 0.9).abs().max() < 0.1


def test_the_error_of_a_lamp_is_least_where_it_is() -> None:
    evidence = shaded_ball()
    grey = evidence.olats[..., evidence.mask].mean(1)
    image = 0.8 * grey[5] + 0.3 * grey.mean(0)
    errors = [key_light_error(key, grey.mean(0), image) for key in grey]
    assert errors[5] == min(errors) and errors[5] < 1e-6 < sorted(errors)[1]


def edges(textures: torch.Tensor) -> Sequence[torch.Tensor]:
    """Features of a kind: differences of neighbours, and the values a little."""
    return [textures.diff(dim=-1), textures.diff(dim=-2), 0.1 * textures]


def test_the_loss_falls_the_light_comes_nearer_and_the_caller_needs_no_gradients() -> None:
    weights = some_weights()
    evidence = lit(shaded_ball(), weights)
    start = (weights + 0.05).roll(1, 1)
    refined = refine_light(evidence, start, edges)
    assert refined.loss_after < 0.2 * refined.loss_before
    assert evidence.residual(evidence.relit(refined.weights)) < evidence.residual(evidence.relit(start))
    assert (refined.weights >= 0).all() and refined.steps > 5
    evidence = lit(shaded_ball(), some_weights())
    with torch.no_grad():  # as in `facerf evaluate`
        refined = refine_light(evidence, some_weights() + 0.1, edges)
    assert refined.loss_after < refined.loss_before


def test_a_start_that_is_best_or_only_harmed_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    weights = some_weights()
    evidence = lit(shaded_ball(), weights)
    refined = refine_light(evidence, weights, edges)
    assert torch.equal(refined.weights, weights) and refined.loss_after == refined.loss_before
    start = some_weights() + 0.01
    evidence = lit(shaded_ball(), some_weights())
    monkeypatch.setattr(estimate, "_STEPS", 15)
    monkeypatch.setattr(estimate, "_RATE", 1e4)
    refined = refine_light(evidence, start, edges)
    assert torch.equal(refined.weights, start) and refined.loss_after == refined.loss_before > 0


def test_it_ends_when_nothing_is_gained_and_starts_from_no_light(monkeypatch: pytest.MonkeyPatch) -> None:
    evidence = lit(shaded_ball(), some_weights())
    with monkeypatch.context() as patch:
        patch.setattr(estimate, "_PATIENCE", 5)
        patch.setattr(estimate, "_SETTLED", 0.9)
        assert refine_light(evidence, some_weights() + 0.1, edges).steps <= 10
    refined = refine_light(evidence, torch.zeros(LIGHTS, 3), edges)
    assert refined.loss_after < refined.loss_before and refined.weights.isfinite().all()


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


SEEN = torch.ones(16, 16)


def _images() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    explained = 0.3 + 0.4 * torch.rand(3, 16, 16, generator=generator)
    return explained * (0.8 + 0.4 * torch.rand(3, 16, 16, generator=generator)), explained


def test_under_the_photos_own_light_the_error_goes_and_another_is_left_alone() -> None:
    photo, explained = _images()
    corrected = Quotient.of(photo, explained, SEEN).corrected(explained[None])[0]
    assert (corrected - photo).norm() < 0.25 * (explained - photo).norm()
    side = torch.zeros(1, 3, 16, 16)
    side[..., :2] = 0.5
    other = Quotient.of(photo, explained, SEEN).corrected(side)
    assert torch.allclose(other, side, rtol=0.02)


def test_unseen_and_black_texels_are_left_alone_and_ratios_are_bounded() -> None:
    photo, explained = _images()
    seen = SEEN.clone()
    seen[:8] = 0
    quotient = Quotient.of(100 * photo, explained, seen)
    assert (quotient.ratio[:, :8] == 1).all()
    assert quotient.ratio.max() <= 3
    quotient = Quotient.of(torch.zeros_like(photo), torch.zeros_like(explained), SEEN)
    corrected = quotient.corrected(torch.zeros(2, 3, 64, 64))
    assert corrected.shape == (2, 3, 64, 64) and (corrected == 0).all()


@pytest.mark.parametrize("seed", range(8))
def test_the_least_non_negative_is_that_of_scipy(seed: int) -> None:
    random = np.random.default_rng(seed)
    system, wanted = random.standard_normal((60, 4 * (seed + 1))), random.standard_normal(60)
    found = least_non_negative(system.T @ system, system.T @ wanted)
    np.testing.assert_allclose(found, nnls(system, wanted)[0], atol=1e-7)  # the floor of the gram is 1e-9
