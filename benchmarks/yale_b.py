"""Relight the real faces of Extended Yale B to its real point lights, and hold checkpoints against the peers.

    python benchmarks/yale_b.py [--checkpoint SEED0 SEED1 ...] [--json FILE] [--jobs 2]
    python benchmarks/yale_b.py --subjects yaleB05 yaleB15 yaleB22   # for choosing settings: these alone

The pictures and their figures are those of `facerf evaluate yale-b --shifts BENCH/shifts.csv`. Here several
checkpoints are seeds of one recipe: their mean is held against bar and aim, and each is shown. `--out`
keeps the pictures as the benchmark's own score.py wants them: OUT/CHECKPOINT/SUBJECT/SOURCE/LIGHT.npy.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from yale_table import Row, results, table

from facerf_cli.capture.yale_b import YaleB, read_shifts, read_yale_b
from facerf_cli.errors import FacerfError
from facerf_cli.evaluation.case import Comparison
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.protocols.yale_b import compare_sitter
from facerf_cli.metrics import si_mse, ssim
from facerf_cli.pipeline import load_models

SHARED = Path("../shared")


@dataclass(frozen=True)
class Task:
    """What every process needs to relight and score a subject."""

    data: Path
    bench: Path
    checkpoints: tuple[Path | None, ...]  # None is the one shipped
    face_model: str
    out: Path | None


def main() -> None:
    given = _arguments()
    task = Task(given.data, given.bench, tuple(given.checkpoint or [None]), given.face_model, given.out)
    everyone = load_database(task.data, task.bench).subjects
    chosen = given.subjects or everyone
    if strangers := sorted(set(chosen) - set(everyone)):
        raise SystemExit(f"{', '.join(strangers)}: not in {given.data}")
    begin = time.monotonic()
    seeds: list[list[Row]] = [[] for _ in task.checkpoints]
    for subject, by_checkpoint in zip(chosen, _scored(task, chosen, given.jobs), strict=True):
        for rows, more in zip(seeds, by_checkpoint, strict=True):
            rows += more
        print(f"{subject} {time.monotonic() - begin:.0f} s", file=sys.stderr, flush=True)
    found = results([str(path or "shipped") for path in task.checkpoints], seeds, whole=chosen == everyone)
    print(table(found))
    if given.json:
        given.json.parent.mkdir(parents=True, exist_ok=True)
        given.json.write_text(json.dumps(found, indent=1) + "\n")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--data", type=Path, default=SHARED / "data/extended_yale_b", help="the yaleBXX folders")
    add("--bench", type=Path, default=SHARED / "bench/yale_b", help="the folder of its shifts.csv")
    add("--checkpoint", type=Path, nargs="+", help="seeds of one recipe (default: the one shipped)")
    add("--face-model", default="builtin")
    add("--subjects", nargs="+", help="only these, such as yaleB05: no bar is held against them")
    add("--jobs", type=int, default=1, help="processes, a core each")
    add("--out", type=Path, help="keep the predictions here, for score.py")
    add("--json", type=Path, help="write all figures here")
    given = parser.parse_args()
    for path in given.checkpoint or []:
        if not path.is_file():
            parser.error(f"{path}: no such checkpoint")
    return given


def _scored(task: Task, subjects: list[str], jobs: int) -> Iterator[list[list[Row]]]:
    """The scored rows of every checkpoint, subject by subject."""
    if jobs == 1:
        yield from (score_subject(task, subject) for subject in subjects)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn"), torch.set_num_threads, (1,)) as pool:
        yield from pool.map(score_subject, [task] * len(subjects), subjects)


@lru_cache(maxsize=1)
def load_database(data: Path, bench: Path) -> YaleB:
    """The database, each picture moved onto its subject's frontal one as the benchmark does."""
    try:
        return read_yale_b(data, read_shifts(bench / "shifts.csv"))
    except FacerfError as error:
        raise SystemExit(f"{error} (--data and --bench say where)") from None


@lru_cache(maxsize=1)
def _load_all(checkpoints: tuple[Path | None, ...], face_model: str) -> list[Method]:
    """A method a checkpoint; several may share a stem."""
    models = [load_models(path, face_model, torch.device("cpu")) for path in checkpoints]
    return [Method(f"{number}-{each.checkpoint_name}", "field", each) for number, each in enumerate(models)]


def score_subject(task: Task, subject: str) -> list[list[Row]]:
    """The measures of all of a subject's cases, for every checkpoint."""
    methods = _load_all(task.checkpoints, task.face_model)
    scored: list[list[Row]] = [[] for _ in methods]
    for comparison in compare_sitter(load_database(task.data, task.bench), subject, methods):
        for rows, method in zip(scored, methods, strict=True):
            rows.append(_row(comparison, method.name))
            if task.out:
                _keep(task.out / method.name / f"{comparison.case.name}.npy", comparison, method.name)
    return scored


def _row(comparison: Comparison, method: str) -> Row:
    facts, (subject, source, light) = comparison.case.facts, comparison.case.name.split("/")
    images = comparison.predictions[method], comparison.truth, comparison.mask
    return {
        "subject": subject,
        "angle_deg": facts.get("angle_deg"),
        "task": "B" if facts["column"] == "environment" else "A",
        "source": source,
        "light": light,
        "si_mse": si_mse(*images),
        "ssim": ssim(*images),
    }


def _keep(path: Path, comparison: Comparison, method: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, comparison.predictions[method][..., 0])


if __name__ == "__main__":
    main()
