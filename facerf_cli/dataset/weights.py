"""Environment maps as the weights of a dataset's lights.

**In which frame a map stands.** A stack's lights are in its crop's camera space, d_crop = R_fit
R_world_to_head d_world, so they differ from camera to camera although the lamps stay where they are. A map
must stay where it is, too: it is weighed once, over the lamps' directions in the world, and the same weights
serve every camera and every subject. To each camera that is the map turned by R_fit R_world_to_head. A
rotation is one about the world's vertical. Captures name their axes as they like, so `world_to_map` finds the
vertical by the heads: the world's axis that is nearest to their up is the map's y, the one nearest to where
they look is its z.

The lights' weights of a dataset's pairs, which settle them: with its map's exposure a recipe is whole.

    relit/weights-KEY.npy   the weights of every row of pairs.jsonl [rows, L, 3]; KEY is that file's digest

A row's weights are those of its subject's lights; where it lacks some of the rig's L, zeros fill the row up.

The weights follow from the rows and the maps, and are made anew where they are missing.
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
from facerf_cli.synth.heads_bank import one_thread
from facerf_cli.synth.sky.skies import ProceduralMaps, draw_sky

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


Spread = Callable[[Callable[[MapWork], Weighed], Sequence[MapWork]], Iterable[Weighed]]
log = logging.getLogger(LOGGER_NAME)


def settle_pairs(dataset: Dataset, drawn: list[Pair], overwrite: bool, spread: Spread = map) -> list[Pair]:
    """Weigh the maps of the pairs drawn, write pairs.jsonl and weights, and give the pairs with exposures.

    What is there already stays if it agrees, so that a larger number adds pairs; every picture must be of a
    pair that stays. `overwrite` takes the old pairs and pictures away, once the new ones can be made.
    """
    if not overwrite:
        old = read_pairs(dataset)
        before = [replace(pair, exposure_ev=0) for pair in old]
        if old and before == drawn and weights_path(dataset).is_file():
            return old
        _require_agreement(dataset, before, drawn)
    weights, pairs = weigh_pairs(dataset, drawn, spread)
    if overwrite:
        _remove_old(dataset)
    else:
        _require_agreement(dataset, old, pairs)  # now the exposures, too: maps may have changed
    text = "".join(json_line(asdict(pair)) + "\n" for pair in pairs)
    _write_weights(dataset, weights, text.encode())
    with atomic_path(pairs_path(dataset)) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return pairs


def _require_agreement(dataset: Dataset, old: list[Pair], new: list[Pair]) -> None:
    """Raise where pairs that both have are not the same, or a picture is there of any other."""
    known = {pair.key: pair for pair in old}
    both = [pair for pair in new if pair.key in known]
    explained = {image_path(dataset, *pair.key) for pair in both}
    if any(known[pair.key] != pair for pair in both) or not explained.issuperset(_images(dataset)):
        raise UsageError(
            f"{dataset.folder / RELIT}: holds pictures of another seed, other maps, another dataset or more "
            "of each subject; give those again, or --overwrite"
        )


def _images(dataset: Dataset) -> list[Path]:
    return list((dataset.folder / RELIT).glob("*/[0-9]*.exr"))


def _remove_old(dataset: Dataset) -> None:
    """The pairs first, so that a killed run leaves no picture that could pass for another pair's."""
    pairs_path(dataset).unlink(missing_ok=True)
    for path in _images(dataset):
        path.unlink()


def weights_path(dataset: Dataset) -> Path:
    """Where the weights of the present pairs are, or would be."""
    return _weights_path(dataset, pairs_path(dataset).read_bytes())


def _weights_path(dataset: Dataset, pairs_text: bytes) -> Path:
    return dataset.folder / RELIT / f"weights-{digest(pairs_text)}.npy"


def load_pairs(dataset: Dataset) -> dict[str, tuple[list[Pair], np.ndarray]]:
    """Each subject's pairs and their weights [rows, L, 3] float32, mapped from the disk; L are its lights.

    The exposures are in the weights. Empty where the dataset has no pairs. What was read stays in memory
    until pairs.jsonl changes.
    """
    path = pairs_path(dataset)
    return (
        _load_pairs(_ByFolder(dataset, dataset.folder.absolute()), path.stat().st_mtime_ns)
        if path.is_file()
        else {}
    )


@dataclass(frozen=True)
class _ByFolder:
    """A dataset as a cache's key."""

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
        log.info("%s: missing; the maps are weighed again", path)
        weights, again = weigh_pairs(dataset, pairs)
        if again != pairs:
            raise InputError(
                f"{pairs_path(dataset)}: made with other maps than are there now; run relight-dataset with "
                "--overwrite"
            )
        _write_weights(dataset, weights, pairs_path(dataset).read_bytes())
    try:
        weights = np.load(path, mmap_mode="r")
        if weights.shape != (len(pairs), len(dataset.light_ids), 3) or weights.dtype != np.float32:
            raise ValueError(f"shape {weights.shape}")
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: damaged ({error}); remove it, it will be made anew") from None
    return weights


def _write_weights(dataset: Dataset, weights: np.ndarray, pairs_text: bytes) -> None:
    path = _weights_path(dataset, pairs_text)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.save(file, weights)
    for old in path.parent.glob("weights-*.npy"):
        if old != path:
            old.unlink()


def weigh_pairs(dataset: Dataset, pairs: list[Pair], spread: Spread = map) -> tuple[np.ndarray, list[Pair]]:
    """Weights [rows, L, 3], as they are on disk, and the pairs with their exposures; a map is read once.

    `spread` calls a function on many items, in order, as `map` does: in processes, or with a bar.
    """
    rows_of: dict[str, list[int]] = defaultdict(list)
    for row, pair in enumerate(pairs):
        rows_of[pair.envmap].append(row)
    directions = map_directions(dataset)
    work = [
        MapWork(
            name,
            directions,
            tuple(pairs[row].rotate_deg for row in rows),
            tuple(dataset.lights_of(pairs[row].subject) for row in rows),
        )
        for name, rows in rows_of.items()
    ]
    weights = np.zeros((len(pairs), len(directions), 3), np.float32)
    settled, complaints = list(pairs), []
    for rows, result in zip(rows_of.values(), spread(weigh_map, work), strict=True):
        if isinstance(result, str):
            complaints.append(result)
            continue
        weights[rows] = result.weights
        for row in rows:
            settled[row] = replace(pairs[row], exposure_ev=result.exposure_ev)
    if complaints:
        for complaint in complaints:
            log.error("%s", complaint)
        raise FacerfError(  # leaving them out would give other pairs than the same folder gives when whole
            f"{len(complaints)} of {len(work)} maps cannot be used; mend them or take them out of the folder"
        )
    return weights, settled


def pair_weights(dataset: Dataset, pair: Pair) -> Tensor:
    """The lights' weights [L, 3] of one pair, from its map; what `load_pairs` holds."""
    lights = dataset.lights_of(pair.subject)
    result = weigh_map(MapWork(pair.envmap, map_directions(dataset), (pair.rotate_deg,), (lights,)))
    if isinstance(result, str):
        raise InputError(result)
    if result.exposure_ev != pair.exposure_ev:
        raise InputError(f"{pair.envmap}: not the map that the pair was made with")
    return torch.from_numpy(result.weights[0, : len(lights)])
