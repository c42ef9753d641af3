"""Views of squares as a network could give them, made up for tests."""

from typing import Any

import numpy as np
import torch

from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.parse import CLASSES, LANDMARKS, Square, SquareView, class_index

SIDE = 64


def places() -> tuple[torch.Tensor, torch.Tensor]:
    """Places right and down [S, S] of the pixels of a square, in its sides."""
    at = (torch.arange(SIDE) + 0.5) / SIDE
    y, x = torch.meshgrid(at, at, indexing="ij")
    return x, y


def seen_of(square: Square, regions: dict[str, torch.Tensor]) -> SquareView:
    """A view that gives each region [S, S] bool its class, later ones over earlier, on background."""
    label = torch.zeros(SIDE, SIDE, dtype=torch.long)
    for name, inside in regions.items():
        label[inside] = class_index(name)
    classes = torch.nn.functional.one_hot(label, len(CLASSES)).permute(2, 0, 1).float()
    landmarks = square.to_photo(np.random.default_rng(0).uniform(0.3, 0.7, (LANDMARKS, 2)))
    error_px = np.full(LANDMARKS, 0.01 * square.side_px)
    return SquareView(square, classes.clamp_min(1e-30).log(), landmarks, error_px, presence=1.0)


class _White(torch.nn.Module):
    """In place of MediaPipe's person network: what is white is a person."""

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"share": ((images.mean(1, keepdim=True) - 0.6) * 10).clamp(0, 1)}


class _Nobody(torch.nn.Module):
    """In place of MediaPipe's body network: nobody is seen."""

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        zeros = torch.zeros(1, 1, 256, 256)
        return {"score": torch.zeros(1, 1), "points": torch.zeros(1, 195), "mask": zeros}


def white_people() -> PeopleNetworks:
    """Networks that take what is white for a person; there are none that find faces."""
    none: Any = None
    person: Any = _White()
    body: Any = _Nobody()
    return PeopleNetworks(none, none, none, none, person, body)
