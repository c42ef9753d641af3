"""Draw contact sheets of held-out people, scene-linear."""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

TRUE_COLOUR, FOUND_COLOUR = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)  # of landmarks on sheets


def tiled(rows: Iterable[Iterable[Tensor]]) -> np.ndarray:
    """Join rows of images [3, h, w] into a contact sheet [H, W, 3]."""
    sheet: np.ndarray = torch.cat([torch.cat([*row], -1) for row in rows], -2).permute(1, 2, 0).cpu().numpy()
    return sheet


def in_rows(cells: Sequence[Tensor], columns: int) -> list[Sequence[Tensor]]:
    """Split images into rows of `columns`; a shorter last row is dropped."""
    rows = [cells[first : first + columns] for first in range(0, len(cells), columns)]
    return [row for row in rows if len(row) == len(rows[0])]


def mark(image: Tensor, points_px: Tensor, colour: tuple[float, float, float]) -> None:
    """Draw dots of 2 x 2 pixels at points [N, 2] of an image [3, S, S], in place."""
    for x, y in points_px.long().clamp(0, image.shape[-1] - 2).tolist():
        image[:, y : y + 2, x : x + 2] = torch.tensor(colour).view(3, 1, 1)
