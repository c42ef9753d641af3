"""Training pairs (paper, 'Dataset'): a source under an envmap, and one light to predict from it.

    relit/pairs.jsonl         one `Pair` per line, sorted by subject and index
    relit/weights-KEY.npy     weights of all rows of pairs.jsonl [rows, L, 3] float32; KEY is its digest
    relit/SUBJECT/NNNNN.exr   the pair's source, unless the pairs are lazy

A pair is a recipe: subject, camera, envmap, rotation, exposure and target. A row of weights starts with the
weights of its subject's lights; if the subject lacks some of the rig's L, zeros follow.
"""

import hashlib
import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.weights import (
    EnvmapTask,
    Spread,
    compute_weights,
    map_directions,
    relit_images,
)
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import checked, digest
from facerf_cli.files.image_metadata import attributes_of_sum
from facerf_cli.files.olat_stack import read_olat_header
from facerf_cli.files.texts import parse_json, text_of
from facerf_cli.files.write import write_exr
from facerf_cli.run.logs import LOGGER_NAME, json_line

RELIT, PAIRS_NAME = "relit", "pairs.jsonl"
DRAW_AGAIN = f"move the folder {RELIT} elsewhere and run relight-dataset"
GIVE_BEFORE = f"run prepare-dataset with the previous --split and --seed, or {DRAW_AGAIN}"
_TEST, _TEST_SAME_SHARE = "test", 0.5  # fraction of the test's pairs, for both rows of Table 1
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, slots=True)
class Pair:
    """Source under an envmap, and a target: one light of a camera's stack.

    The source is the stack of `source_camera` summed with the weights of `envmap`, with `rotate_deg` added to
    every azimuth, times 2 to the power of `exposure_ev`, which brings the envmap's mean radiance near 1.
    `envmap` is a file, or procedural:INDEX:SEED:WIDTH for a map of `synth/sky/skies.py`.
    """

    subject: str
    index: int
    split: str
    source_camera: str
    envmap: str
    rotate_deg: float
    exposure_ev: int
    target_camera: str
    target_light: int  # part of the target camera's stack, from 0

    @property
    def key(self) -> tuple[str, int]:
        """Subject and index, unique within a dataset."""
        return self.subject, self.index


def draw_pairs(
    dataset: Dataset, maps: Sequence[str], per_subject: int, seed: int, test_maps: Sequence[str] = ()
) -> list[Pair]:
    """Draw `per_subject` pairs of every subject in a split, sorted, with exposures still 0.

    The split test is lit by `test_maps` if there are any, the others by `maps`.
    """
    of = {_TEST: test_maps or maps}
    placed = sorted(subject for subject in dataset.subjects if dataset.split_of(subject))
    return [
        draw_pair(dataset, of.get(dataset.split_of(subject), maps), seed, subject, index)
        for subject in placed
        for index in range(per_subject)
    ]


def draw_pair(dataset: Dataset, maps: Sequence[str], seed: int, subject: str, index: int) -> Pair:
    """Draw one pair; it depends on (seed, subject, index), the subject's cameras and lights, and `maps`.

    The target's camera is any of the subject's (paper, 'Dataset': 'from a random camera view'); in the split
    test, half of the pairs have the source's.
    """
    name = int.from_bytes(hashlib.sha256(subject.encode()).digest()[:8], "little")
    random = np.random.default_rng([seed, name, index])
    cameras = dataset.cameras[subject]
    source = cameras[int(random.integers(len(cameras)))]
    split = dataset.split_of(subject)
    same = split == _TEST and random.random() < _TEST_SAME_SHARE
    targets = [camera for camera in cameras if camera != source] if split == _TEST else cameras
    return Pair(
        subject=subject,
        index=index,
        split=split,
        source_camera=source,
        envmap=maps[int(random.integers(len(maps)))],
        rotate_deg=round(float(random.uniform(0, 360)), 2),
        exposure_ev=0,
        target_camera=source if same or not targets else targets[int(random.integers(len(targets)))],
        target_light=int(random.integers(len(dataset.lights_of(subject)))),
    )


