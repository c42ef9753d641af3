"""Stage `appearance-features`: V_f learns who is shown in a crop, and where a single light comes from.

It stands in for ImageNet's VGG-16 in the paper's loss L_I where its weights cannot be had. Both tasks need
what an image loss should compare: shapes of features, skin, shading, shadows and highlights.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.dataset.crops import CropPairs, open_pairs, spread_pairs
from facerf_cli.dataset.dataset import Dataset, provenance_of
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.network.appearance_network import AppearanceNetwork
from facerf_cli.training.objective import Objective, Validation, concatenate


@dataclass(frozen=True)
class AppearanceObjectiveSettings:
    """Held-out pairs of people that are not trained on, and training pairs that are left out."""

    held_out_pairs: int = 48
    every: int = 10  # of the training pairs, one is left out to measure the people


class AppearanceObjective(Objective):
    """Cross-entropy over the people of both crops of a pair, and 1 - cosine to the target's light."""

    def __init__(
        self,
        dataset: Dataset,
        model: MorphableModel,
        network: AppearanceNetwork,
        settings: AppearanceObjectiveSettings = AppearanceObjectiveSettings(),
    ) -> None:
        super().__init__()
        self.networks = nn.ModuleDict({"appearance_features": network})
        self.chooses_by = "angle_deg"
        self.provenance = provenance_of(dataset, model)
        pairs = open_pairs(dataset, "train", network.settings.side)
        kept = [pair for place, pair in enumerate(pairs.pairs) if place % settings.every]
        self._train = pairs.of(kept)
        self._left_out = pairs.of(pairs.pairs[:: settings.every])
        self._held_out = open_pairs(dataset, "validation", network.settings.side)
        self.settings = settings
        self._validation: tuple[CropPairs, CropPairs] | None = None

    def draw(self, count: int, generator_of: Callable[[int], torch.Generator], step: int) -> CropPairs:
        """Draw `count` pairs, sample i from `generator_of(i)` alone."""
        return concatenate([self._train.draw(generator_of(i)) for i in range(count)])

    def forward(self, batch: CropPairs) -> dict[str, Tensor]:
        """Compute the terms `people` and `light`, means over images."""
        with self.mixed_precision():
            scores, lights = self._found(batch)
        people = torch.cat([batch.people, batch.people])
        return {
            "people": F.cross_entropy(scores, people),
            "light": 1 - (lights[len(batch.light) :] * batch.light).sum(-1).mean(),
        }

    def _found(self, batch: CropPairs) -> tuple[Tensor, Tensor]:
        network = self.networks["appearance_features"]
        scores, lights = network(torch.cat([batch.source, batch.target]))
        return scores, lights

    @torch.no_grad()
    def validate(self) -> Validation:
        """Measure the angle to the light on held-out people, and the share of known people recognised."""
        if self._validation is None:
            count = self.settings.held_out_pairs
            readers = (self._left_out, self._held_out)
            self._validation = tuple(  # type: ignore[assignment]
                concatenate([reader.read(pair) for pair in spread_pairs(reader, count, lambda pair: True)])
                for reader in readers
            )
        assert self._validation
        device = next(self.networks.parameters()).device
        known, strangers = (batch.to(device) for batch in self._validation)
        scores, _ = self._found(known)
        right = scores.argmax(1) == torch.cat([known.people, known.people])
        _, lights = self._found(strangers)
        cosines = (lights[len(strangers.light) :] * strangers.light).sum(-1).double().clamp(-1, 1)
        metrics = {
            "angle_deg": float(torch.rad2deg(cosines.acos()).mean()),
            "recognised": float(right.double().mean()),
        }
        return Validation(metrics, None)
