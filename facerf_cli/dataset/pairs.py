"""Training pairs (paper, 'Dataset'): a source under an envmap, and one light to predict from it.

    relit/pairs.jsonl         a `Pair` a line, sorted by subject and index
    relit/SUBJECT/NNNNN.exr   the pair's source, unless the pairs are lazy

A pair is a recipe: subject, camera, envmap, rotation and target. `dataset/weights.py` adds the exposures.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facerf_cli.dataset.dataset import Dataset
from facerf_cli.errors import InputError
from facerf_cli.files.documents import checked
from facerf_cli.files.json_reader import parse_json

RELIT, PAIRS_NAME = "relit", "pairs.jsonl"
_TEST, _TEST_SAME_SHARE = "test", 0.5  # of the test's pairs, for both rows of the paper's Table 1


@dataclass(frozen=True, slots=True)
class Pair:
    """A source under an envmap, and the light of a camera's stack that a network predicts from it.

    The source is the stack of `source_camera` summed with the weights of `envmap`, `rotate_deg` added to
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


def draw_pairs(dataset: Dataset, maps: Sequence[str], per_subject: int, seed: int) -> list[Pair]:
    """Draw `per_subject` pairs of every subject in a split, sorted, with exposures still 0."""
    placed = sorted(subject for subject in dataset.subjects if dataset.split_of(subject))
    return [draw_pair(dataset, maps, seed, subject, i) for subject in placed for i in range(per_subject)]


def draw_pair(dataset: Dataset, maps: Sequence[str], seed: int, subject: str, index: int) -> Pair:
    """Draw one pair; it depends on (seed, subject, index), the subject's cameras and lights, and `maps`.

    The target's camera is any of the subject's (paper, 'Dataset': 'from a random camera view'); in the split
    test it is the source's in half of the pairs.
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
    """Path of a dataset's pairs."""
    return dataset.folder / RELIT / PAIRS_NAME


def image_path(dataset: Dataset, subject: str, index: int) -> Path:
    """Path of the source of a subject's pair."""
    return dataset.folder / RELIT / subject / f"{index:05d}.exr"


def read_pairs(dataset: Dataset) -> list[Pair]:
    """Read all pairs of a dataset, none where it has none; raise InputError where they do not fit it."""
    path = pairs_path(dataset)
    pairs: list[Pair] = []
    if not path.is_file():
        return []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        try:
            pair = checked(Pair, parse_json(line), f"line {number}")
            _check_pair(dataset, pair)
            if pairs and pair.key <= pairs[-1].key:
                raise ValueError("not sorted, or repeated")
        except (ValueError, KeyError, InputError):
            raise InputError(
                f"{path}: line {number} is not a pair of this dataset; "
                "run relight-dataset with --overwrite always"
            ) from None
        pairs.append(pair)
    return pairs


def _check_pair(dataset: Dataset, pair: Pair) -> None:
    """Raise KeyError or ValueError where a pair does not fit the dataset."""
    if not {pair.source_camera, pair.target_camera} <= set(dataset.cameras[pair.subject]):
        raise ValueError("unknown camera")
    if pair.split != dataset.split_of(pair.subject):
        raise ValueError("wrong split")
    if not 0 <= pair.target_light < len(dataset.lights_of(pair.subject)) or pair.index < 0:
        raise ValueError("number out of range")
    if not math.isfinite(pair.rotate_deg):
        raise ValueError("angle not finite")
