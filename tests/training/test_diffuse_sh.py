import torch

from facerf_cli.light.sh import rig_coefficients
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.network.diffuse_sh import DiffuseEstimate, DiffuseNetwork, DiffuseSettings
from facerf_cli.synth.bank.heads import Bank
from facerf_cli.synth.bank.texture_samples import Sample
from facerf_cli.training.diffuse_sh import (
    DiffuseObjective,
    SumSettings,
    draw_sums,
    predicted_images,
    sum_lights,
)
from facerf_cli.training.objective import seeded
from tests.training.alone import assert_samples_are_alone

NETWORK = DiffuseSettings(32, (8, 12, 16), (8, 12, 16), 4, 4, 16)
SETTINGS = SumSettings(lights=4, sums=2, held_out_people=2, held_out_draws=2)


def objective(bank: Bank) -> DiffuseObjective:
    return DiffuseObjective(bank, DiffuseNetwork(NETWORK), SETTINGS)


def test_training_explains_both_and_a_validation_is_always_the_same(bank: Bank) -> None:
    stage = objective(bank)
    before = stage.validate().metrics
    batch = stage.draw(4, lambda i: seeded(0, i), 0)
    optimizer = torch.optim.AdamW(stage.networks.parameters(), lr=4e-3)
    terms = []
    for _ in range(60):
        terms.append(stage(batch))
        optimizer.zero_grad()
        sum(terms[-1].values()).backward()
        optimizer.step()
    assert terms[-1]["targets"] < 0.5 * terms[0]["targets"]
    assert terms[-1]["source"] < 0.8 * terms[20]["source"]  # a light for an albedo that is no copy any more
    after = stage.validate()
    assert after.metrics["si_mse"] < 0.6 * before["si_mse"]  # of other heads
    assert after.metrics == stage.validate().metrics
    assert stage.chooses_by in after.metrics and set(stage.networks) == {"diffuse_sh"}
    assert after.sheet is not None and after.sheet.shape == (4 * 2 * 32, 5 * 32, 3)


def test_a_sample_depends_on_no_neighbour_and_the_source_teaches_the_light_alone(bank: Bank) -> None:
    """Else the albedo copies it."""
    stage = objective(bank)
    batch = stage.draw(1, lambda i: seeded(4, i), 0)
    network = stage.networks["diffuse_sh"]
    stage(batch)["source"].backward()
    assert network.albedo.weight.grad is None and network.light[-1].weight.grad.abs().sum() > 0
    stage(batch)["targets"].backward()
    assert network.albedo.weight.grad.abs().sum() > 0
    assert_samples_are_alone(objective(bank))


def test_an_albedo_lit_by_lambert_in_a_dome_is_explained_exactly() -> None:
    """Targets and their coefficients are of one light, in one unit."""
    rig = rig_directions(300)
    normals = torch.nn.functional.normalize(
        torch.randn(1, 3, 8, 8) + torch.tensor([0, 0, 2.0]).view(3, 1, 1), dim=1
    )
    albedo, ones = torch.rand(1, 3, 8, 8), torch.ones(1, 1, 8, 8)
    single = albedo[:, None] * torch.einsum("lc,bcij->blij", rig, normals).clamp_min(0)[:, :, None]
    sample = Sample(albedo, ones, normals, normals, rig[None], single, ones)
    weights = (
        (1 + rig @ torch.tensor([0.5, -0.2, 0.4])).view(1, -1, 1) * torch.tensor([1.0, 0.6, 0.3]) / len(rig)
    )
    summed = sum_lights(sample, weights[None])
    coefficients = rig_coefficients(RigLight(rig, weights[0]), 2)[None]
    estimate = DiffuseEstimate(albedo, coefficients, torch.ones(1, 1, 1, 1))
    for image in predicted_images(estimate, summed, coefficients[None]):
        assert torch.allclose(image, summed.target, rtol=0.02, atol=1e-4)


def test_sums_are_of_one_power_and_from_uneven_to_even() -> None:
    weights = draw_sums(200, 6, seeded(5))
    assert weights.shape == (200, 6, 3) and weights.min() >= 0
    powers = weights.mean(2)
    assert torch.allclose(powers.sum(1), torch.full((200,), 1.5))
    strongest = powers.max(1).values / 1.5
    assert strongest.max() > 0.7 and strongest.min() < 0.35
