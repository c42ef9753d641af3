"""Recipes of relit pictures (paper, 'Dataset'): subject, camera, map and rotation; and the light to predict.

    relit/pairs.jsonl         a `Pair` a line, sorted by subject and index
    relit/SUBJECT/NNNNN.exr   its source, where sources are written

`pair_weights.py` settles them: finds their exposures and writes them.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facerf_cli.dataset.dataset import Dataset
from facerf_cli.errors import InputError

RELIT, PAIRS_NAME = "relit", "pairs.jsonl"
_SAME_CAMERA_SHARE = 0.5


@dataclass(frozen=True, slots=True)
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
    target_light: int  # the part of the target camera's stack, from 0

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
    """A function of (seed, subject, index), the subject's cameras and lights, and the list of maps."""
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
        target_light=int(random.integers(len(dataset.lights_of(subject)))),
    )


def pairs_path(dataset: Dataset) -> Path:
    """Where a dataset keeps its pairs."""
    return dataset.folder / RELIT / PAIRS_NAME


def image_path(dataset: Dataset, subject: str, index: int) -> Path:
    """Where the source of a subject's pair is written."""
    return dataset.folder / RELIT / subject / f"{index:05d}.exr"


def read_pairs(dataset: Dataset) -> list[Pair]:
    """All pairs of a dataset, none where it has none; they must speak of what the dataset holds."""
    path = pairs_path(dataset)
    pairs: list[Pair] = []
    if not path.is_file():
        return []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        try:
            pair = Pair.from_row(json.loads(line))
            _check_pair(dataset, pair)
            if pairs and pair.key <= pairs[-1].key:
                raise ValueError("not sorted, or twice")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            raise InputError(
                f"{path}: line {number} is no pair of this dataset; run relight-dataset with --overwrite"
            ) from None
        pairs.append(pair)
    return pairs


def _check_pair(dataset: Dataset, pair: Pair) -> None:
    """KeyError or ValueError for a pair that is not of the dataset."""
    if not {pair.source_camera, pair.target_camera} <= set(dataset.cameras[pair.subject]):
        raise ValueError("another dataset's cameras")
    if pair.split != dataset.split_of(pair.subject):
        raise ValueError("another split's subject")
    if not 0 <= pair.target_light < len(dataset.lights_of(pair.subject)) or pair.index < 0:
        raise ValueError("a number that cannot be")
    if not math.isfinite(pair.rotate_deg):
        raise ValueError("an angle that cannot be")
