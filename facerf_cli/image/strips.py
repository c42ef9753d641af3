"""Resampling, and processing of images in strips of rows, which limits the memory of large photos."""

import logging
import mmap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.run.threads import in_threads

log = logging.getLogger(LOGGER_NAME)
STRIP_PX = 1 << 18  # approximate pixels per strip
_AT_ONCE, _BUDGET = 4, 1 << 28  # most strips in parallel, and bytes of memory per strip
_HALF_MAX = float(np.finfo(np.float16).max)
_MULTIPLE = 32  # rows: EXR compresses 16 or 32 rows at a time

Empty = Callable[[str, tuple[int, ...]], np.ndarray]  # creates the array of a layer from its name and shape


class Rows(Protocol):
    """Image [H, W, ...] that provides rows: an array, or an object that computes them."""

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        """Return rows [h, W, ...]."""


@dataclass(frozen=True, eq=False)
class Scaled:
    """Image [H, W, C] times a factor, or one per channel [C]."""

    image: Rows
    factor: np.ndarray | np.float32

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        return np.asarray(self.image[rows] * self.factor)


class Window(NamedTuple):
    """Rows and columns of an image; indexes its array [H, W, ...]."""

    rows: slice
    columns: slice

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    def common(self, other: "Window") -> "Window":
        """Return the intersection with another window, which may be empty."""
        starts = [max(a.start, b.start) for a, b in zip(self, other, strict=True)]
        stops = [min(a.stop, b.stop) for a, b in zip(self, other, strict=True)]
        return Window(*(slice(start, max(start, stop)) for start, stop in zip(starts, stops, strict=True)))

    def inside(self, other: "Window") -> "Window":
        """Return the window relative to the first row and column of another window."""
        return Window(*(slice(a.start - b.start, a.stop - b.start) for a, b in zip(self, other, strict=True)))

    def framed(self, values: np.ndarray, part: "Window") -> np.ndarray:
        """Return an array of the window with values [h, w, ...] in a part of it, and 0 elsewhere."""
        if part == self:
            return values
        framed = np.zeros((*self.shape, *values.shape[2:]), np.float32)
        framed[part.inside(self)] = values
        return framed