def pairs_path(dataset: Dataset) -> Path:
    return dataset.folder / RELIT / PAIRS_NAME


def image_path(dataset: Dataset, subject: str, index: int) -> Path:
    """Return the path of the source of a subject's pair."""
    return dataset.folder / RELIT / subject / f"{index:05d}.exr"


def read_pairs(dataset: Dataset) -> list[Pair]:
    """Read all pairs of a dataset, if any; raise InputError if they do not fit it."""
    path = pairs_path(dataset)
    pairs: list[Pair] = []
    if not path.is_file():
        return []
    for number, line in enumerate(text_of(path.read_bytes(), "replace").splitlines(), 1):
        try:
            pair = checked(Pair, parse_json(line), f"line {number}")
            known = {pair.source_camera, pair.target_camera} <= set(dataset.cameras[pair.subject])
            if not known or pair.split != dataset.split_of(pair.subject):
                raise ValueError("another camera or split")
            if not 0 <= pair.target_light < len(dataset.lights_of(pair.subject)):
                raise ValueError("no such light")
            if pairs and pair.key <= pairs[-1].key:
                raise ValueError("not sorted, or repeated")
        except (ValueError, KeyError, InputError):
            raise InputError(
                f"{path}: line {number} is not a pair of this dataset and its split; {GIVE_BEFORE}"
            ) from None
        pairs.append(pair)
    return pairs


def write_pairs(dataset: Dataset, drawn: list[Pair], overwrite: bool, spread: Spread = map) -> list[Pair]:
    """Write pairs.jsonl and the weights of newly drawn pairs; return the pairs with their exposures.

    Existing pairs must agree, so that a larger number adds pairs, and every existing image must belong to one
    that is kept. `overwrite` removes old pairs and images once the new weights are computed.
    """
    if not overwrite:
        old = read_pairs(dataset)
        before = [replace(pair, exposure_ev=0) for pair in old]
        if old and before == drawn and weights_path(dataset).is_file():
            return old
        _require_agreement(dataset, before, drawn)
    weights, pairs = compute_pair_weights(dataset, drawn, spread)
    if overwrite:  # pairs first: a killed run leaves no image that could be mistaken for a new pair's
        pairs_path(dataset).unlink(missing_ok=True)
        for path in _images(dataset):
            path.unlink()
    else:
        _require_agreement(dataset, old, pairs)  # also the exposures: the envmaps may have changed
    text = "".join(json_line(asdict(pair)) + "\n" for pair in pairs)
    _write_weights(dataset, weights, text.encode())
    with atomic_path(pairs_path(dataset)) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return pairs


def _require_agreement(dataset: Dataset, old: list[Pair], new: list[Pair]) -> None:
    """Raise UsageError if common pairs differ, or an image belongs to no common pair."""
    known = {pair.key: pair for pair in old}
    both = [pair for pair in new if pair.key in known]
    explained = {image_path(dataset, *pair.key) for pair in both}
    if any(known[pair.key] != pair for pair in both) or not explained.issuperset(_images(dataset)):
        raise UsageError(
            f"{dataset.folder / RELIT}: contains images of another seed, other envmaps, another dataset or "
            f"a larger --per-subject; use those options, or {DRAW_AGAIN}"
        )


def _images(dataset: Dataset) -> list[Path]:
    return list((dataset.folder / RELIT).glob("*/[0-9]*.exr"))


def weights_path(dataset: Dataset, pairs_text: bytes | None = None) -> Path:
    """Return the path of the weights of pairs.jsonl, or of a new text of it."""
    text = pairs_path(dataset).read_bytes() if pairs_text is None else pairs_text
    return dataset.folder / RELIT / f"weights-{digest(text)}.npy"


def _write_weights(dataset: Dataset, weights: np.ndarray, pairs_text: bytes) -> None:
    path = weights_path(dataset, pairs_text)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.save(file, weights)
    for old in path.parent.glob("weights-*.npy"):
        if old != path:
            old.unlink()


