"""Subjects of a prepared dataset under envmaps (paper, 'Dataset'): weighted sums of their OLAT stacks.

A channel at a time, weights [M, L] are multiplied with a stack [L, P] in tiles of constant shape:
`TILE_IMAGES` images (the last tile is padded with zeros) by a number of whole rows that depends on the
image's size and the number of lights alone. So an image's bits depend neither on how many others are made
with it nor on the memory limit.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair, image_path
from facerf_cli.dataset.weights import pair_weights
from facerf_cli.errors import InputError
from facerf_cli.files.documents import checked
from facerf_cli.files.images import HALF_MAX, write_exr
from facerf_cli.files.olat_stack import read_olat_header, read_olats
from facerf_cli.logs import attributes_of_sum
from facerf_cli.workers import one_thread

TILE_IMAGES = 128
DEFAULT_MEMORY_BYTES = 2 << 30
# A tile has at most so many pixels, and so many lights times pixels, held three times over as float32.
_TILE_PX = 1 << 13
_TILE_VALUES = 1 << 22


def relight_subject(
    dataset: Dataset,
    pairs: list[Pair],
    weights: np.ndarray,
    memory_bytes: int = DEFAULT_MEMORY_BYTES,
    overwrite: bool = False,
) -> int:
    """Write the missing sources of a subject's pairs, with weights [rows, L, 3]; return how many."""
    todo = [row for row, pair in enumerate(pairs) if overwrite or not image_path(dataset, *pair.key).exists()]
    for camera in sorted({pairs[row].source_camera for row in todo}):
        rows = [row for row in todo if pairs[row].source_camera == camera]
        path = dataset.stack_path(pairs[rows[0]].subject, camera)
        images = relit_images(path, torch.from_numpy(np.array(weights[rows])), memory_bytes)
        attributes = attributes_of_sum(read_olat_header(path).metadata)
        for row, image in zip(rows, images, strict=True):
            pixels = image.permute(1, 2, 0).float().numpy()
            recipe = {f"facerf:{name}": value for name, value in asdict(pairs[row]).items()}
            write_exr(image_path(dataset, *pairs[row].key), pixels, metadata=attributes | recipe)
    return len(todo)


def render_source(dataset: Dataset, row: Pair | Mapping[str, Any]) -> Tensor:
    """Render the source [3, H, W] float16 of a line of pairs.jsonl from the dataset and the envmap alone.

    The result equals the file that `relight-dataset` writes, bit for bit.
    """
    pair = row if isinstance(row, Pair) else checked(Pair, row, "a line of pairs")
    weights = pair_weights(dataset, pair)
    return next(relit_images(dataset.stack_path(pair.subject, pair.source_camera), weights[None]))


def relit_images(path: Path, weights: Tensor, memory_bytes: int = DEFAULT_MEMORY_BYTES) -> Iterator[Tensor]:
    """Yield the images [3, H, W] float16 of a stack under weights [M, L, 3], in order, on one thread.

    Half of the memory holds the stack, or a strip of its rows, and a quarter the current batch of images. A
    stack that fits is read once, otherwise once a batch.
    """
    header = read_olat_header(path)
    (height, width), lights = header.seen.shape, len(header.directions)
    if weights.shape[1] != lights:
        raise InputError(
            f"{path}: {lights} lights, the dataset has {weights.shape[1]}; run prepare-dataset again"
        )
    rows = _strip_rows(lights, height, width, memory_bytes // 2)
    whole = read_olats(path) if rows >= height else None
    batch = max(1, memory_bytes // (4 * 6 * height * width))
    batch = batch if batch < TILE_IMAGES else batch // TILE_IMAGES * TILE_IMAGES
    for part in torch.split(weights, batch):
        images = torch.empty(len(part), 3, height, width, dtype=torch.float16)
        for first in range(0, height, rows):
            strip = slice(first, min(first + rows, height))
            multiply(read_olats(path, rows=strip) if whole is None else whole, part, images[:, :, strip])
        yield from images


def multiply(olats: Tensor, weights: Tensor, images: Tensor) -> None:
    """Fill images [M, 3, h, W] with OLATs [L, 3, h, W] under weights [M, L, 3]; float16 but the weights."""
    lights, _, height, width = olats.shape
    rows = _tile_rows(lights, width)
    blocks = torch.split(weights.permute(2, 0, 1), TILE_IMAGES, dim=1)  # [3, m, L]
    padded = [torch.nn.functional.pad(block, (0, 0, 0, TILE_IMAGES - block.shape[1])) for block in blocks]
    with one_thread():
        for first in range(0, height, rows):
            part = olats[:, :, first : first + rows]
            tile = part.permute(1, 0, 2, 3).reshape(3, lights, -1).float()
            for block, out in zip(padded, torch.split(images, TILE_IMAGES), strict=True):
                lit = torch.bmm(block, tile).clamp_(-HALF_MAX, HALF_MAX).transpose(0, 1)[: len(out)]
                out[:, :, first : first + rows] = lit.reshape(len(out), 3, -1, width)


def _tile_rows(lights: int, width: int) -> int:
    """Rows of a tile, a power of two."""
    return _power_of_two(min(_TILE_PX, _TILE_VALUES // lights) // width)


def _strip_rows(lights: int, height: int, width: int, memory_bytes: int) -> int:
    """Rows of a stack in memory at once: all, or as many whole tiles and compressed blocks as fit."""
    rows = memory_bytes // (6 * lights * width)
    return height if rows >= height else max(_power_of_two(rows), _tile_rows(lights, width))


def _power_of_two(number: int) -> int:
    """Largest power of two up to a number, at least 1."""
    return 1 << max(0, number.bit_length() - 1)
