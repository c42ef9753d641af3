"""Stage `parsing`: the Parsing Network, on crops of synthetic portraits.

The classes' loss is a cross-entropy with the matte as a soft target; the matte's loss adds errors of the
matte and of its gradient. A landmark's error is weighted by the error that the network predicts for it (Wood
et al., *3D face reconstruction with dense landmarks*, 2022, Eq. 1).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.topology import OUTER_EYE_CORNERS
from facerf_cli.image.colour import srgb_to_linear
from facerf_cli.network.batch import concatenate
from facerf_cli.network.parsing import Parsing, ParsingNetwork
from facerf_cli.portrait.parse import CLASSES
from facerf_cli.synth.bank.parsing_crops import ParsingCrops, ParsingPhotos
from facerf_cli.training.objective import (
    FOUND_COLOUR,
    TRUE_COLOUR,
    Objective,
    PeopleObjective,
    Validation,
    in_rows,
    mark,
    tiled,
)
from facerf_cli.training.run import Run

_SHEET_ROWS, _SHEET_COLUMNS = 6, 4
_RARE = ("brows", "eyes", "lips", "mouth", "beard", "ears", "glasses", "headwear", "hand")
_LEAST_EYES = 0.03  # lower bound of the distance of the eyes, in sides of the crop


@dataclass(frozen=True)
class ParsingObjectiveSettings:
    """Weights of the terms, and the held-out people and draws of each for validation."""

    classes: float = 1.0
    rare: float = 2.0  # weight of a pixel of small classes, relative to others
    matte: float = 1.0
    landmarks: float = 0.15  # of their negative log-likelihood
    distance: float = 12.0  # of their distance, in sides
    presence: float = 0.1
    held_out_people: int = 12
    held_out_draws: int = 12


class ParsingObjective(PeopleObjective):
    """Errors of classes, matte, landmarks and presence on synthetic portraits."""

    chooses_by, validation_seed = "total", 20212
    rarity: Tensor

    def __init__(
        self,
        portraits: ParsingPhotos,
        network: ParsingNetwork | None = None,
        settings: ParsingObjectiveSettings = ParsingObjectiveSettings(),
    ) -> None:
        network = network or ParsingNetwork()
        super().__init__("parsing", network, portraits, settings)
        self.side = network.side
        rarity = [settings.rare if name in _RARE else 1.0 for name in CLASSES]
        self.register_buffer("rarity", torch.tensor(rarity), persistent=False)

    def draw_one(self, generator: torch.Generator) -> ParsingCrops:
        return self._draw(self.people, generator)

    def draw_person(self, person: int, generator: torch.Generator) -> ParsingCrops:
        return self._draw([person], generator)

    def _draw(self, people: Sequence[int], generator: torch.Generator) -> ParsingCrops:
        """Draw a crop of one of the people."""
        crops: ParsingCrops = self.source.draw(people, self.side, generator)
        return crops

    def forward(self, batch: ParsingCrops) -> dict[str, Tensor]:
        """Compute the weighted terms, each a mean over crops."""
        with self.mixed_precision():
            parsing: Parsing = self.network(batch.crops)
        settings = self.settings
        log_share = parsing.logits.float().log_softmax(1)
        covered = self.rarity[batch.label] * log_share.gather(1, batch.label[:, None])[:, 0]
        entropy = -(batch.alpha * covered + (1 - batch.alpha) * log_share[:, 0])
        matte = 1 - log_share[:, 0].exp()
        off = (matte - batch.alpha) * batch.weight
        edges = off.diff(dim=1).abs().mean() + off.diff(dim=2).abs().mean()
        distance = (parsing.landmarks - batch.landmarks).norm(dim=-1)
        log_error = parsing.log_error.clamp(-7, 1)
        likelihood = distance * (-log_error).exp() + 2 * log_error
        known = batch.known.float() * batch.present[:, None]
        count = known.sum().clamp_min(1)
        presence = F.binary_cross_entropy_with_logits(parsing.presence, batch.present)
        return {
            "classes": settings.classes * (entropy * batch.weight).mean(),
            "matte": settings.matte * (off.abs().mean() + edges),
            "landmarks": settings.landmarks * (likelihood * known).sum() / count,
            "distance": settings.distance * (distance * known).sum() / count,
            "presence": settings.presence * presence,
        }

    @torch.no_grad()
    def validate(self) -> Validation:
        """Measure held-out people: IoU by class, error of the matte, landmarks in inter-ocular distances."""
        batch = concatenate(self.held_out_samples()).to(self.device)
        parts = [self.network(crops) for crops in torch.split(batch.crops, 16)]
        parsing = Parsing(*(torch.cat(part) for part in zip(*parts, strict=True)))
        label = torch.where(batch.alpha >= 0.5, batch.label, 0)
        chosen, counted = parsing.logits.argmax(1), batch.weight > 0
        overlap = {}
        for index, name in enumerate(CLASSES):
            either = ((label == index) | (chosen == index)) & counted
            both = (label == index) & (chosen == index) & counted
            if (label == index).any():
                overlap[f"iou_{name}"] = float(both.sum() / either.sum())
        left, right = OUTER_EYE_CORNERS
        eyes = (batch.landmarks[:, left] - batch.landmarks[:, right]).norm(dim=-1).clamp_min(_LEAST_EYES)
        percent = 100 * (parsing.landmarks - batch.landmarks).norm(dim=-1) / eyes[:, None]
        known = batch.known & (batch.present > 0)[:, None]
        whole = known[:, :68].all(1)
        matte = ((1 - parsing.classes[:, 0]) - batch.alpha).abs()[counted].mean()
        metrics = {
            "mean_iou": float(np.mean(list(overlap.values()))),
            "matte_error": float(matte),
            "landmarks_percent": float(percent[:, :68][whole].median(1).values.mean()),
            "more_percent": float(percent[:, 68:][whole][known[whole, 68:]].median()),
            "presence_wrong": float(((parsing.presence > 0) != (batch.present > 0)).float().mean()),
            **overlap,
        }
        metrics["total"] = 1 - metrics["mean_iou"] + metrics["landmarks_percent"] / 20
        return Validation(metrics, self._sheet(batch, parsing))

    def _sheet(self, batch: ParsingCrops, parsing: Parsing) -> np.ndarray:
        """Draw held-out crops with true (green) and predicted (red) landmarks, and predicted classes."""
        palette = torch.from_numpy(np.random.default_rng(2).uniform(0.15, 1, (len(CLASSES), 3))).float()
        palette[0] = 0
        count, side = min(_SHEET_ROWS * _SHEET_COLUMNS, len(batch.crops)), batch.crops.shape[-1]
        cells = []
        for index in range(count):
            image, known = batch.crops[index].cpu().clone(), batch.known[index]
            mark(image, batch.landmarks[index][known].cpu() * side, TRUE_COLOUR)
            mark(image, parsing.landmarks[index][known].cpu() * side, FOUND_COLOUR)
            shares = parsing.classes[index].permute(1, 2, 0).cpu()
            cells.append(torch.cat([image, (shares @ palette).permute(2, 0, 1)], 2))
        return np.asarray(srgb_to_linear(tiled(in_rows(cells, _SHEET_COLUMNS))))


def build(run: Run) -> Objective:
    """Make the objective of the stage; bake synthetic people that are missing."""
    held_out = run.sizes.held_out_people
    folder, provenance = run.bake_people(held_out, with_squares=False)
    stored = ParsingPhotos(folder, run.backgrounds(run.bank), provenance)
    settings = ParsingObjectiveSettings(held_out_people=held_out)
    objective: Objective = run.objective(ParsingObjective)(stored, run.network("parsing"), settings)
    return objective
