"""Cost of the files that are made of a dataset, by those of one stack: bytes, and hours of a core."""

import math
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from facerf_cli.dataset.dataset import Dataset, read_stack
from facerf_cli.dataset.pairs import Pair, compute_pair_weights, load_pairs, write_source
from facerf_cli.dataset.unwrapped import images_at_once, missing_parts, unwrapped_images
from facerf_cli.dataset.weights import TILE_IMAGES, relit_images
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.files.olat_stack import read_olat_header, read_olats
from facerf_cli.run import memory
from facerf_cli.run.logs import attributes_of_sum, json_line
from facerf_cli.run.workers import one_thread

_MEASURED = 8  # sources
_KEPT_BYTES = 14  # of a texel of a stack: seven half floats that are no light's


@dataclass(frozen=True)
class Cost:
    """Bytes of files, and processor time in seconds that making them takes."""

    file_bytes: float = 0.0
    core_s: float = 0.0

    def __str__(self) -> str:
        """Both in words."""
        hours = self.core_s / 3600
        time_of_core = f"{hours:.1f} hours" if hours >= 1 else f"{self.core_s / 60:.1f} minutes"
        return f"about {in_words(self.file_bytes)} and {time_of_core} of a core"


def in_words(size_bytes: float) -> str:
    """Bytes in GB, or in MB where that is less than one."""
    return f"{size_bytes / 1e9:.1f} GB" if size_bytes >= 1e9 else f"{size_bytes / 1e6:.1f} MB"


def cost_of_sources(dataset: Dataset, pairs: Sequence[Pair]) -> Cost:
    """The cost of writing the sources of pairs, by the first stack's: opened, summed and written nowhere."""
    stacks = Counter((pair.subject, pair.source_camera) for pair in pairs)
    if not stacks:
        return Cost()
    stack = next(iter(stacks))
    some = [pair for pair in pairs if (pair.subject, pair.source_camera) == stack][:_MEASURED]
    weights, _ = compute_pair_weights(dataset, some)
    path, begun_s = dataset.stack_path(*stack), time.process_time()
    images = list(relit_images(path, torch.from_numpy(weights), memory.limit_bytes()))
    summed_s = time.process_time()
    attributes = attributes_of_sum(read_olat_header(path).metadata)
    with TemporaryDirectory() as folder:
        for pair, image in zip(some, images, strict=True):
            write_source(Path(folder) / f"{pair.index}.exr", pair, image, attributes)
        each_bytes = sum(path.stat().st_size for path in Path(folder).iterdir()) / len(some)
    each_s = (time.process_time() - summed_s) / len(some)
    sums = sum(math.ceil(count / TILE_IMAGES) for count in stacks.values())
    return Cost(len(pairs) * each_bytes, sums * (summed_s - begun_s) + len(pairs) * each_s)


def recipe_bytes(dataset: Dataset, pairs: Sequence[Pair]) -> int:
    """Bytes of pairs.jsonl and of the pairs' weights."""
    return sum(len(json_line(asdict(pair))) + 1 + 12 * len(dataset.light_ids) for pair in pairs)


def cost_of_textures(dataset: Dataset, model: MorphableModel, side: int, subjects: Iterable[str]) -> Cost:
    """The cost of unwrapping what textures of `side` lack, by some images of the first stack."""
    parts = [part for subject in subjects for part in missing_parts(dataset, side, subject)]
    if not parts:
        return Cost()
    stacks = [(subject, camera) for subject, camera in parts if camera]
    sources = [load_pairs(dataset)[subject][0] for subject, camera in parts if not camera]
    images = sum(len(dataset.lights_of(subject)) for subject, _ in stacks) + sum(map(len, sources))
    subject = parts[0][0]
    path, at_once = dataset.stack_path(subject, dataset.cameras[subject][0]), images_at_once(side)
    _, fit = read_stack(path)
    begun_s = time.process_time()
    with one_thread():
        some = read_olats(path, slice(at_once))
        unwrapped_images(some, fit.vertices_camera(model), fit, side)
    each_s = (time.process_time() - begun_s) / len(some)
    return Cost((6 * images + _KEPT_BYTES * len(stacks)) * side**2, images * each_s)
