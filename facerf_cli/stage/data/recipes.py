"""Recipes of relit pictures (paper, 'Dataset'): subject, camera, map and rotation; and the light to predict.

    relit/pairs.jsonl       a `Pair` a line, sorted by subject and index
    relit/weights-KEY.npy   the lights' weights of every row [rows, L, 3]; KEY is the digest of pairs.jsonl

The weights follow from the rows and the maps, and are made anew where they are missing.
"""

import hashlib
import json
import logging
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.records import LOGGER_NAME, json_line
from facerf_cli.stage.data.dataset import Dataset
from facerf_cli.stage.data.map_weights import MapWork, Weighed, map_directions, weigh_map

RELIT, PAIRS_NAME = "relit", "pairs.jsonl"
_SAME_CAMERA_SHARE = 0.5
Spread = Callable[[Callable[["MapWork"], "Weighed"], Sequence["MapWork"]], Iterable["Weighed"]]
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class Pair:
    """A source under a map, and the light of a camera's stack that is to be predicted from it.

    The source is the subject's stack of `source_camera` weighed by `envmap`, `rotate_deg` added to every
    azimuth of it, times 2 to the power of `exposure_ev`, which brings the map's mean radiance near 1.
    `envmap` is a file, or procedural:INDEX:SEED:WIDTH, a map of `stage.sky.skies`.
    """

    subject: str
    index: int
    split: str
    source_camera: str
    envmap: str
    rotate_deg: float
    exposure_ev: int
    target_camera: str
    target_light: int  # of the rig, from 0

    @staticmethod
    def from_row(row: dict[str, object]) -> "Pair":
        """A pair of a line's JSON; ValueError, TypeError where it is none."""
        kinds = {name: field.type for name, field in Pair.__dataclass_fields__.items()}
        if set(row) != set(kinds) or any(type(row[name]) is not kind for name, kind in kinds.items()):
            raise ValueError(f"no pair: {row}")
        return Pair(**row)  # type: ignore[arg-type]

    @property
    def key(self) -> tuple[str, int]:
        """What identifies it in its dataset."""
        return self.subject, self.index


def draw_pairs(dataset: Dataset, maps: Sequence[str], per_subject: int, seed: int) -> list[Pair]:
    """`per_subject` pairs of every subject that is in a split, sorted; exposures are still to be found."""
    placed = sorted(subject for subject in dataset.subjects if dataset.split_of(subject))
    return [draw_pair(dataset, maps, seed, subject, i) for subject in placed for i in range(per_subject)]


def draw_pair(dataset: Dataset, maps: Sequence[str], seed: int, subject: str, index: int) -> Pair:
    """A function of (seed, subject, index), the subject's cameras and the list of maps."""
    name = int.from_bytes(hashlib.sha256(subject.encode()).digest()[:8], "little")
    random = np.random.default_rng([seed, name, index])
    cameras = dataset.cameras[subject]
    source = cameras[int(random.integers(len(cameras)))]
    others = [camera for camera in cameras if camera != source]
    same = random.random() < _SAME_CAMERA_SHARE or not others
    return Pair(
        subject=subject,
        index=index,
        split=dataset.split_of(subject),
        source_camera=source,
        envmap=maps[int(random.integers(len(maps)))],
        rotate_deg=round(float(random.uniform(0, 360)), 2),
        exposure_ev=0,
        target_camera=source if same else others[int(random.integers(len(others)))],
        target_light=int(random.integers(len(dataset.light_ids))),
    )


def pairs_path(dataset: Dataset) -> Path:
    """Where a dataset keeps its pairs."""
    return dataset.folder / RELIT / PAIRS_NAME


def picture_path(dataset: Dataset, subject: str, index: int) -> Path:
    """Where the source of a subject's pair is written."""
    return dataset.folder / RELIT / subject / f"{index:05d}.exr"


def read_pairs(dataset: Dataset) -> list[Pair]:
    """All pairs of a dataset, none where it has none; they must speak of what the dataset holds."""
    path, pairs = pairs_path(dataset), []
    if not path.is_file():
        return []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        try:
            pair = Pair.from_row(json.loads(line))
            cameras = dataset.cameras[pair.subject]
            if not {pair.source_camera, pair.target_camera} <= set(cameras):
                raise ValueError("another dataset's cameras")
            if not 0 <= pair.target_light < len(dataset.light_ids) or not math.isfinite(pair.rotate_deg):
                raise ValueError("a light or an angle that cannot be")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            raise InputError(
                f"{path}: line {number} is no pair of this dataset; run relight-dataset with --overwrite"
            ) from None
        pairs.append(pair)
    return pairs


