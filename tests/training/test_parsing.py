"""The terms of the stage parsing against known answers."""

from typing import cast

import pytest
import torch
from torch import Tensor, nn

from facerf_cli.network.parsing import Parsing, ParsingNetwork
from facerf_cli.portrait.parse import CLASSES, LANDMARKS, class_index
from facerf_cli.synth.bank.parsing_crops import ParsingCrops, ParsingPhotos
from facerf_cli.training.parsing import ParsingObjective
from tests.training.toy_parsing import SETTINGS, SIDE, Portraits, truth


def seen(batch: ParsingCrops, sure: float = 30.0) -> Parsing:
    """What a perfect network says."""
    shown = torch.where(batch.alpha > 0.5, batch.label, 0)
    logits = sure * nn.functional.one_hot(shown, len(CLASSES)).permute(0, 3, 1, 2).float()
    return Parsing(logits, batch.landmarks.clone(), torch.full((1, LANDMARKS), -3.0), torch.full((1,), sure))


class Answers(nn.Module):
    """A network that gives one answer."""

    side = SIDE

    def __init__(self, answer: Parsing) -> None:
        super().__init__()
        self.answer = answer
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, crops: Tensor) -> Parsing:
        return self.answer


def objective_of(answer: Parsing) -> ParsingObjective:
    portraits = cast(ParsingPhotos, Portraits())
    return ParsingObjective(portraits, cast(ParsingNetwork, Answers(answer)), SETTINGS)


def terms(answer: Parsing, batch: ParsingCrops | None = None) -> dict[str, float]:
    found = objective_of(answer)(batch or truth())
    return {name: float(term) for name, term in found.items()}


def test_a_perfect_network_pays_for_its_doubts_alone() -> None:
    found = terms(seen(truth()))
    assert found["classes"] < 1e-6 and found["matte"] < 1e-6
    assert found["distance"] == 0 and found["presence"] < 1e-6
    assert found["landmarks"] == pytest.approx(SETTINGS.landmarks * 2 * -3.0)
    validation = objective_of(seen(truth())).validate()
    assert validation.metrics["mean_iou"] == pytest.approx(1) and validation.metrics["matte_error"] < 1e-6
    assert validation.metrics["landmarks_percent"] == 0 and validation.metrics["presence_wrong"] == 0
    assert validation.sheet is not None and validation.sheet.shape == (SIDE, 2 * SIDE, 3)
    answer = seen(truth())
    answer.logits[:, :, :, 5] = answer.logits[:, :, :, 6]  # the person ends a column too early
    assert terms(answer)["matte"] == pytest.approx(1 / 8 + 2 / 7, rel=1e-3)


def test_landmarks_weigh_by_their_expected_error_and_cost_nothing_unknown() -> None:
    answer = seen(truth())
    answer.landmarks[:, 3, 0] += 0.1
    found = terms(answer)
    assert found["distance"] == pytest.approx(SETTINGS.distance * 0.1 / 68, rel=1e-5)
    expected = SETTINGS.landmarks * (-6.0 + 0.1 * torch.tensor(3.0).exp() / 68)
    assert found["landmarks"] == pytest.approx(float(expected), rel=1e-5)
    answer.log_error[:, 3] = -1.0
    assert terms(answer)["landmarks"] < found["landmarks"] + SETTINGS.landmarks * 4 / 68
    answer = seen(truth())
    answer.landmarks[:, 70] += 0.3
    assert terms(answer) == terms(seen(truth()))


def test_rare_classes_weigh_more_and_unknown_pixels_nothing() -> None:
    def cost(row: int, weight: float) -> float:
        batch, answer = truth(), seen(truth())
        answer.logits[:, :, row, 0] = 0
        batch.weight[:, row, 0] = weight
        return terms(answer, batch)["classes"]

    even = float(torch.tensor(len(CLASSES)).log()) / SIDE**2
    assert cost(4, 1.0) == pytest.approx(even, rel=1e-4)  # skin
    assert cost(0, 1.0) == pytest.approx(SETTINGS.rare * even, rel=1e-4)  # ears
    assert cost(0, 0.0) < 1e-6


def test_a_soft_edge_is_best_met_by_its_own_share() -> None:
    batch = truth()
    batch.alpha[:, 4, 4] = 0.3

    def cost(share: float) -> float:
        answer = seen(batch)
        answer.logits[:, :, 4, 4] = -30.0
        answer.logits[:, class_index("skin"), 4, 4] = float(torch.tensor(share).log())
        answer.logits[:, 0, 4, 4] = float(torch.tensor(1 - share).log())
        found = terms(answer, batch)
        return found["classes"] + found["matte"]

    assert cost(0.3) < min(cost(0.2), cost(0.4))
