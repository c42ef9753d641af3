"""The Geometry Network gives rotations and heads before the camera, whatever the exposure, in both forms."""

import pytest
import torch

from facerf_cli.network.geometry import GeometryNetwork, GeometryNetworkSettings

SMALL = GeometryNetworkSettings(identity=5, expression=3, mean_translation_m=(0.01, -0.02, -0.9))


@pytest.fixture
def network():
    torch.manual_seed(0)
    network = GeometryNetwork(SMALL)
    torch.nn.init.normal_(network.regress.weight, std=0.1)  # away from the mean head that it begins with
    return network


def test_outputs_have_the_promised_shapes_whatever_the_side_and_every_weight_has_a_gradient(network):
    estimate = network(torch.rand(2, 3, 128, 128))
    assert [tuple(x.shape) for x in estimate] == [(2, 3, 3), (2, 3), (2, 5), (2, 3)]
    product = estimate.rotation @ estimate.rotation.mT
    assert torch.allclose(product, torch.eye(3).expand(2, 3, 3), atol=1e-5)
    assert torch.allclose(torch.det(estimate.rotation), torch.ones(2), atol=1e-5)
    assert (estimate.translation_m[:, 2] < 0).all()
    crops = torch.nn.functional.interpolate(torch.rand(1, 3, 12, 12), (64, 64), mode="bilinear")
    large = torch.nn.functional.interpolate(crops, (128, 128), mode="nearest")
    assert torch.allclose(network(crops).rotation, network(large).rotation, atol=1e-4)
    assert network(torch.rand(1, 3, 40, 40)).alpha.isfinite().all()
    estimate = network(torch.rand(2, 3, 96, 96))
    sum(x.square().sum() + x.sum() for x in estimate).backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in network.parameters())


def test_it_begins_at_the_mean_head():
    network = GeometryNetwork(SMALL)
    estimate = network(torch.rand(1, 3, 96, 96))
    assert torch.allclose(estimate.rotation, torch.eye(3)[None], atol=0.05)
    assert torch.allclose(estimate.translation_m, torch.tensor([[0.01, -0.02, -0.9]]), atol=0.01)


def test_exposure_does_not_matter_and_black_crops_give_a_head_all_the_same(network):
    crops, exposures = torch.rand(2, 3, 96, 96), torch.tensor([0.01, 300.0]).view(2, 1, 1, 1)
    for a, b in zip(network(crops), network(crops * exposures), strict=True):
        assert torch.allclose(a, b, atol=1e-4)
    for level in (0.0, -1.0):
        assert all(x.isfinite().all() for x in network(torch.full((1, 3, 96, 96), level)))


def test_the_default_form_is_small_and_the_papers_has_all_of_alexnet():
    assert sum(p.numel() for p in GeometryNetwork().parameters()) <= 1_500_000
    network = GeometryNetwork(GeometryNetworkSettings("paper", 80, 29))
    last = 4096 * 1000 + 1000  # AlexNet has, as published for the one tower, 61,100,840 with its last layer
    assert sum(p.numel() for p in network.trunk.parameters()) == 61_100_840 - last
    with torch.no_grad():
        assert network(torch.rand(1, 3, 256, 256)).alpha.shape == (1, 80)
