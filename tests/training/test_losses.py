import torch

from facerf_cli.network.inputs import from_root, to_root
from facerf_cli.training.losses import clipped_si_mse, root_loss, si_mse


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
