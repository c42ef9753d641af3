"""V_f where ImageNet's weights cannot be had: the trunk of VGG-16 trained on people and lights.

The paper's V_f is VGG-16 trained on ImageNet ('Loss Functions'). This network has the same trunk and is
trained by `training/appearance_objective.py` to tell people apart, and the light on them. A checkpoint says
which of the two V_f is.
"""

from dataclasses import dataclass
from typing import Any, Self

import torch.nn.functional as F
from torch import Tensor

from facerf_cli.network.feature_networks import TrainedFeatures
from facerf_cli.network.settings import Count, Grid, Side, VggWidth, settings_from


@dataclass(frozen=True)
class AppearanceSettings:
    """Number of people, side of the images, and sizes; `width` 1 is the trunk of VGG-16."""

    people: Count
    side: Side = 128
    width: VggWidth = 0.25
    grid: Grid = 8  # side to which conv3_3 is pooled before the head
    hidden: Count = 256


class AppearanceNetwork(TrainedFeatures):
    """Tell who is shown in an image, and where its light comes from."""

    def __init__(self, settings: AppearanceSettings) -> None:
        super().__init__(settings, settings.people + 3)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Scores of the people [B, P] and unit directions toward the light [B, 3], camera space."""
        found = self.regressed(images)
        return found[:, :-3], F.normalize(found[:, -3:], dim=-1)

    @classmethod
    def from_metadata(cls, metadata: dict[str, Any]) -> Self:
        """Make an untrained network; raises KeyError, TypeError or ValueError if the settings make none."""
        return cls(settings_from(AppearanceSettings, metadata))
