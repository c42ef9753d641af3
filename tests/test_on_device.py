"""Relighting and a step of every training stage on a device that a CPU feigns: nothing is left on the CPU.

tests/test_cuda.py runs them on a GPU.
"""

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import facerf_cli as facerf
from facerf_cli.evaluation.measure import lpips_by
from facerf_cli.network.diffuse_sh import DiffuseNetwork, DiffuseSettings
from facerf_cli.network.features import LightNetwork, LightSettings, Lpips
from facerf_cli.network.inputs import head_rotation
from facerf_cli.network.parsing import ParsingNetwork
from facerf_cli.network.portrait import PortraitNetwork, PortraitSettings
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.network.stored_graph import PeopleNetworks, mediapipe_networks
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.relighting.models import Networks
from facerf_cli.synth.bank.heads import Bank
from facerf_cli.training.diffuse_sh import DiffuseObjective, SumSettings
from facerf_cli.training.light_features import LightFeaturesObjective
from facerf_cli.training.objective import Objective, seeded
from facerf_cli.training.parsing import ParsingObjective
from facerf_cli.training.portrait import PortraitObjective
from facerf_cli.training.texture import PeopleSettings, TextureObjective, TextureObjectiveSettings
from tests import fake_device
from tests.synth.conftest import bank, bank_folder
from tests.training import toy_parsing, toy_portrait

__all__ = ["bank", "bank_folder"]
ASTRONAUT = Path(__file__).parents[1] / "examples/astronaut.jpg"
KINDS = ("reflectance", "geometry", "diffuse_sh", "light_features", "parsing", "portrait")


def test_relighting_mixes_no_devices() -> None:
    """The portrait field and the Reflectance Network's, from a photo to an image."""
    models = facerf.load_models()
    given = {kind: fake_device.moved(copy.deepcopy(getattr(models.networks, kind))) for kind in KINDS}
    networks = Networks(models.networks.files, fake_device.DEVICE, given)
    graphs = mediapipe_networks(torch.device("cpu"))  # of stored operators, which take their device's
    networks.people = PeopleNetworks(given["parsing"], *graphs)
    photo, light = facerf.read_image(ASTRONAUT)[::2, ::2].copy(), facerf.Light.single(60, 30)
    expected = facerf.fit(models, photo, texture_side=128).relight(light)
    with fake_device.in_use() as calls:
        relit = facerf.fit(replace(models, networks=networks), photo, texture_side=128).relight(light)
    assert calls.count > 100
    np.testing.assert_allclose(relit, expected, atol=1e-3)  # of bfloat16, if the processor has it


def reflectance(bank: Bank) -> Objective:
    settings = TextureObjectiveSettings(lights=3, held_out_people=2, held_out_draws=1)
    network = DefaultReflectanceSettings(32, (8, 12, 16), (8, 12, 16), template_channels=2, rig_lights=20)
    return TextureObjective(bank, DefaultReflectanceNetwork(network), None, settings)


def light_features(bank: Bank) -> Objective:
    settings = PeopleSettings(lights=4, held_out_people=2, held_out_draws=1)
    return LightFeaturesObjective(bank, LightNetwork(LightSettings(1 / 8, 4, 32)), settings)


def diffuse_sh(bank: Bank) -> Objective:
    network = DiffuseNetwork(DiffuseSettings(32, (8, 12, 16), (8, 12, 16), 4, 4, 16))
    return DiffuseObjective(bank, network, SumSettings(lights=4, sums=2, held_out_people=2, held_out_draws=2))


def parsing(bank: Bank) -> Objective:
    source: Any = SimpleNamespace(
        provenance={"licence": "MIT"},
        people=lambda held_out: ([1], [0]),
        draw=lambda people, side, generator: toy_parsing.truth(side),
    )
    network = ParsingNetwork(toy_parsing.TINY)
    return ParsingObjective(source, network, toy_parsing.SETTINGS)


def portrait(bank: Bank) -> Objective:
    network = PortraitNetwork(PortraitSettings((8, 8, 8), (0, 1, 1), 14, 32))
    return PortraitObjective(toy_portrait.Portraits(), network, toy_portrait.SETTINGS)


@pytest.mark.parametrize("stage", [reflectance, light_features, diffuse_sh, parsing, portrait])
def test_a_step_and_a_validation_mix_no_devices(bank: Bank, stage: Callable[[Bank], Objective]) -> None:
    objective = stage(bank)
    batch = objective.draw(2, lambda index, step=0: seeded(0, step, index), 0).each(fake_device.OnDevice)
    fake_device.moved(objective)
    with fake_device.in_use():
        torch.stack(list(objective(batch).values())).sum().backward()
        metrics = objective.validate().metrics
    assert all(parameter.grad is not None for parameter in objective.networks.parameters())
    assert np.isfinite(metrics[objective.chooses_by])


def test_lpips_is_measured_on_the_device() -> None:
    network = Lpips(1 / 16).requires_grad_(False)
    images = np.random.default_rng(0).random((2, 24, 32, 3)).astype(np.float32)
    expected = lpips_by(network)(*images)
    with fake_device.in_use() as calls:
        found = lpips_by(fake_device.moved(network))(*images)
    assert found == pytest.approx(expected) and expected > 0
    assert calls.count > 10


def test_a_heads_rotation_is_found_on_the_device() -> None:
    turn = pose_to_rotation(20.0, 10.0, 5.0).float()
    mean = torch.nn.functional.normalize(torch.randn(3, 8, 8), dim=0)
    normals = torch.einsum("ij,jhw->ihw", turn, mean)[None]
    with fake_device.in_use():
        found = head_rotation(fake_device.OnDevice(mean), fake_device.OnDevice(normals))
    torch.testing.assert_close(found.values[0], turn)
