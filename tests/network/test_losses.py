import torch

from facerf_cli.network.losses import root_loss, si_mse


def test_si_mse_does_not_see_scale_but_sees_error() -> None:
    target = torch.rand(2, 3, 3, 8, 8)
    weight = torch.ones(2, 1, 8, 8)
    assert si_mse(0.2 * target, target, weight).max() < 1e-10
    flat = torch.full_like(target, 0.5)
    by_hand = ((flat * (target.mean((2, 3, 4), keepdim=True) / 0.5) - target) ** 2).mean((2, 3, 4))
    assert torch.allclose(si_mse(flat, target, weight), by_hand, atol=1e-6)


def test_si_mse_leaves_masked_texels_out() -> None:
    target = torch.rand(1, 1, 3, 8, 8)
    weight = torch.zeros(1, 1, 8, 8)
    weight[..., :4] = 1
    wrong = target.clone()
    wrong[..., 4:] = 9
    assert si_mse(wrong, target, weight).item() < 1e-10


def test_root_loss_is_least_at_the_truth_and_pulls_out_of_negative_values() -> None:
    target = torch.rand(1, 2, 3, 8, 8) * 0.5 + 0.1
    weight = torch.ones(1, 1, 8, 8)
    truth = (target + 0.02**2).sqrt() - 0.02
    assert root_loss(truth, target, weight) < 1e-6
    below = torch.full_like(target, -0.3, requires_grad=True)
    root_loss(below, target, weight).backward()
    assert below.grad is not None and (below.grad.sum() < 0)
