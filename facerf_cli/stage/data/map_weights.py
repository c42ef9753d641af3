"""Environment maps as the weights of a dataset's lights.

**In which frame a map stands.** A stack's lights are in its crop's camera space, d_crop = R_fit
R_world_to_head d_world, so they differ from camera to camera although the lamps stay where they are. A map
must stay where it is, too: it is weighed once, over the lamps' directions in the world, and the same weights
serve every camera and every subject. To each camera that is the map turned by R_fit R_world_to_head. A
rotation is one about the world's vertical. Captures name their axes as they like, so `world_to_map` finds the
vertical by the heads: the world's axis that is nearest to their up is the map's y, the one nearest to where
they look is its z.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.olat_stack import read_olat_header
from facerf_cli.light.envmap import rotated_weights, texel_integrals
from facerf_cli.stage.data.dataset import Dataset
from facerf_cli.stage.map_files import read_map_file
from facerf_cli.stage.sky.skies import ProceduralMaps, draw_sky
from facerf_cli.stage.threads import one_thread

_MOST_MAPS = 1_000_000
_HEADS_ASKED = 16  # for the vertical
_PROCEDURAL = re.compile(r"procedural:(\d{1,9}):(\d+):([1-9]\d{0,3})")


def name_maps(maps: Sequence[Path] | ProceduralMaps) -> list[str]:
    """What pairs call the maps by."""
    if len(maps) > _MOST_MAPS:
        raise UsageError(f"--envmaps: {len(maps)} maps are too many; {_MOST_MAPS} are the most")
    if isinstance(maps, ProceduralMaps):
        return [f"procedural:{index}:{maps.seed}:{maps.width_px}" for index in range(len(maps))]
    return [str(path.absolute()) for path in maps]


def read_map(name: str) -> Tensor:
    """The lat-long map [H, W, 3] that a pair names, linear; an InputError says what is wrong with it."""
    if drawn := _PROCEDURAL.fullmatch(name):
        return torch.from_numpy(draw_sky(int(drawn[1]), int(drawn[2]), int(drawn[3]))[0])
    return read_map_file(name)


@dataclass(frozen=True, eq=False)
class MapWork:
    """A map, the lights that it is weighed over, and how it is turned."""

    name: str
    directions: Tensor  # [L, 3] of the whole rig in the map's axes: `map_directions`
    rotations_deg: tuple[float, ...]
    lights: tuple[tuple[int, ...], ...] = ()  # which of the rig's each rotation is weighed over; () all


@dataclass(frozen=True, eq=False)
class MapWeights:
    """The lights' weights under a map that is turned, times 2 to the power of `exposure_ev`."""

    weights: np.ndarray  # [R, L, 3]; with fewer lights theirs come first, in their order, and then zeros
    exposure_ev: int


Weighed = MapWeights | str  # or what is wrong with the map


def weigh_map(work: MapWork) -> Weighed:
    """The weights of one map at all its rotations, exposed, or what is wrong with it."""
    try:
        envmap = read_map(work.name)
    except InputError as error:
        return str(error)
    with one_thread():
        mean = float(texel_integrals(envmap, 1, 1).mean()) / (4 * math.pi)  # of the radiance
        if not mean > 0:
            return f"{work.name}: there is no light in this map"
        weights = _weights(envmap, work)
    exposure_ev = -round(math.log2(mean))
    return MapWeights((weights * 2.0**exposure_ev).numpy(), exposure_ev)


def _weights(envmap: Tensor, work: MapWork) -> Tensor:
    """Weights [R, L, 3], not exposed: the cells are those of the lights that there are."""
    everything = tuple(range(len(work.directions)))
    lights = work.lights or (everything,) * len(work.rotations_deg)
    weights = torch.zeros(len(lights), len(everything), 3)
    for chosen in dict.fromkeys(lights):
        rows = [row for row, other in enumerate(lights) if other == chosen]
        directions = work.directions[list(chosen)]
        turned = rotated_weights(envmap, directions, [work.rotations_deg[row] for row in rows])
        weights[rows, : len(chosen)] = turned
    return weights


def map_directions(dataset: Dataset) -> Tensor:
    """The lights of a dataset [L, 3] in the maps' axes, float64."""
    return torch.from_numpy(dataset.directions_world @ world_to_map(dataset).T)


def world_to_map(dataset: Dataset) -> np.ndarray:
    """The world's axes renamed [3, 3] (a signed permutation), so that y is up and z is where faces look.

    By the first heads of the dataset: a stack's lights and its rotation say how its head stands in the world.
    """
    heads = [
        _world_to_head(dataset, subject, cameras[0])
        for subject, cameras in list(dataset.cameras.items())[:_HEADS_ASKED]
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
    """The rotation [3, 3] that takes the world's lights to a stack's, seen from the head."""
    path = dataset.stack_path(subject, camera)
    header = read_olat_header(path)
    in_world = dataset.directions_world[list(dataset.lights_of(subject))]
    if len(header.directions) != len(in_world):
        raise InputError(
            f"{path}: {len(header.directions)} lights, the dataset has {len(in_world)}; "
            "run prepare-dataset again"
        )
    in_head = header.directions @ header.rotation
    u, _, vt = np.linalg.svd(in_head.T @ in_world)
    return np.asarray(u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt)
