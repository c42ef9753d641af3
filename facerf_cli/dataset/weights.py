"""Weights of a dataset's lights under the envmaps of its pairs; they complete relit/pairs.jsonl.

    relit/weights-KEY.npy   weights of all rows of pairs.jsonl [rows, L, 3] float32; KEY is its digest

A row holds the weights of its subject's lights, padded with zeros where the subject lacks some of the rig's
L. Weights follow from the rows and the envmaps, and are computed again where the file is missing.

**The frame of an envmap.** A stack's lights are in its crop's camera space, d_crop = R_fit R_world_to_head
d_world, so their directions differ between cameras although the lights stay where they are. An envmap must
stay where it is, too: its weights are computed once, for the lights' world directions, and serve every camera
and subject. In a camera's space that is the envmap turned by R_fit R_world_to_head. `rotate_deg` turns the
envmap about the world's vertical. Captures choose their own axes, so `world_to_map` derives them from the
heads: the world axis nearest to their up becomes the envmap's y, the one nearest to their gaze its z.
"""

import logging
import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from itertools import permutations, product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import RELIT, Pair, image_path, pairs_path, read_pairs
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import digest
from facerf_cli.files.light_files import read_map_file
from facerf_cli.files.olat_stack import read_olat_header
from facerf_cli.light.envmap import rotated_weights, texel_integrals
from facerf_cli.logs import LOGGER_NAME, json_line
from facerf_cli.synth.sky.skies import ProceduralMaps, draw_sky
from facerf_cli.workers import one_thread

_MOST_MAPS = 1_000_000
_HEADS_AVERAGED = 16  # enough to find the vertical
_PROCEDURAL = re.compile(r"procedural:(\d{1,9}):(\d+):([1-9]\d{0,3})")  # index, seed, width
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class EnvmapTask:
    """An envmap, its rotations, and the lights whose weights are wanted."""

    name: str
    directions: Tensor  # [L, 3] of the whole rig in the envmap's axes, from `map_directions`
    rotations_deg: tuple[float, ...]
    lights: tuple[tuple[int, ...], ...] = ()  # the rig's lights used at each rotation; () for all


@dataclass(frozen=True, eq=False)
class EnvmapWeights:
    """Weights of the lights under an envmap at R rotations, times 2 to the power of `exposure_ev`."""

    weights: np.ndarray  # [R, L, 3]; a row with fewer lights starts with theirs, in order, then zeros
    exposure_ev: int


EnvmapResult = EnvmapWeights | str  # or what is wrong with the envmap
# Calls a function on many items, in order, as `map` does: in processes, or with a progress bar.
Spread = Callable[[Callable[[EnvmapTask], EnvmapResult], Sequence[EnvmapTask]], Iterable[EnvmapResult]]


def write_pairs(dataset: Dataset, drawn: list[Pair], overwrite: bool, spread: Spread = map) -> list[Pair]:
    """Write pairs.jsonl and the weights of newly drawn pairs; return the pairs with their exposures.

    Existing pairs stay where they agree, so that a larger number adds pairs; every existing image must belong
    to a pair that stays. `overwrite` removes old pairs and images once the new weights are computed.
    """
    if not overwrite:
        old = read_pairs(dataset)
        before = [replace(pair, exposure_ev=0) for pair in old]
        if old and before == drawn and weights_path(dataset).is_file():
            return old
        _require_agreement(dataset, before, drawn)
    weights, pairs = compute_pair_weights(dataset, drawn, spread)
    if overwrite:
        _remove_old(dataset)
    else:
        _require_agreement(dataset, old, pairs)  # now the exposures, too: the envmaps may have changed
    text = "".join(json_line(asdict(pair)) + "\n" for pair in pairs)
    _write_weights(dataset, weights, text.encode())
    with atomic_path(pairs_path(dataset)) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return pairs


def _require_agreement(dataset: Dataset, old: list[Pair], new: list[Pair]) -> None:
    """Raise UsageError where common pairs differ, or an image belongs to no common pair."""
    known = {pair.key: pair for pair in old}
    both = [pair for pair in new if pair.key in known]
    explained = {image_path(dataset, *pair.key) for pair in both}
    if any(known[pair.key] != pair for pair in both) or not explained.issuperset(_images(dataset)):
        raise UsageError(
            f"{dataset.folder / RELIT}: holds images of another seed, other envmaps, another dataset or a "
            "larger --per-subject; give those options again, or --overwrite always"
        )


def _images(dataset: Dataset) -> list[Path]:
    return list((dataset.folder / RELIT).glob("*/[0-9]*.exr"))


def _remove_old(dataset: Dataset) -> None:
    """Delete old pairs, then images, so that a killed run leaves no image that passes for a new pair's."""
    pairs_path(dataset).unlink(missing_ok=True)
    for path in _images(dataset):
        path.unlink()


def weights_path(dataset: Dataset) -> Path:
    """Path of the weights of the present pairs."""
    return _weights_path(dataset, pairs_path(dataset).read_bytes())


def _weights_path(dataset: Dataset, pairs_text: bytes) -> Path:
    return dataset.folder / RELIT / f"weights-{digest(pairs_text)}.npy"


def _write_weights(dataset: Dataset, weights: np.ndarray, pairs_text: bytes) -> None:
    path = _weights_path(dataset, pairs_text)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.save(file, weights)
    for old in path.parent.glob("weights-*.npy"):
        if old != path:
            old.unlink()


def load_pairs(dataset: Dataset) -> dict[str, tuple[list[Pair], np.ndarray]]:
    """Each subject's pairs and their weights [rows, L, 3] float32, memory-mapped; L are the subject's lights.

    Weights include the exposures. Empty where the dataset has no pairs. The result is cached until
    pairs.jsonl changes.
    """
    path = pairs_path(dataset)
    if not path.is_file():
        return {}
    return _load_pairs(_ByFolder(dataset, dataset.folder.absolute()), path.stat().st_mtime_ns)


