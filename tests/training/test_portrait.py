"""The terms of the stage portrait against known answers."""

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.dataset.synthhuman import LICENCE, SeenNormals, SynthHuman, SynthHumanNormals
from facerf_cli.errors import InputError
from facerf_cli.network.portrait import PortraitInputs, PortraitMaps, PortraitNetwork, PortraitSettings
from facerf_cli.portrait.parse import class_index
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from facerf_cli.synth.bank.portrait_samples import PortraitSample
from facerf_cli.training.portrait import PortraitObjective
from tests import astronaut
from tests.kinds import Patch
from tests.refusals import refused
from tests.training.synthhuman_folder import write_seen_synthhuman
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
    assert max(found[name] for name in ("lights", "edges", "own", "albedo")) < 1e-4
    assert found["scale"] == pytest.approx(SETTINGS.scale * 0.6931, rel=1e-3)
    wrong = perfect().albedo.clone()
    wrong[..., SIDE // 2 + 4 :] = 3.0  # beyond the pixels that are averaged with the person's
    assert max(terms(perfect()._replace(albedo=wrong)).values()) < 1e-4


@pytest.mark.parametrize(
    ("change", "dearer"),
    [
        ({"albedo": whole(torch.tensor([0.6, 0.4, 0.2]))}, {"lights", "own", "albedo"}),
        (
            {"normals": whole(F.normalize(torch.tensor([-0.8, 0.1, 1.0]), dim=0))},
            {"lights", "own", "normals"},
        ),
        ({"around": whole(0.5, 16, SIDE // 2)}, {"lights", "own"}),
        ({"gloss": whole(0.3)}, {"lights", "own"}),
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


def test_arms_of_wide_squares_are_no_neck() -> None:
    """Half of the person is neck; what is wrong in a wide square is counted there alone."""
    wrong = objective(perfect()._replace(normals=whole(F.normalize(torch.tensor([0.5, 0.1, 1.0]), dim=0))))
    shares, sides = truth().shares.clone(), truth().inputs.sides
    shares[:, class_index("neck"), : SIDE // 2] = shares[:, class_index("skin"), : SIDE // 2]
    shares[:, class_index("skin"), : SIDE // 2] = 0
    shown = replace(truth(), shares=shares)
    wide = replace(shown, inputs=replace(shown.inputs, sides=2 * sides), targets=shown.targets.flip(1))
    wrong._held_out_samples = [shown, wide]
    both = wrong.validate().metrics
    assert both["neck"] == both["neck_shoulders"] != both["neck_wide"]
    wrong._held_out_samples = [wide]
    alone = wrong.validate().metrics
    assert alone["error_wide"] == both["error_wide"] and "error_close" not in both
    assert both["error_shoulders"] != both["error_wide"]


def test_a_batch_has_squares_of_one_side() -> None:
    stage = objective(perfect())
    asked = []
    for step in range(20):
        stage.portraits.asked.clear()
        stage.draw(2, lambda index, step=step: torch.Generator(), step)
        (side,) = set(stage.portraits.asked)
        asked.append(side)
    assert set(asked) == {SIDE, 2 * SIDE}


def test_people_of_synthhuman_teach_normals_alone(tmp_path: Path, monkeypatch: Patch) -> None:
    """Five steps, some of them on a made-up folder, whose y is down and z away from the camera."""
    monkeypatch.setattr("facerf_cli.dataset.synthhuman.in_shards", lambda work, items, jobs: work(items))
    own = astronaut.person().normals
    images = SynthHuman(write_seen_synthhuman(tmp_path, own * np.array([1, -1, -1], np.float32)))
    people = SynthHumanNormals(images, tmp_path / "cache", SHIPPED_NETWORKS, 1)
    samples = [people.draw(torch.Generator().manual_seed(seed)) for seed in range(8)]
    for sample in samples:  # some are mirrored
        shown = sample.alpha[:, 0] > 0.9
        agreed = (sample.inputs.normals[:, 0] * sample.normals[:, 0])[shown]
        assert shown.float().mean() > 0.1 and agreed.mean() > 0.1
    assert len({round(float(one.alpha[..., :80].sum())) for one in samples}) == 2
    with monkeypatch.context() as patched:  # shaded skin is seen as in photos
        patched.setattr("facerf_cli.dataset.synthhuman.even_shade_of", lambda image, classes: 0 * image)
        assert not people.draw(torch.Generator()).inputs.image.any()
    settings = replace(SETTINGS, synthhuman=0.5)
    network = PortraitNetwork(PortraitSettings((4, 4, 4, 4, 4)))
    stage = PortraitObjective(Portraits(), network, settings, people)
    assert stage.provenance["licence"] == f"MIT; {LICENCE}"
    drawn = [stage.draw(2, lambda i: torch.Generator().manual_seed(i), step) for step in range(20)]
    batches = [batch for batch in drawn if isinstance(batch, SeenNormals)]
    assert 5 <= len(batches) <= 15
    optimizer = torch.optim.Adam(stage.parameters(), 3e-3)
    losses = []
    for batch in batches[:5]:
        (loss,) = stage(batch).values()
        optimizer.zero_grad()
        loss.backward()
        assert all(part.grad is not None for part in stage.parameters())
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0]
    answer = cast(PortraitNetwork, Answer(perfect()._replace(normals=sample.normals)))
    assert float(PortraitObjective(Portraits(), answer, settings, people)(sample)["normals"]) < 1e-3
    write_seen_synthhuman(tmp_path, np.zeros_like(own))
    refused(InputError, "no image shows", SynthHumanNormals, images, tmp_path / "other", SHIPPED_NETWORKS, 1)