def settle_pairs(dataset: Dataset, drawn: list[Pair], overwrite: bool, spread: Spread = map) -> list[Pair]:
    """Weigh the maps of the pairs drawn, write pairs.jsonl and weights, and give the pairs with exposures.

    What is there already stays if it agrees, so that a larger number adds pairs. Where it does not agree,
    `overwrite` removes the pictures made from it before the new pairs are written.
    """
    old = _old_pairs(dataset, overwrite)
    if _agree(dataset, old, drawn):
        if old and len(old) == len(drawn) and not overwrite and weights_path(dataset).is_file():
            return old
    elif overwrite:
        _remove_pictures(dataset)  # first, so that a killed run leaves no pair with another one's picture
    else:
        raise UsageError(
            f"{dataset.folder / RELIT}: holds pictures of another seed, other maps or another dataset; "
            "give those again, or --overwrite"
        )
    weights, pairs = weigh_pairs(dataset, drawn, spread)
    text = "".join(json_line(asdict(pair)) + "\n" for pair in pairs)
    _write_weights(dataset, weights, text.encode())
    with atomic_path(pairs_path(dataset)) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return pairs


def _old_pairs(dataset: Dataset, overwrite: bool) -> list[Pair] | None:
    """None where there are none, or none that can be read and they are to be overwritten."""
    try:
        return read_pairs(dataset) if pairs_path(dataset).is_file() else None
    except InputError:
        if overwrite:
            return None
        raise


def _agree(dataset: Dataset, old: list[Pair] | None, drawn: list[Pair]) -> bool:
    """Whether the pairs that both have are the same, and no picture is there without its pair."""
    if old is None:
        return not any(_pictures(dataset))
    known = {pair.key: replace(pair, exposure_ev=0) for pair in old}
    return all(known.get(pair.key, pair) == pair for pair in drawn)


def _pictures(dataset: Dataset) -> Iterator[Path]:
    return (dataset.folder / RELIT).glob("*/*[0-9].exr")


def _remove_pictures(dataset: Dataset) -> None:
    for path in _pictures(dataset):
        path.unlink()


def weights_path(dataset: Dataset) -> Path:
    """Where the weights of the present pairs are, or would be."""
    return _weights_path(dataset, pairs_path(dataset).read_bytes())


def _weights_path(dataset: Dataset, pairs_text: bytes) -> Path:
    return dataset.folder / RELIT / f"weights-{hashlib.sha256(pairs_text).hexdigest()[:16]}.npy"


def load_pairs(dataset: Dataset) -> dict[str, tuple[list[Pair], np.ndarray]]:
    """Each subject's pairs and their weights [rows, L, 3] float32, mapped from the disk.

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
def _load_pairs(key: "_ByFolder", changed_ns: int) -> dict[str, tuple[list[Pair], np.ndarray]]:
    pairs = read_pairs(key.dataset)
    weights = _load_weights(key.dataset, pairs)
    rows_of: dict[str, list[int]] = defaultdict(list)
    for row, pair in enumerate(pairs):
        rows_of[pair.subject].append(row)
    if any(rows[-1] - rows[0] >= len(rows) for rows in rows_of.values()):
        raise InputError(
            f"{pairs_path(key.dataset)}: not sorted by subject; run relight-dataset with --overwrite"
        )
    return {
        subject: (pairs[rows[0] : rows[-1] + 1], weights[rows[0] : rows[-1] + 1])
        for subject, rows in rows_of.items()
    }


def _load_weights(dataset: Dataset, pairs: list[Pair]) -> np.ndarray:
    path = weights_path(dataset)
    if not path.is_file():
        log.info("%s: missing; the maps are weighed again", path)
        weights, _ = weigh_pairs(dataset, pairs)
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
    """Weights [rows, L, 3] and the pairs with their exposures; each map is read once.

    `spread` calls a function on many items, in order, as `map` does: in processes, or with a bar.
    """
    rows_of: dict[str, list[int]] = defaultdict(list)
    for row, pair in enumerate(pairs):
        rows_of[pair.envmap].append(row)
    directions = map_directions(dataset)
    work = [
        MapWork(name, directions, tuple(pairs[row].rotate_deg for row in rows))
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
    result = weigh_map(MapWork(pair.envmap, map_directions(dataset), (pair.rotate_deg,)))
    if isinstance(result, str):
        raise InputError(result)
    if result.exposure_ev != pair.exposure_ev:
        raise InputError(f"{pair.envmap}: not the map that the pair was made with")
    return torch.from_numpy(result.weights[0])
