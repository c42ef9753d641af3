import math

import pytest
import torch

from facerf_cli.network.features import VggFeatures
from facerf_cli.network.inputs import from_root, to_root
from facerf_cli.training.losses import (
    Features,
    MaskedPair,
    clipped_si_mse,
    landmark_loss,
    photometric_loss,
    root_loss,
    si_mse,
    slid_contour,
)


def test_si_mse_sees_error_within_the_mask_and_no_scale() -> None:
    target = torch.rand(2, 3, 3, 8, 8)
    weight = torch.ones(2, 1, 8, 8)
    assert si_mse(0.2 * target, target, weight).max() < 1e-10
    flat = torch.full_like(target, 0.5)
    by_hand = ((flat * (target.mean((2, 3, 4), keepdim=True) / 0.5) - target) ** 2).mean((2, 3, 4))
    assert torch.allclose(si_mse(flat, target, weight), by_hand, atol=1e-6)
    target = torch.rand(1, 1, 3, 8, 8)
    weight = torch.zeros(1, 1, 8, 8)
    weight[..., :4] = 1
    wrong = target.clone()
    wrong[..., 4:] = 9
    assert si_mse(wrong, target, weight).item() < 1e-10


def test_roots_are_undone_exactly_and_glints_beyond_white_clipped() -> None:
    target = torch.rand(1, 2, 3, 8, 8) * 0.5 + 0.1
    weight = torch.ones(1, 1, 8, 8)
    truth = to_root(target)
    assert root_loss(truth, target, weight) < 1e-6
    below = torch.full_like(target, -0.3, requires_grad=True)
    root_loss(below, target, weight).backward()
    assert below.grad is not None and (below.grad.sum() < 0)
    radiance = torch.cat([torch.zeros(1), torch.logspace(-4, 1, 50)])
    assert torch.allclose(from_root(to_root(radiance)), radiance, rtol=1e-4, atol=1e-7)
    assert from_root(torch.tensor(-0.3)) == 0
    target = torch.full((1, 1, 3, 8, 8), 0.4)
    prediction, weight = target.clone(), torch.ones(1, 1, 8, 8)
    target[..., 3, 3], prediction[..., 3, 3] = 30.0, 3.0
    assert clipped_si_mse(prediction, target, weight).item() < 1e-10
    assert si_mse(prediction, target, weight).item() > 1


def test_the_contour_slides_to_the_closest_candidates_and_with_the_mesh() -> None:
    candidates = (torch.rand(2, 40, 2) * 100).requires_grad_()
    detected = (torch.rand(2, 17, 2) * 100).requires_grad_()
    slid, closest = slid_contour(candidates, detected), set()
    for face in range(2):
        for number, point in enumerate(detected[face].tolist()):
            distances = [math.dist(point, other) for other in candidates[face].tolist()]
            closest.add((face, distances.index(min(distances))))
            assert torch.equal(slid[face, number], candidates[face, distances.index(min(distances))])
    landmark_loss(slid, detected.detach(), 100).sum().backward()
    assert detected.grad is None  # which candidate it is has no gradient
    assert candidates.grad is not None
    moved = {(face, int(i)) for face, i, _ in candidates.grad.nonzero().tolist()}
    assert moved == closest
    # A landmark that the mesh passes by finds another vertex, not the one that it had.
    line = torch.stack([torch.arange(20.0), torch.zeros(20)], -1)[None]
    landmark = torch.tensor([[[7.2, 1.0]]])
    assert slid_contour(line, landmark)[0, 0, 0] == 7
    assert slid_contour(line + torch.tensor([5.0, 0]), landmark)[0, 0, 0] == 7  # then vertex 2


def test_photometric_loss_is_a_mean_over_the_mask() -> None:
    prediction, target = torch.rand(2, 3, 9, 9).requires_grad_(), torch.rand(2, 3, 9, 9)
    mask = (torch.rand(2, 1, 9, 9) > 0.5).float()
    loss, shown = photometric_loss(prediction, target, mask), prediction.detach()
    for face in range(2):
        inside = [(r, c) for r in range(9) for c in range(9) if mask[face, 0, r, c]]
        differences = [
            abs(shown[face, k, r, c] - target[face, k, r, c]).item() for r, c in inside for k in range(3)
        ]
        assert loss[face].item() == pytest.approx(sum(differences) / len(differences), rel=1e-4)
    loss.sum().backward()
    assert prediction.grad is not None and (prediction.grad[(mask == 0).expand_as(prediction)] == 0).all()
    assert photometric_loss(prediction, target, mask * 0).sum().item() == 0


@pytest.fixture(scope="module")
def net() -> VggFeatures:
    torch.manual_seed(0)
    return VggFeatures(width=0.1).requires_grad_(False)


POWERS = torch.tensor([2.0, 3.0, 5.0])  # of the layers


def _seen(side: int) -> MaskedPair:
    mask = torch.zeros(2, 1, side, side)
    mask[..., 2:-2] = 1
    return MaskedPair(torch.rand(2, 3, side, side).requires_grad_(), torch.rand(2, 3, side, side), mask)


def test_features_pull_the_prediction_within_the_mask_alone(net: VggFeatures) -> None:
    image, texture = _seen(24), _seen(16)
    target = texture.target.requires_grad_()
    for pair in (image, MaskedPair(texture.prediction, target, texture.mask)):
        pair.distance(Features(net, POWERS)).sum().backward()
    assert target.grad is None
    for seen in (image, texture):
        grad = seen.prediction.grad
        assert grad is not None and grad.abs().sum() > 0
        assert (grad[(seen.mask == 0).expand_as(grad)] == 0).all()


def test_channels_apart_prefer_no_colour_and_stay_finite(net: VggFeatures) -> None:
    """An error of one channel pulls it alone, and as hard as another, on skin of any colour."""
    skin = torch.tensor([1.5, 0.9, 0.6])[:, None, None] * (torch.rand(2, 1, 24, 24) + 0.2)
    pulls = torch.empty(3, 3)
    for channel in range(3):
        factor = torch.ones(3, 1, 1)
        factor[channel] = 0.7
        wrong = (skin * factor).requires_grad_()
        pair = MaskedPair(wrong, skin, torch.ones(2, 1, 24, 24))
        (slope,) = torch.autograd.grad(pair.distance(Features(net, POWERS, apart=True)).sum(), wrong)
        pulls[channel] = -slope.sum((0, 2, 3))
    assert pulls[0, 0] > 0
    torch.testing.assert_close(pulls, pulls[0, 0] * torch.eye(3), rtol=1e-2, atol=0)
    for colour in ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]):
        target = torch.tensor(colour)[:, None, None].expand(1, 3, 24, 24)
        wrong = torch.rand(1, 3, 24, 24).requires_grad_()
        pair = MaskedPair(wrong, target, torch.ones(1, 1, 24, 24))
        pair.distance(Features(net, POWERS, apart=True)).sum().backward()
        assert wrong.grad is not None and wrong.grad.isfinite().all()
