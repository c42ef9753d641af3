"""A bank of one sample for the stage portrait."""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.light.sphere import rig_directions
from facerf_cli.network.portrait import PortraitInputs
from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.bank.portrait_samples import PortraitSample
from facerf_cli.training.portrait import PortraitObjectiveSettings

SIDE, RIG = 16, rig_directions(12)
SETTINGS = PortraitObjectiveSettings(held_out_people=1, held_out_draws=1, targets=2)
NORMAL = F.normalize(torch.tensor([0.2, 0.1, 1.0]), dim=0)


def whole(value: Tensor | float, channels: int = 3, side: int = SIDE) -> Tensor:
    values = torch.as_tensor(value, dtype=torch.float32).reshape(-1)
    return values.expand(channels).view(1, channels, 1, 1).expand(1, channels, side, side).clone()


def truth() -> PortraitSample:
    lights = F.normalize(torch.tensor([[[0.0, 0, 1], [1, 0, 1]]]), dim=-1)
    cosines = (lights[0] @ NORMAL).clamp_min(0)
    weights = torch.linspace(0, 0.3, 12)[None, :, None].expand(-1, -1, 3)
    own = 0.4 * float(((RIG @ NORMAL).clamp_min(0) * weights[0, :, 0]).sum())
    shares = torch.zeros(1, 14, SIDE, SIDE)
    shares[:, class_index("skin"), :, : SIDE // 2] = 1
    shares[:, 0, :, SIDE // 2 :] = 1  # the right half is background
    targets = 0.4 * cosines.view(1, 2, 1, 1, 1).expand(1, 2, 3, SIDE, SIDE)
    return PortraitSample(
        inputs=PortraitInputs(
            *(whole(own), shares, whole(NORMAL), whole(0, 1), whole(1, 1), whole(0, 16), whole(1, 1)),
        ),
        lights=lights,
        visible=torch.ones(1, 2, SIDE // 2, SIDE // 2),
        targets=targets,
        rig=RIG[None],
        rig_visible=torch.ones(1, 12, SIDE // 2, SIDE // 2),
        weights=weights,
        original=whole(own),
        albedo=whole(0.4),
        true_normals=whole(NORMAL),
        shares=shares,
        labelled=torch.ones(1),
    )


class Portraits:
    """A bank of one fixed sample; its squares have two sides."""

    provenance: dict[str, Any] = {"licence": "MIT"}  # noqa: RUF012

    def __init__(self) -> None:
        self.asked: list[int | None] = []

    def people(self, held_out: int) -> tuple[list[int], list[int]]:
        return [1], [0]

    def sides_px(self, people: Sequence[int]) -> list[int]:
        return [SIDE, 2 * SIDE]

    def draw(
        self, people: Sequence[int], targets: int, generator: torch.Generator, side_px: int | None = None
    ) -> PortraitSample:
        self.asked.append(side_px)
        return truth()
