"""The terms of the stage portrait against known answers."""

from dataclasses import replace
from typing import cast

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.network.portrait import PortraitInputs, PortraitMaps, PortraitNetwork
from facerf_cli.synth.bank.portrait_samples import PortraitSample
from facerf_cli.training.portrait import PortraitObjective
from tests.training.toy_portrait import NORMAL, SETTINGS, SIDE, Portraits, truth, whole


def perfect() -> PortraitMaps:
    """The maps of a matt wall of albedo 0.4, all of skin."""
    few, many = whole(0, 16, SIDE // 2), whole(0, 25, SIDE // 2)
    surface = {"albedo": whole(0.4), "normals": whole(NORMAL), "strands": whole(NORMAL), "gloss": whole(0)}
    light = {"hair": whole(0, 1), "trust": whole(60, 1), "lit": few, "around": few, "shadow": many}
    return PortraitMaps(gain=whole(1), bias=whole(0), **surface, **light)


class Answer(nn.Module):
    """A network that gives one answer."""

    def __init__(self, answer: PortraitMaps) -> None:
        super().__init__()
        self.answer = answer
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, inputs: PortraitInputs) -> PortraitMaps:
        return self.answer


def objective(answer: PortraitMaps) -> PortraitObjective:
    return PortraitObjective(Portraits(), cast(PortraitNetwork, Answer(answer)), SETTINGS)


def terms(answer: PortraitMaps, sample: PortraitSample | None = None) -> dict[str, float]:
    return {name: float(term) for name, term in objective(answer)(sample or truth()).items()}


def test_a_perfect_network_pays_nothing_whatever_is_unknown_or_behind() -> None:
    assert max(terms(perfect()).values()) < 1e-4
    wrong = perfect()._replace(
        albedo=whole(torch.tensor([0.6, 0.4, 0.2])), normals=whole(torch.tensor([0.0, 1, 0]))
    )
    found = terms(wrong, replace(truth(), labelled=torch.zeros(1)))
    assert found["albedo"] == found["normals"] == 0 and found["lights"] > 3e-3
    found = terms(perfect()._replace(albedo=whole(0.8)))
    assert max(found[name] for name in ("lights", "edges", "original", "albedo")) < 1e-4
    assert found["scale"] == pytest.approx(SETTINGS.scale * 0.6931, rel=1e-3)
    wrong = perfect().albedo.clone()
    wrong[..., SIDE // 2 + 4 :] = 3.0  # beyond the pixels that are averaged with the person's
    assert max(terms(perfect()._replace(albedo=wrong)).values()) < 1e-4


@pytest.mark.parametrize(
    ("change", "dearer"),
    [
        ({"albedo": whole(torch.tensor([0.6, 0.4, 0.2]))}, {"lights", "original", "albedo"}),
        (
            {"normals": whole(F.normalize(torch.tensor([-0.8, 0.1, 1.0]), dim=0))},
            {"lights", "original", "normals"},
        ),
        ({"around": whole(0.5, 16, SIDE // 2)}, {"lights", "original"}),
        ({"gloss": whole(0.3)}, {"lights", "original"}),
    ],
)
def test_each_term_sees_its_own_faults(change: dict[str, Tensor], dearer: set[str]) -> None:
    found = terms(perfect()._replace(**change))
    assert min(found[name] for name in dearer) > 3e-3
    assert (found["normals"] > 1e-4) == ("normals" in dearer)  # the others share the forgiven exposure


def test_edges_and_contrast_are_those_of_the_error() -> None:
    stripes = perfect().albedo.clone()
    stripes[..., ::2] *= 1.5
    smooth, striped = (terms(perfect()._replace(albedo=a)) for a in (whole(0.5), stripes))
    assert smooth["edges"] < 1e-4 < 0.01 < striped["edges"]
    ramp = torch.linspace(0.2, 1.8, SIDE).view(1, 1, 1, SIDE, 1)
    sample = truth()
    uneven = replace(sample, targets=sample.targets * ramp)
    assert terms(perfect(), uneven)["contrast"] > 0.03
    assert terms(perfect()._replace(albedo=perfect().albedo * ramp[0]), uneven)["contrast"] < 1e-4


def test_validation_is_by_region_and_a_sample_moves_as_one() -> None:
    right = objective(perfect()).validate()
    assert right.metrics["face"] < 1e-6 and right.metrics["error"] < 1e-4 and right.sheet is not None
    wrong = objective(perfect()._replace(normals=whole(torch.tensor([0.0, 1.0, 0.0])))).validate()
    assert wrong.metrics["face"] > 0.05 and wrong.metrics["error"] > 0.01
    sample = truth()
    sample = replace(sample, inputs=replace(sample.inputs, image=whole(0.1)))
    moved = sample.to(torch.device("cpu"))
    assert torch.equal(moved.inputs.image, sample.inputs.image)
    assert torch.equal(moved.inputs.own, sample.inputs.own)


def test_a_batch_has_squares_of_one_side() -> None:
    stage = objective(perfect())
    asked = []
    for step in range(20):
        stage.source.asked.clear()
        stage.draw(2, lambda index, step=step: torch.Generator(), step)
        (side,) = set(stage.source.asked)
        asked.append(side)
    assert set(asked) == {SIDE, 2 * SIDE}
