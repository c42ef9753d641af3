from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from facerf_cli.network.features import LightNetwork, LightSettings
from facerf_cli.network.inputs import colour_cast
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.synth.bank.heads import Bank
from facerf_cli.synth.bank.texture_samples import Sample
from facerf_cli.training.losses import root_loss
from facerf_cli.training.objective import seeded
from facerf_cli.training.texture import TextureObjective, TextureObjectiveSettings
from tests.toy_faces import SIDE, ToyFaces, toy_objective
from tests.training.alone import assert_samples_are_alone

NETWORK = DefaultReflectanceSettings(
    side=32, encoder_widths=(8, 12, 16), decoder_widths=(8, 12, 16), template_channels=2, rig_lights=20
)


def test_a_sample_depends_on_no_neighbour() -> None:
    assert_samples_are_alone(toy_objective())


def test_validation_measures_the_same_samples_every_time_and_tells_the_poses_apart(bank: Bank) -> None:
    settings = TextureObjectiveSettings(held_out_people=2, held_out_draws=12)
    objective = TextureObjective(bank, DefaultReflectanceNetwork(NETWORK), settings=settings)
    first, second = objective.validate(), objective.validate()
    assert first.metrics == second.metrics
    assert first.metrics.keys() == {"si_mse", "si_mse_same_pose", "si_mse_other_pose"}
    assert first.sheet is not None and first.sheet.shape == (5 * 2 * 32, 7 * 32, 3)
    assert np.isfinite(first.sheet).all() and first.sheet.max() > 0.1


def test_the_loss_on_features_pulls_the_prediction_toward_the_target() -> None:
    torch.manual_seed(0)
    light = LightNetwork(LightSettings(width=0.05, grid=4, hidden=8)).eval().requires_grad_(False)
    settings = TextureObjectiveSettings(lights=2, held_out_people=3)
    objective = TextureObjective(ToyFaces(), toy_objective().networks["reflectance"], light, settings)
    batch = objective.draw(2, lambda i: seeded(1, i), 1)
    terms = objective(batch)
    assert terms.keys() == {"root", "light_features"} and float(terms["light_features"].detach()) > 0
    terms["light_features"].backward()
    assert all(parameter.grad is None for parameter in light.parameters())
    gradients = [parameter.grad for parameter in objective.networks.parameters()]
    assert any(gradient is not None and float(gradient.abs().max()) > 0 for gradient in gradients)
    assert "light" not in objective.networks


@pytest.mark.parametrize("normals", [True, False])
def test_without_normals_the_network_does_not_see_them(normals: bool) -> None:
    torch.manual_seed(0)
    settings = DefaultReflectanceSettings(
        16, (8, 8), (8, 8), template_channels=1, rig_lights=8, normals=normals
    )
    objective = TextureObjective(ToyFaces(), DefaultReflectanceNetwork(settings))
    sample = objective.draw(1, lambda i: seeded(1, i), 1).sample
    network = objective.networks["reflectance"]
    turned = sample.normals_source.flip(-1) * torch.tensor([-1.0, 1, 1]).view(3, 1, 1)
    seen = []
    for maps in (sample.normals_source, turned.roll(3, -1)):
        encoded = network.encode(sample.source, maps, sample.visible)
        seen.append(network.decode(encoded, maps, sample.lights))
    assert torch.equal(seen[0], seen[1]) != normals


class ColouredFaces(ToyFaces):
    """Toys of which one in eight is in strongly blue light."""

    def draw(self, people: Tensor, lights: int, generator: torch.Generator) -> Sample:
        sample = super().draw(people, lights, generator)
        blue = torch.where((people % 8 == 0)[:, None], torch.tensor([0.1, 0.5, 3.0]), torch.ones(3))
        return replace(sample, source=sample.source * blue[..., None, None])


class WritesDown(nn.Module):
    """A Reflectance Network that predicts one root, and keeps what it is given."""

    rig_lights = 0

    def __init__(self) -> None:
        super().__init__()
        self.root = nn.Parameter(torch.full((1, 1, 3, SIDE, SIDE), 0.4))

    def encode(self, *given: Tensor) -> Any:
        self.encoded = given
        return SimpleNamespace(exposure=torch.full((len(given[0]), 1, 1, 1), 0.5))

    def decode_root(self, encoded: Any, normals: Tensor, lights: Tensor) -> Tensor:
        self.decoded = normals, lights
        return self.root.expand(*lights.shape[:2], -1, -1, -1)


def test_the_network_sees_what_it_sees_at_test_time() -> None:
    """Strange colours of light are removed by the colours that the checkpoint keeps; targets are exposed."""
    network = WritesDown()
    settings = TextureObjectiveSettings(lights=2, held_out_people=3)
    objective = TextureObjective(ColouredFaces(), network, settings=settings)
    colours = objective.source_colours
    assert colours is not None
    batches = (objective.draw(1, lambda i, k=k: seeded(k, i), 1) for k in range(99))
    batch = next(found for found in batches if int(found.people) % 8 == 0)
    sample, terms = batch.sample, objective(batch)
    cast = colour_cast(sample.source, sample.visible, colours)
    assert cast[0, 2] > 1.5 * cast[0, 0]
    torch.testing.assert_close(network.encoded[0], sample.source / cast)
    assert torch.equal(network.decoded[1], sample.lights)
    expected = root_loss(network.decode_root(None, *network.decoded), sample.target / 0.5, sample.weight)
    torch.testing.assert_close(terms["root"], expected)
