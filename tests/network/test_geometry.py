"""The Geometry Network gives rotations and heads before the camera, whatever the exposure, in both forms."""

from copy import copy
from pathlib import Path

import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.network.checkpoint import load_networks, save_networks
from facerf_cli.network.geometry import GeometryNetwork, GeometryNetworkSettings

SMALL = GeometryNetworkSettings(identity=5, expression=3, mean_translation_m=(0.01, -0.02, -0.9))


@pytest.fixture
def network():
    torch.manual_seed(0)
    network = GeometryNetwork(SMALL)
    torch.nn.init.normal_(network.regress.weight, std=0.1)  # away from the mean head that it begins with
    return network


def test_outputs_have_the_promised_shapes(network):
    estimate = network(torch.rand(2, 3, 128, 128))
    assert [tuple(x.shape) for x in estimate] == [(2, 3, 3), (2, 3), (2, 5), (2, 3)]
    product = estimate.rotation @ estimate.rotation.mT
    assert torch.allclose(product, torch.eye(3).expand(2, 3, 3), atol=1e-5)
    assert torch.allclose(torch.det(estimate.rotation), torch.ones(2), atol=1e-5)
    assert (estimate.translation_m[:, 2] < 0).all()


def test_it_begins_at_the_mean_head():
    network = GeometryNetwork(SMALL)
    estimate = network(torch.rand(1, 3, 96, 96))
    assert torch.allclose(estimate.rotation, torch.eye(3)[None], atol=0.05)
    assert torch.allclose(estimate.translation_m, torch.tensor([[0.01, -0.02, -0.9]]), atol=0.01)


def test_exposure_does_not_matter(network):
    crops = torch.rand(2, 3, 96, 96)
    for a, b in zip(
        network(crops), network(crops * torch.tensor([0.01, 300.0]).view(2, 1, 1, 1)), strict=True
    ):
        assert torch.allclose(a, b, atol=1e-4)


@pytest.mark.parametrize("crops", [torch.zeros(1, 3, 96, 96), torch.full((1, 3, 96, 96), -1.0)])
def test_black_crops_give_a_head_all_the_same(network, crops):
    assert all(x.isfinite().all() for x in network(crops))


def test_crops_of_any_side_are_taken_and_mean_the_same(network):
    crops = torch.nn.functional.interpolate(torch.rand(1, 3, 12, 12), (64, 64), mode="bilinear")
    large = torch.nn.functional.interpolate(crops, (128, 128), mode="nearest")
    assert torch.allclose(network(crops).rotation, network(large).rotation, atol=1e-4)
    assert network(torch.rand(1, 3, 40, 40)).alpha.isfinite().all()


def test_every_weight_has_a_gradient(network):
    estimate = network(torch.rand(2, 3, 96, 96))
    sum(x.square().sum() + x.sum() for x in estimate).backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in network.parameters())


def test_the_default_form_is_small():
    assert sum(p.numel() for p in GeometryNetwork().parameters()) <= 1_500_000


def test_the_paper_form_has_all_of_alexnet():
    network = GeometryNetwork(GeometryNetworkSettings("paper", 80, 29))
    trunk = sum(p.numel() for p in network.trunk.parameters())
    assert trunk == 61_100_840 - (
        4096 * 1000 + 1000
    )  # AlexNet's, as published for the one tower, but its last
    with torch.no_grad():
        assert network(torch.rand(1, 3, 256, 256)).alpha.shape == (1, 80)


def test_a_checkpoint_gives_the_network_back(network, tmp_path: Path):
    path = tmp_path / "a.safetensors"
    save_networks(path, {"geometry": network}, {"layout_version": 1, "licence": "MIT"})
    found = load_networks(path, 1)[0]["geometry"]
    assert isinstance(found, GeometryNetwork) and found.settings == network.settings
    crops = torch.rand(1, 3, 96, 96)
    assert torch.allclose(found(crops).rotation, network(crops).rotation, atol=1e-2)  # half precision


@pytest.mark.parametrize(
    "change",
    [
        {"identity": 10**9},
        {"form": "large"},
        {"mean_translation_m": [0, 0, 1]},
        {"mean_translation_m": [0, 0]},
        {"identity": None},
    ],
)
def test_impossible_settings_are_refused(network, change, tmp_path: Path):
    path = tmp_path / "a.safetensors"
    lying, metadata = copy(network), network.as_metadata() | change
    lying.as_metadata = lambda: metadata
    save_networks(path, {"geometry": lying}, {"layout_version": 1})
    with pytest.raises(InputError, match="train it again"):
        load_networks(path, 1)