def strips(shape: Sequence[int], strip_px: int | None = None) -> Iterator[slice]:
    """Yield slices of rows that cover an image [H, W, ...]."""
    height, width = shape[:2]
    step = max(_MULTIPLE, (strip_px or STRIP_PX) // max(1, width) // _MULTIPLE * _MULTIPLE)
    for first in range(0, height, step):
        yield slice(first, min(height, first + step))


def new_array(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array in memory; see `Empty`."""
    return np.empty(shape, np.float32)


def in_strips(
    render: Callable[[slice], Mapping[str, np.ndarray]],
    height_px: int,
    width_px: int,
    empty: Empty = new_array,
) -> dict[str, np.ndarray]:
    """Call `render` for strips of rows in threads; return its layers [H, W, ...] by name."""
    layers: dict[str, np.ndarray] = {}
    clamped, at_once = 0, max(1, min(_AT_ONCE, memory.left_bytes() // _BUDGET))
    every = list(strips((height_px, width_px)))
    for rows, parts in zip(every, in_threads(render, every, at_once), strict=True):
        for name, values in parts.items():
            if name not in layers:
                layers[name] = empty(name, (height_px, *values.shape[1:]))
            if layers[name].dtype == np.float16:
                clamped += int(np.count_nonzero(np.abs(values) > _HALF_MAX))
                values = values.clip(-_HALF_MAX, _HALF_MAX)
            layers[name][rows] = values
            release(layers[name])
    if clamped:
        log.warning("%d values beyond the range of half floats are clamped to %g", clamped, _HALF_MAX)
    return layers


def rows_of(array: np.ndarray, rows: slice) -> np.ndarray:
    """Return rows of an array; a copy of a memory-mapped one, whose pages are then released."""
    if not isinstance(array, np.memmap):
        return array[rows]
    values = np.array(array[rows])
    release(array)
    return values


def release(array: np.ndarray) -> None:
    """Drop a memory-mapped array's pages from memory; other arrays are unchanged."""
    if isinstance(array, np.memmap) and hasattr(mmap, "MADV_DONTNEED"):
        array._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]


def block_means(image: np.ndarray, block: int) -> np.ndarray:
    """Return means [H / block, W / block, C] float32 of blocks of [H, W, C], without a float copy of it."""
    height, width = (length // block for length in image.shape[:2])
    tall = np.zeros((height, width * block, *image.shape[2:]), np.float32)
    for row in range(block):
        tall += image[row::block][:height, : width * block]
    total = np.zeros((height, width, *image.shape[2:]), np.float32)
    for column in range(block):
        total += tall[:, column::block]
    return total / np.float32(block**2)


def box_means(image: np.ndarray, reach: int) -> np.ndarray:
    """Return means of an image [H, W, ...] over squares of 2 reach + 1 pixels; the border is repeated.

    Sums over 1, 2, 4, ... pixels, which are added by the binary digits of the span, are several times as fast
    as running sums.
    """
    span = 2 * reach + 1
    total = np.pad(image, [(reach, reach)] * 2 + [(0, 0)] * (image.ndim - 2), mode="edge")
    for length in image.shape[:2]:
        summed, width, parts, done = total, 1, list[np.ndarray](), 0
        while width <= span:
            if span & width:
                parts.append(summed[done : done + length])
                done += width
            summed, width = summed[:-width] + summed[width:], 2 * width
        total = np.asarray(sum(parts)).swapaxes(0, 1)
    return total / np.float32(span**2)


def enlarged(maps: np.ndarray, size: tuple[int, ...], rows: slice = slice(None)) -> np.ndarray:
    """Upsample maps [C, h, w] to [C, H, W], or to some of its rows."""
    above, below, weight = between(np.arange(size[0])[rows], maps.shape[1], size[0])
    tall = maps[:, above] + weight[:, None] * (maps[:, below] - maps[:, above])
    tensor: Tensor = torch.from_numpy(np.ascontiguousarray(tall, np.float32))[None]
    wide = F.interpolate(tensor, size=(len(weight), size[1]), mode="bilinear", align_corners=False)
    return np.asarray(wide[0].numpy())


def between(at: np.ndarray, small: int, large: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the two source rows of each target row in bilinear interpolation, and the second's weight."""
    position = ((at + 0.5) * (small / large) - 0.5).clip(0, small - 1)
    first = position.astype(np.int64)
    return first, (first + 1).clip(max=small - 1), (position - first).astype(np.float32)


def resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resample an image [H, W, C] or [H, W], with antialiasing where it becomes smaller."""
    planes = torch.from_numpy(np.ascontiguousarray(image, np.float32))
    planes = planes[None] if planes.ndim == 2 else planes.permute(2, 0, 1)
    sized = F.interpolate(planes[None], (height, width), mode="bilinear", align_corners=False, antialias=True)
    plain = sized[0].permute(1, 2, 0).numpy()
    return np.ascontiguousarray(plain[..., 0] if image.ndim == 2 else plain)


def covering(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Scale an image [H, W, C] to cover a frame, and crop its centre."""
    scale = max(height / image.shape[0], width / image.shape[1])
    rows, columns = (
        min(side, round(target / scale)) for side, target in zip(image.shape, (height, width), strict=False)
    )
    top, left = (image.shape[0] - rows) // 2, (image.shape[1] - columns) // 2
    part = torch.from_numpy(image[top : top + rows, left : left + columns]).permute(2, 0, 1)[None]
    shrinks = scale < 1
    sized = F.interpolate(part, (height, width), mode="bilinear", align_corners=False, antialias=shrinks)
    covered: np.ndarray = sized[0].permute(1, 2, 0).numpy()
    return covered


@dataclass(frozen=True, eq=False)
class SumOf:
    """The sum [H, W, 3] of layers over black, computed by rows and divided by alpha [H, W]."""

    layers: Sequence[np.ndarray]
    width_px: int
    alpha: np.ndarray | None

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        total = np.zeros((rows.stop - rows.start, self.width_px, 3), np.float32)
        for layer in self.layers:
            total += rows_of(layer, rows)
        return total if self.alpha is None else total / np.maximum(self.alpha[rows], 1e-3)[..., None]


class Resized:
    """`resized` by rows; when it enlarges, rows are computed on access."""

    def __init__(self, image: np.ndarray, size: tuple[int, int]) -> None:
        self._size, self._rest = size, image.shape[2:]
        self._small = resized(image, *size) if size[0] < image.shape[0] or size[1] < image.shape[1] else None
        self._maps = np.moveaxis(image.reshape(*image.shape[:2], -1), -1, 0)

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        """Return rows [h, W, ...]."""
        if self._small is not None:
            return self._small[rows]
        return np.moveaxis(enlarged(self._maps, self._size, rows), 0, -1).reshape(
            -1, self._size[1], *self._rest
        )


def fitted(height: int, width: int, most_px: float) -> tuple[int, int]:
    """Return the size of a frame reduced so that its longer side is at most `most_px`."""
    scale = min(1.0, most_px / max(height, width))
    return max(1, round(height * scale)), max(1, round(width * scale))
