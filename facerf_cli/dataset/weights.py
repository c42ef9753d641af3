"""Weights of a dataset's lights under envmaps, and OLAT stacks summed with them (paper, 'Dataset').

**The frame of an envmap.** A stack's lights are in its crop's camera space, d_crop = R_fit R_world_to_head
d_world, so their directions differ between cameras although the lights do not move. An envmap must not move
either: its weights are computed once, for the lights' world directions, and serve all cameras and subjects.
In a camera's space, this is the envmap rotated by R_fit R_world_to_head. `rotate_deg` rotates the envmap
about the world's vertical. Captures choose their own axes, so `world_to_map` derives them from the heads: the
world axis nearest to their up becomes the envmap's y, the one nearest to their gaze its z.

**Tiles.** For each channel, weights [M, L] are multiplied with a stack [L, P] in tiles of constant shape:
`TILE_IMAGES` images (the last tile is padded with zeros) by a number of complete rows that depends only on
the image's size and the number of lights. Therefore an image's bits do not depend on the number of images
made together.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.dataset.dataset import PREPARE_AGAIN, Dataset
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.light_files import read_map_file
from facerf_cli.files.olat_stack import read_olat_header, read_olats
from facerf_cli.files.write import HALF_MAX
from facerf_cli.light.envmap import rotated_weights, texel_integrals
from facerf_cli.run import memory
from facerf_cli.run.workers import one_thread
from facerf_cli.synth.sky.skies import ProceduralMaps, draw_sky

_MOST_MAPS = 1_000_000
_HEADS_AVERAGED = 16  # enough to find the vertical
_PROCEDURAL = re.compile(r"procedural:(\d{1,9}):(\d+):([1-9]\d{0,3})")  # index, seed, width


@dataclass(frozen=True, eq=False)
class EnvmapTask:
    """Envmap, rotations, and lights to compute weights for."""

    name: str
    directions: Tensor  # [L, 3] of the whole rig in the envmap's axes, from `map_directions`
    rotations_deg: tuple[float, ...]
    lights: tuple[tuple[int, ...], ...]  # the rig's lights used at each rotation


@dataclass(frozen=True, eq=False)
class EnvmapWeights:
    """Weights of the lights under an envmap at R rotations, times 2 to the power of `exposure_ev`."""

    weights: np.ndarray  # [R, L, 3]; a row with fewer lights starts with theirs, in order, then zeros
    exposure_ev: int


EnvmapResult = EnvmapWeights | str  # or what is wrong with the envmap
# Calls a function on many items, in order, as `map` does: in processes, or with a progress bar.
Spread = Callable[[Callable[[EnvmapTask], EnvmapResult], Sequence[EnvmapTask]], Iterable[EnvmapResult]]


def envmap_names(maps: Sequence[Path] | ProceduralMaps) -> list[str]:
    """Return the names of envmaps in pairs: absolute paths, or procedural:INDEX:SEED:WIDTH."""
    if len(maps) > _MOST_MAPS:
        raise UsageError(f"--envmaps: {len(maps)} maps; use at most {_MOST_MAPS}")
    if isinstance(maps, ProceduralMaps):
        return [f"procedural:{index}:{maps.seed}:{maps.width_px}" for index in range(len(maps))]
    return [str(path.absolute()) for path in maps]


def read_envmap(name: str) -> Tensor:
    """Read the lat-long map [H, W, 3] of a pair, scene-linear; raise InputError if it is invalid."""
    if drawn := _PROCEDURAL.fullmatch(name):
        return torch.from_numpy(draw_sky(int(drawn[1]), int(drawn[2]), int(drawn[3]))[0])
    return read_map_file(name)


def compute_weights(task: EnvmapTask) -> EnvmapResult:
    """Compute the weights of an envmap at all its rotations, exposed; return the error's text if it fails."""
    try:
        envmap = read_envmap(task.name)
    except InputError as error:
        return str(error)
    with one_thread():
        mean_radiance = float(texel_integrals(envmap, 1, 1).mean()) / (4 * math.pi)
        if not mean_radiance > 0:
            return f"{task.name}: the map is black; remove it"
        weights = _weights(envmap, task)
    exposure_ev = -round(math.log2(mean_radiance))
    return EnvmapWeights((weights * 2.0**exposure_ev).numpy(), exposure_ev)


