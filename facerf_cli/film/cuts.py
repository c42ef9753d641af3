"""Cuts: frames that differ from the one before far more than the frames around them do from theirs.

A frame is compared with the one before as a thumbnail, so that grain does not count. Fast movement raises the
changes of all frames around, and so does a flash, whose light comes and goes: neither is a cut. A light that
is switched on is one. A fade from shot to shot is not found.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
import torch
import torch.nn.functional as F

_ROWS, _COLUMNS = 12, 16  # of a thumbnail
_LEAST = 0.05  # change at a cut, display values in 0..1
_TIMES = 3.0  # of the largest change around it
_REACH = 3  # frames on each side


class CutFinder:
    """Cuts of a film of `count` frames; `show` gives a frame, sRGB uint8 [H, W, 3], by number."""

    def __init__(self, count: int, show: Callable[[int], np.ndarray]) -> None:
        self._count = count
        self._small = lru_cache(2)(lambda frame: thumbnail(show(frame)))
        self._change = lru_cache(4 * _REACH)(self._changed)

    def is_cut(self, frame: int) -> bool:
        """Tell if a new shot begins with a frame."""
        if frame == 0:
            return False
        around = range(max(1, frame - _REACH), min(self._count, frame + _REACH + 1))
        changes = {one: self._change(one) for one in around}
        return stands_out(changes.pop(frame), list(changes.values()))

    def _changed(self, frame: int) -> float:
        before, now = self._small(frame - 1), self._small(frame)
        return float(np.abs(now - before).mean())


def stands_out(change: float, around: Sequence[float]) -> bool:
    """Tell if a change is that of a cut, among the changes of the frames around it."""
    return change > max(_LEAST, _TIMES * max(around, default=0.0))


def thumbnail(image_srgb: np.ndarray) -> np.ndarray:
    """Means [_ROWS, _COLUMNS, 3] in 0..1 of parts of an image, uint8 [H, W, 3]."""
    pixels = torch.from_numpy(image_srgb).permute(2, 0, 1)[None].float() / 255
    return F.adaptive_avg_pool2d(pixels, (_ROWS, _COLUMNS))[0].permute(1, 2, 0).numpy()


def takes(count: int, cuts: Sequence[int]) -> list[range]:
    """The frames of each take of a film of `count` frames, in order; cuts are first frames of takes."""
    edges = [0, *cuts, count]
    return [range(first, end) for first, end in pairwise(edges)]
