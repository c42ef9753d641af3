"""Si-MSE of the reflectance models of the comparison on people of a prepared dataset, in four steps.

    python benchmarks/baselines.py --dataset DATASET --split test [--reflectance prt]

A source image under one map is reconstructed in the light that the model estimates, then relit by its true
light, by that of another map, and by that of another map in another pose. The truths are sums of the
dataset's OLATs. The settings of the baselines were chosen by these figures on the validation people.

Peer: the field, without the photo's quotient. Naive twins of `diffuse-sh`: its albedo at the network's
resolution (`low-pass`), and the network's light as it is (`unrefined`).
"""

import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

import numpy as np
import torch
from _common import arguments, interval_text, print_header, print_row, required
from torch import Tensor

from facerf_cli.baselines import Kind
from facerf_cli.baselines.base import Explained
from facerf_cli.baselines.diffuse_sh import explain_texture
from facerf_cli.dataset.dataset import SPLITS, Dataset, read_dataset
from facerf_cli.dataset.pairs import Pair, load_pairs
from facerf_cli.evaluation.people import DatasetPerson, HeadView, Reading
from facerf_cli.face.head import Head
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.image.metrics import mean_interval, si_mse
from facerf_cli.light.sphere import RigLight
from facerf_cli.person import Person, Target
from facerf_cli.pipeline import explain
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models, load_models

METHODS = ("field", "diffuse-sh", "diffuse-sh low-pass", "diffuse-sh unrefined", "specular-sh", "prt")
STEPS = ("reconstruction", "in the source's true light", "under another map", "and in another pose")


@dataclass(frozen=True, eq=False)
class CapturedView:
    """A camera's crop of a person: its view, the lights' directions [L, 3], their images [L, 3, S, S]."""

    view: HeadView
    directions: Tensor
    olats: Tensor

    def truth(self, weights: Tensor) -> np.ndarray:
        """The true image [S, S, 3] under weights [L, 3]."""
        return torch.einsum("lchw,lc->hwc", self.olats, weights).numpy()


@dataclass(frozen=True, eq=False)
class BaselineCase:
    """A pair, the camera of the other pose, and weights [L, 3] of the source's map and of another."""

    pair: Pair
    other_camera: str
    own: Tensor
    other: Tensor


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--dataset", type=Path, help="of prepare-dataset and relight-dataset")
    parser.add_argument("--split", default="test", choices=SPLITS)
    parser.add_argument("--per-person", type=int, default=2, help="images of each person")
    parser.add_argument("--reflectance", choices=METHODS, nargs="+", default=METHODS)
    given = parser.parse_args()
    torch.set_num_threads(1)
    dataset = read_dataset(required(given.dataset, "a prepared dataset", "--dataset"))
    models = load_models()
    errors: dict[str, list[tuple[str, list[float], float]]] = defaultdict(list)
    for subject in dataset.splits[given.split]:
        person = DatasetPerson(dataset, subject, Reading(models.networks.people, models.sides()))
        for case in cases(dataset, subject, given.per_person):
            for method in given.reflectance:
                errors[method].append((subject, *measure(models, person, case, method)))
    print(f"{given.split} people of {given.dataset}, {given.per_person} images each")
    print_header("", *STEPS, "s of one core")
    for method, rows in errors.items():
        by_step = zip(*(found for _, found, _ in rows), strict=True)
        subjects = [subject for subject, *_ in rows]
        intervals = (mean_interval(zip(subjects, column, strict=True)) for column in by_step)
        cells = [interval_text(interval, ".4f") for interval in intervals]
        print_row(f"`{method}`", *cells, f"{np.median([seconds for *_, seconds in rows]):.1f}")


def cases(dataset: Dataset, subject: str, per_person: int) -> Iterator[BaselineCase]:
    """Yield cases spread over a subject's pairs."""
    pairs, weights = load_pairs(dataset)[subject]
    rows = np.linspace(0, len(pairs) - 1, 2 * per_person).astype(int)
    for first, second in zip(rows[:per_person], rows[per_person:], strict=True):
        own, other = (torch.from_numpy(np.array(weights[row])) for row in (first, second))
        yield BaselineCase(pairs[first], pairs[second].source_camera, own, other)


def measure(
    models: Models, person: DatasetPerson, case: BaselineCase, method: str
) -> tuple[list[float], float]:
    """Si-MSE of each of STEPS, and the processor's seconds to explain the photo."""
    cameras = case.pair.source_camera, case.other_camera
    source, target = (captured(models, person, camera) for camera in cameras)
    photo, head = source.truth(case.own), person.portrait(case.pair).by(models).head
    started_s = time.process_time()
    explained = explain_by(models, head, method)
    seconds = time.process_time() - started_s
    steps = (
        (source, explained.light, photo),
        (source, RigLight(source.directions, case.own), photo),
        (source, RigLight(source.directions, case.other), source.truth(case.other)),
        (target, RigLight(target.directions, case.other), target.truth(case.other)),
    )
    errors = []
    for view, light, truth in steps:
        shown = Target(view.view.fit, "face")
        image = Person(models, None, head, explained.reflectance).image(light, shown).pixels
        errors.append(si_mse(image, truth, view.view.mask))
    return errors, seconds


def captured(models: Models, person: DatasetPerson, camera: str) -> CapturedView:
    """Read a camera's stack of a person."""
    view, directions = person.lit(camera).by(models), person.header(camera).directions
    olats = read_olats(person.dataset.stack_path(person.name, camera)).float()
    return CapturedView(view, torch.from_numpy(directions).float(), olats)


def explain_by(models: Models, head: Head, method: str) -> Explained:
    """Explain a photo by one of METHODS."""
    if method in get_args(Kind):
        return explain(models, head, cast(Kind, method))
    fine, refit = "low-pass" not in method, "unrefined" not in method
    return explain_texture(SHIPPED_NETWORKS.diffuse_sh, head.face, fine, refit)


if __name__ == "__main__":
    main()
