"""Images in strips of rows, so that what is computed from a large photo takes little memory at a time."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

STRIP_PX = 1 << 18  # pixels of a strip, about
_MULTIPLE = 32  # rows: EXR files are compressed by 16 or 32 at a time


class Rows(Protocol):
    """An image [H, W] or [H, W, C] that is read by rows: an array, or one that is computed as it is read."""

    @property
    def shape(self) -> tuple[int, ...]:
        """The image's shape."""

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        """Some rows [h, W, ...] of it."""


@dataclass(frozen=True, eq=False)
class Computed:
    """An image whose rows are computed when they are read."""

    shape: tuple[int, ...]
    of: Callable[[slice], np.ndarray]

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        start, stop, _ = rows.indices(self.shape[0])
        return self.of(slice(start, stop))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """All rows, for numpy."""
        return whole(self).astype(dtype or np.float32, copy=False)


def strips(shape: Sequence[int], strip_px: int | None = None) -> Iterator[slice]:
    """Yield slices of rows that cover an image [H, W, ...]."""
    height, width = shape[:2]
    step = max(_MULTIPLE, (strip_px or STRIP_PX) // max(1, width) // _MULTIPLE * _MULTIPLE)
    for first in range(0, height, step):
        yield slice(first, min(height, first + step))


def whole(rows: Rows) -> np.ndarray:
    """All rows of an image as an array."""
    if isinstance(rows, np.ndarray):
        return rows
    found = np.empty(rows.shape, np.float32)
    for some in strips(rows.shape):
        found[some] = rows[some]
    return found


def block_means(image: np.ndarray, block: int) -> np.ndarray:
    """Means [H / block, W / block, C] float32 of blocks of an image [H, W, C], with no float copy of it."""
    height, width = (length // block for length in image.shape[:2])
    total = np.zeros((height, width, *image.shape[2:]), np.float32)
    for row in range(block):
        for column in range(block):
            total += image[row::block, column::block][:height, :width]
    return total / np.float32(block**2)


def enlarged(maps: np.ndarray, size: tuple[int, ...], rows: slice = slice(None)) -> np.ndarray:
    """Maps [C, h, w] at another size [C, H, W], or some rows of that."""
    above, below, share = between(np.arange(size[0])[rows], maps.shape[1], size[0])
    tall = maps[:, above] + share[:, None] * (maps[:, below] - maps[:, above])
    tensor: Tensor = torch.from_numpy(np.ascontiguousarray(tall, np.float32))[None]
    wide = F.interpolate(tensor, size=(len(share), size[1]), mode="bilinear", align_corners=False)
    return np.asarray(wide[0].numpy())


def between(at: np.ndarray, small: int, large: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Neighbours of large pixels among small ones, and the weight of the second one."""
    place = ((at + 0.5) * (small / large) - 0.5).clip(0, small - 1)
    first = place.astype(np.int64)
    return first, (first + 1).clip(max=small - 1), (place - first).astype(np.float32)