def _weights(envmap: Tensor, task: EnvmapTask) -> Tensor:
    """Compute weights [R, L, 3] without exposure, over the cells of each row's lights."""
    weights = torch.zeros(len(task.lights), len(task.directions), 3)
    for chosen in dict.fromkeys(task.lights):
        rows = [row for row, other in enumerate(task.lights) if other == chosen]
        directions = task.directions[list(chosen)]
        turned = rotated_weights(envmap, directions, [task.rotations_deg[row] for row in rows])
        weights[rows, : len(chosen)] = turned
    return weights


def map_directions(dataset: Dataset) -> Tensor:
    """Return the directions [L, 3] of a dataset's lights in the envmaps' axes, float64."""
    return torch.from_numpy(dataset.directions_world @ world_to_map(dataset).T)


def world_to_map(dataset: Dataset) -> np.ndarray:
    """Find the signed permutation [3, 3] of the world's axes that makes y up and z the gaze of faces.

    It is derived from the first heads: a stack's lights and rotation give its head's pose in the world.
    """
    heads = [
        _world_to_head(dataset, subject, cameras[0])
        for subject, cameras in list(dataset.cameras.items())[:_HEADS_AVERAGED]
        if cameras
    ]
    mean = np.mean(heads, 0)
    candidates = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order, signs in product(permutations(range(3)), product((1, -1), repeat=3))
    ]
    proper = [turn for turn in candidates if np.linalg.det(turn) > 0]
    return max(proper, key=lambda turn: 2 * turn[1] @ mean[1] + turn[2] @ mean[2])  # up counts most


def _world_to_head(dataset: Dataset, subject: str, camera: str) -> np.ndarray:
    """Fit the rotation [3, 3] from the lights' world directions to the stack's in the head's frame."""
    path = dataset.stack_path(subject, camera)
    header = read_olat_header(path)
    in_world = dataset.directions_world[list(dataset.lights_of(subject))]
    if len(header.directions) != len(in_world):
        raise InputError(
            f"{path}: {len(header.directions)} lights, the dataset has {len(in_world)}; {PREPARE_AGAIN}"
        )
    in_head = header.directions @ header.rotation
    u, _, vt = np.linalg.svd(in_head.T @ in_world)
    return np.asarray(u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt)


TILE_IMAGES = 128
# Limits of a tile: pixels, and lights times pixels, with three float32 copies of each.
_TILE_PX = 1 << 13
_TILE_VALUES = 1 << 22


def relit_images(path: Path, weights: Tensor) -> Iterator[Tensor]:
    """Yield the images [3, H, W] float16 of a stack under weights [M, L, 3], in order, on one thread.

    The stack must fit into memory. The images that are summed at once take at most half of it.
    """
    olats = read_olats(path)
    lights, _, height, width = olats.shape
    if weights.shape[1] != lights:
        raise InputError(f"{path}: {lights} lights, the dataset has {weights.shape[1]}; {PREPARE_AGAIN}")
    at_once = max(1, min(TILE_IMAGES, memory.left_bytes() // (2 * 6 * height * width)))
    for part in torch.split(weights, at_once):
        images = torch.empty(len(part), 3, height, width, dtype=torch.float16)
        multiply(olats, part, images)
        yield from images


def multiply(olats: Tensor, weights: Tensor, images: Tensor) -> None:
    """Fill images [M, 3, H, W] float16, M <= TILE_IMAGES, with OLATs [L, 3, H, W] float16 under weights."""
    lights, _, height, width = olats.shape
    rows = 1 << max(0, (min(_TILE_PX, _TILE_VALUES // lights) // width).bit_length() - 1)  # a power of two
    missing = TILE_IMAGES - len(weights)
    padded = torch.nn.functional.pad(weights.permute(2, 0, 1), (0, 0, 0, missing))  # [3, TILE_IMAGES, L]
    with one_thread():
        for first in range(0, height, rows):
            part = olats[:, :, first : first + rows]
            tile = part.permute(1, 0, 2, 3).reshape(3, lights, -1).float()
            lit = torch.bmm(padded, tile).clamp_(-HALF_MAX, HALF_MAX).transpose(0, 1)[: len(images)]
            images[:, :, first : first + rows] = lit.reshape(len(images), 3, -1, width)
