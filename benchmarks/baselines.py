"""The reflectance models of the comparison on people of a prepared dataset, each picture against its truth.

    python benchmarks/baselines.py --dataset DATASET --split validation --reflectance prt [--detail 0.4]

Of a source under one map: Si-MSE of its reconstruction (in the light that the model finds), of the
reflectance in the source's true light, and in that of another map, in the source's pose and in another. The
truths are weighed of the dataset's lights. This is what the baselines' settings were chosen by.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from facerf_cli.baselines.explain import explain
from torch import Tensor

from facerf_cli.baselines import Kind, prt, specular_sh
from facerf_cli.baselines.synthesis import DETAIL
from facerf_cli.dataset.dataset import SPLITS, Dataset, read_dataset
from facerf_cli.dataset.weights import load_pairs
from facerf_cli.evaluation.methods import View
from facerf_cli.face.fit import fit_from_arrays
from facerf_cli.files.olat_stack import read_olat_header, read_olats
from facerf_cli.metrics import mean_interval, si_mse
from facerf_cli.pipeline import FaceTexture, Models, load_models, turn_to

KINDS: tuple[Kind, ...] = ("field", "diffuse-sh", "specular-sh", "prt")


@dataclass(frozen=True, eq=False)
class Seen:
    """A person seen by a camera: the lights' directions [L, 3] in its crop, their pictures [L, 3, S, S]."""

    view: View
    directions: Tensor
    olats: Tensor

    def under(self, weights: Tensor) -> np.ndarray:
        """The true picture [S, S, 3] under weights [L, 3]."""
        return torch.einsum("lchw,lc->hwc", self.olats, weights).numpy()


def seen_by(models: Models, dataset: Dataset, subject: str, camera: str) -> Seen:
    """A stack of the dataset."""
    path = dataset.stack_path(subject, camera)
    header = read_olat_header(path)
    view = View.of(models.face, fit_from_arrays(header.fit), header.seen)
    return Seen(view, torch.from_numpy(header.directions).float(), read_olats(path).float())


def cases(dataset: Dataset, split: str, per_person: int) -> Iterator[tuple[str, str, str, Tensor, Tensor]]:
    """Person, camera of the source and another, weights [L, 3] of the source's map and of another."""
    for subject in dataset.splits[split]:
        pairs, weights = load_pairs(dataset)[subject]
        rows = np.linspace(0, len(pairs) - 1, 2 * per_person).astype(int)
        for first, second in zip(rows[:per_person], rows[per_person:], strict=True):
            own, other = (torch.from_numpy(np.array(weights[row])) for row in (first, second))
            yield subject, pairs[first].source_camera, pairs[second].source_camera, own, other


def measure(
    models: Models, how: Any, source: Seen, target: Seen, own: Tensor, other: Tensor
) -> dict[str, float]:
    """The errors of one case, and the processor's seconds to explain it."""
    photo = source.under(own)
    face: FaceTexture = source.view.texture_of(photo)
    started = time.process_time()
    explained = how(models, source.view.fit, face)
    seconds = time.process_time() - started
    relit, light = explained.reflectance.relit, explained.light
    turn = turn_to(source.view.fit, target.view.fit.rotation)
    under_both = relit(source.directions, torch.stack([own, other]))
    textures = {
        "reconstruction": (source, relit(light.directions, light.weights[None])[0], photo),
        "true light": (source, under_both[0], photo),
        "another map": (source, under_both[1], source.under(other)),
        "and pose": (target, relit(target.directions, other[None], turn)[0], target.under(other)),
    }
    errors = {
        name: float(si_mse(seen.view.image(texture), truth, seen.view.mask))
        for name, (seen, texture, truth) in textures.items()
    }
    return errors | {"CPU s": seconds}


def method(given: argparse.Namespace, kind: Kind) -> Any:
    """The model of that kind, with the settings that were given in place of its own."""
    if kind == "specular-sh" and (given.detail is not None or given.evidence is not None):
        return partial(specular_sh.explain_by_specular_sh, **_changed(given, specular_sh))
    if kind == "prt" and (given.detail is not None or given.evidence is not None):
        return partial(prt.explain_by_prt, **_changed(given, prt))
    return partial(explain, kind)


def _changed(given: argparse.Namespace, module: Any) -> dict[str, Any]:
    evidence = module.SETTINGS.evidence if given.evidence is None else given.evidence
    detail = DETAIL if given.detail is None else given.detail
    return {"settings": replace(module.SETTINGS, evidence=evidence), "detail": detail}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--dataset", type=Path, required=True, help="of prepare-dataset and relight-dataset")
    add("--split", default="test", choices=SPLITS)
    add("--per-person", type=int, default=2)
    add("--reflectance", choices=KINDS, action="append", help="default: all but the field, which is slow")
    add("--detail", type=float, help="share of what the prior on skin lacks of the photo")
    add("--evidence", type=float, help="see baselines/synthesis.py")
    given = parser.parse_args()
    torch.set_num_threads(1)
    dataset, models = read_dataset(given.dataset), load_models(None, "builtin", torch.device("cpu"))
    found: dict[str, list[tuple[str, dict[str, float]]]] = defaultdict(list)
    for subject, camera, other_camera, own, other in cases(dataset, given.split, given.per_person):
        source, target = (seen_by(models, dataset, subject, c) for c in (camera, other_camera))
        for kind in given.reflectance or KINDS[1:]:
            how = method(given, kind)
            found[kind].append((subject, measure(models, how, source, target, own, other)))
    for kind, rows in found.items():
        print(f"{kind}, {len(rows)} pictures of {given.split} people")
        for name in rows[0][1]:
            interval = mean_interval((subject, row[name]) for subject, row in rows)
            assert interval is not None
            low, high = interval.low, interval.high
            print(f"  {name:16}{interval.mean:9.5f}  median {interval.median:.5f}  [{low:.5f}, {high:.5f}]")


if __name__ == "__main__":
    main()
