"""The lights' weights of a dataset's pairs, which settle them: with its map's exposure a recipe is whole.

    relit/weights-KEY.npy   the weights of every row of pairs.jsonl [rows, L, 3]; KEY is that file's digest

A row's weights are those of its subject's lights; where it lacks some of the rig's L, zeros fill the row up.

The weights follow from the rows and the maps, and are made anew where they are missing.
"""

import logging
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
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
from facerf_cli.stage.data.documents import digest
from facerf_cli.stage.data.map_weights import MapWork, Weighed, map_directions, weigh_map
from facerf_cli.stage.data.recipes import RELIT, Pair, pairs_path, picture_path, read_pairs

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
    explained = {picture_path(dataset, *pair.key) for pair in both}
    if any(known[pair.key] != pair for pair in both) or not explained.issuperset(_pictures(dataset)):
        raise UsageError(
            f"{dataset.folder / RELIT}: holds pictures of another seed, other maps, another dataset or more "
            "of each subject; give those again, or --overwrite"
        )


def _pictures(dataset: Dataset) -> list[Path]:
    return list((dataset.folder / RELIT).glob("*/[0-9]*.exr"))


def _remove_old(dataset: Dataset) -> None:
    """The pairs first, so that a killed run leaves no picture that could pass for another pair's."""
    pairs_path(dataset).unlink(missing_ok=True)
    for path in _pictures(dataset):
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