def load_pairs(dataset: Dataset) -> dict[str, tuple[list[Pair], np.ndarray]]:
    """Load each subject's pairs and weights [rows, L, 3] float32, memory-mapped, of the subject's L lights.

    Weights include the exposures. The result is empty for a dataset without pairs; it is cached until
    pairs.jsonl changes.
    """
    path = pairs_path(dataset)
    return _load_pairs(dataset.folder.absolute(), path.stat().st_mtime_ns) if path.is_file() else {}


@lru_cache(maxsize=1)  # large tables, one dataset at a time
def _load_pairs(folder: Path, changed_ns: int) -> dict[str, tuple[list[Pair], np.ndarray]]:
    dataset = read_dataset(folder)
    pairs = read_pairs(dataset)
    weights = _load_weights(dataset, pairs)
    rows_of: dict[str, list[int]] = defaultdict(list)
    for row, pair in enumerate(pairs):
        rows_of[pair.subject].append(row)
    return {
        subject: (
            pairs[rows[0] : rows[-1] + 1],
            weights[rows[0] : rows[-1] + 1, : len(dataset.lights_of(subject))],
        )
        for subject, rows in rows_of.items()
    }


def _load_weights(dataset: Dataset, pairs: list[Pair]) -> np.ndarray:
    path = weights_path(dataset)
    try:
        weights = np.load(path, mmap_mode="r")
        if weights.shape != (len(pairs), len(dataset.light_ids), 3) or weights.dtype != np.float32:
            raise ValueError(f"shape {weights.shape}")
    except (ValueError, OSError, EOFError) as error:
        what = f"damaged ({error}); delete it, and" if path.is_file() else "missing;"
        raise InputError(f"{path}: {what} run relight-dataset again with the same options") from None
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
    exposed, errors = list(pairs), []
    for rows, result in zip(rows_of.values(), spread(compute_weights, tasks), strict=True):
        if isinstance(result, str):
            errors.append(result)
            continue
        weights[rows] = result.weights
        for row in rows:
            exposed[row] = replace(pairs[row], exposure_ev=result.exposure_ev)
    if errors:
        for error in errors:
            log.error("%s", error)
        raise FacerfError(  # without them, pairs would differ from those of the complete folder
            f"--envmaps: {len(errors)} of {len(tasks)} maps cannot be used; repair or remove them"
        )
    return weights, exposed


def relight_subject(dataset: Dataset, pairs: list[Pair], weights: np.ndarray, overwrite: bool = False) -> int:
    """Write the missing sources of a subject's pairs, with weights [rows, L, 3]; return their number."""
    todo = [row for row, pair in enumerate(pairs) if overwrite or not image_path(dataset, *pair.key).exists()]
    for camera in sorted({pairs[row].source_camera for row in todo}):
        rows = [row for row in todo if pairs[row].source_camera == camera]
        path = dataset.stack_path(pairs[rows[0]].subject, camera)
        images = relit_images(path, torch.from_numpy(np.array(weights[rows])))
        attributes = attributes_of_sum(read_olat_header(path).metadata)
        for row, image in zip(rows, images, strict=True):
            recipe = {f"facerf:{name}": value for name, value in asdict(pairs[row]).items()}
            pixels = image.permute(1, 2, 0).float().numpy()
            write_exr(image_path(dataset, *pairs[row].key), pixels, metadata={**attributes, **recipe})
    return len(todo)


def sum_sources(dataset: Dataset, pairs: Sequence[Pair]) -> list[Tensor]:
    """Sum the sources [3, H, W] float16 of pairs of one subject and camera.

    The result equals the files that `relight-dataset` writes, bit for bit.
    """
    rows, weights = load_pairs(dataset)[pairs[0].subject]
    places = {row.index: place for place, row in enumerate(rows)}
    chosen = torch.from_numpy(np.array(weights[[places[pair.index] for pair in pairs]]))
    return list(relit_images(dataset.stack_path(pairs[0].subject, pairs[0].source_camera), chosen))