@dataclass(frozen=True)
class _ByFolder:
    """A dataset as a cache key."""

    dataset: Dataset = field(compare=False)
    folder: Path


@lru_cache(maxsize=1)
def _load_pairs(key: _ByFolder, changed_ns: int) -> dict[str, tuple[list[Pair], np.ndarray]]:
    pairs = read_pairs(key.dataset)
    weights = _load_weights(key.dataset, pairs)
    rows_of: dict[str, list[int]] = defaultdict(list)
    for row, pair in enumerate(pairs):
        rows_of[pair.subject].append(row)
    return {
        subject: (
            pairs[rows[0] : rows[-1] + 1],
            weights[rows[0] : rows[-1] + 1, : len(key.dataset.lights_of(subject))],
        )
        for subject, rows in rows_of.items()
    }


def _load_weights(dataset: Dataset, pairs: list[Pair]) -> np.ndarray:
    path = weights_path(dataset)
    if not path.is_file():
        log.info("%s: missing; computing the weights again", path)
        weights, computed = compute_pair_weights(dataset, pairs)
        if computed != pairs:
            raise InputError(
                f"{pairs_path(dataset)}: the envmaps have changed since the pairs were made; run "
                "relight-dataset with --overwrite always"
            )
        _write_weights(dataset, weights, pairs_path(dataset).read_bytes())
    try:
        weights = np.load(path, mmap_mode="r")
        if weights.shape != (len(pairs), len(dataset.light_ids), 3) or weights.dtype != np.float32:
            raise ValueError(f"shape {weights.shape}")
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: damaged ({error}); delete it to have it computed again") from None
    return weights


def compute_pair_weights(
    dataset: Dataset, pairs: list[Pair], spread: Spread = map
) -> tuple[np.ndarray, list[Pair]]:
    """Compute weights [rows, L, 3] of pairs, and the pairs with exposures; read each envmap once."""
    rows_of: dict[str, list[int]] = defaultdict(list)
    for row, pair in enumerate(pairs):
        rows_of[pair.envmap].append(row)
    directions = map_directions(dataset)
    tasks = [
        EnvmapTask(
            name,
            directions,
            tuple(pairs[row].rotate_deg for row in rows),
            tuple(dataset.lights_of(pairs[row].subject) for row in rows),
        )
        for name, rows in rows_of.items()
    ]
    weights = np.zeros((len(pairs), len(directions), 3), np.float32)
    exposed, complaints = list(pairs), []
    for rows, result in zip(rows_of.values(), spread(compute_weights, tasks), strict=True):
        if isinstance(result, str):
            complaints.append(result)
            continue
        weights[rows] = result.weights
        for row in rows:
            exposed[row] = replace(pairs[row], exposure_ev=result.exposure_ev)
    if complaints:
        for complaint in complaints:
            log.error("%s", complaint)
        raise FacerfError(  # without them, pairs would differ from those of the complete folder
            f"--envmaps: {len(complaints)} of {len(tasks)} maps cannot be used; repair or remove them"
        )
    return weights, exposed


def pair_weights(dataset: Dataset, pair: Pair) -> Tensor:
    """Compute the weights [L, 3] of one pair from its envmap; they equal those of `load_pairs`."""
    lights = dataset.lights_of(pair.subject)
    result = compute_weights(EnvmapTask(pair.envmap, map_directions(dataset), (pair.rotate_deg,), (lights,)))
    if isinstance(result, str):
        raise InputError(result)
    if result.exposure_ev != pair.exposure_ev:
        raise InputError(
            f"{pair.envmap}: the envmap has changed since the pair was made; run relight-dataset with "
            "--overwrite always"
        )
    return torch.from_numpy(result.weights[0, : len(lights)])


def envmap_names(maps: Sequence[Path] | ProceduralMaps) -> list[str]:
    """Names of envmaps, as pairs hold them: absolute paths, or procedural:INDEX:SEED:WIDTH."""
    if len(maps) > _MOST_MAPS:
        raise UsageError(f"--envmaps: {len(maps)} maps; give at most {_MOST_MAPS}")
    if isinstance(maps, ProceduralMaps):
        return [f"procedural:{index}:{maps.seed}:{maps.width_px}" for index in range(len(maps))]
    return [str(path.absolute()) for path in maps]


def read_envmap(name: str) -> Tensor:
    """Read the lat-long map [H, W, 3] of a pair, scene-linear; raise InputError where it is invalid."""
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
    """Weights [R, L, 3] without exposure; the cells are those of the lights that the row has."""
    everything = tuple(range(len(task.directions)))
    lights = task.lights or (everything,) * len(task.rotations_deg)
    weights = torch.zeros(len(lights), len(everything), 3)
    for chosen in dict.fromkeys(lights):
        rows = [row for row, other in enumerate(lights) if other == chosen]
        directions = task.directions[list(chosen)]
        turned = rotated_weights(envmap, directions, [task.rotations_deg[row] for row in rows])
        weights[rows, : len(chosen)] = turned
    return weights


def map_directions(dataset: Dataset) -> Tensor:
    """Directions of a dataset's lights [L, 3] in the envmaps' axes, float64."""
    return torch.from_numpy(dataset.directions_world @ world_to_map(dataset).T)


def world_to_map(dataset: Dataset) -> np.ndarray:
    """Permutation of the world's axes with signs [3, 3] after which y is up and z is where faces look.

    Derived from the first heads: a stack's lights and rotation tell how its head stands in the world.
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
    """Rotation [3, 3] from the lights' world directions to the stack's lights in the head's frame."""
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
