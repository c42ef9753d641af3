"""A bank of one crop for the stage parsing."""

from typing import Any

import torch

from facerf_cli.network.parsing import ParsingSettings
from facerf_cli.portrait.parse import CLASSES, LANDMARKS, class_index
from facerf_cli.synth.bank.parsing_crops import ParsingCrops
from facerf_cli.training.parsing import ParsingObjectiveSettings

SIDE = 8
SETTINGS = ParsingObjectiveSettings(held_out_people=1, held_out_draws=1)
TINY = ParsingSettings((8, 8, 8), (0, 1, 1), 32, len(CLASSES), LANDMARKS)


class Portraits:
    """A bank of one fixed crop."""

    provenance: dict[str, Any] = {"licence": "MIT"}  # noqa: RUF012

    def people(self, held_out: int) -> tuple[list[int], list[int]]:
        return [1], [0]

    def draw(self, people: list[int], side: int, generator: torch.Generator) -> ParsingCrops:
        return truth()


def truth(side: int = SIDE) -> ParsingCrops:
    label = torch.full((1, side, side), class_index("skin"))
    label[:, :2] = class_index("ears")  # a rare class
    alpha = torch.ones(1, side, side)
    alpha[:, :, 6:] = 0
    known = torch.ones(1, LANDMARKS, dtype=torch.bool)
    known[:, 68:] = False
    places = torch.rand(1, LANDMARKS, 2, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.25
    return ParsingCrops(
        torch.rand(1, 3, side, side), alpha, label, torch.ones(1, side, side), places, known, torch.ones(1)
    )
