"""The Parsing Network: shares, means of heatmaps, contrast, and its settings in a checkpoint."""

from pathlib import Path

import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.network import parsing
from facerf_cli.network.checkpoint import save_networks
from facerf_cli.network.parsing import ParsingNetwork, ParsingSettings
from facerf_cli.relighting.models import load_models
from tests.refusals import refused

SMALL = ParsingSettings((8, 8, 12, 16), (0, 1, 1, 1), 64, 5, 70)


@pytest.fixture(scope="module")
def network() -> ParsingNetwork:
    torch.manual_seed(0)
    return ParsingNetwork(SMALL).eval()


def crops(count: int = 2, side: int = 64) -> torch.Tensor:
    return torch.rand(count, 3, side, side, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("side", [64, 96])
def test_sizes(network: ParsingNetwork, side: int) -> None:
    found = network(crops(side=side))
    assert found.logits.shape == (2, 5, side, side) and found.landmarks.shape == (2, 70, 2)
    assert found.log_error.shape == (2, 70) and found.presence.shape == (2,)
    assert torch.allclose(found.classes.sum(1), torch.ones(2, side, side), atol=1e-5)


def test_brightness_contrast_and_the_others_of_a_batch_do_not_matter(network: ParsingNetwork) -> None:
    plain, other = network(crops()), network(0.2 + 0.5 * crops())
    # the deviation has a floor of 0.02 under it
    assert (plain.classes - other.classes).abs().max() < 0.02
    assert (plain.landmarks - other.landmarks).abs().max() < 0.005
    assert torch.allclose(plain.logits[1:], network(crops()[1:]).logits, atol=1e-4)


def test_landmarks_are_the_means_of_their_heatmaps() -> None:
    heat = torch.full((1, 2, 4, 8), -30.0)
    heat[0, 0, 1, 6] = 30.0  # right of the middle, above it
    heat[0, 1, 3, 0] = heat[0, 1, 3, 4] = 30.0
    means = parsing._means(heat)[0]
    assert torch.allclose(means, torch.tensor([[6.5 / 8, 1.5 / 4], [2.5 / 8, 3.5 / 4]]), atol=1e-6)


def test_every_weight_takes_part(network: ParsingNetwork) -> None:
    found = network(crops())
    total = found.logits.square().mean() + found.landmarks.square().mean()
    (total + found.log_error.square().mean() + found.presence.square().mean()).backward()
    dead = [
        name for name, weight in network.named_parameters() if weight.grad is None or not weight.grad.any()
    ]
    assert not dead


def test_a_network_of_other_classes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    save_networks(path, {"parsing": ParsingNetwork(SMALL)}, {"layout_version": LAYOUT_VERSION})
    refused(InputError, "Parsing Network of this version", load_models([path]).networks.load, ["parsing"])
