"""Relight the real faces of Extended Yale B to its real point lights, and score that beside the peers.

    python benchmarks/yale_b.py [--checkpoint SEED0 SEED1 ...] [--json FILE] [--jobs 2]
    python benchmarks/yale_b.py --subjects yaleB05 yaleB15 yaleB22   # for choosing settings: these alone

Several checkpoints are seeds of one recipe: their mean is held against the bar, and each is shown. Every
picture is measured by the benchmark's own score.py. `--out` keeps the pictures as that wants them,
OUT/CHECKPOINT/SUBJECT/SOURCE/LIGHT.npy, 168x192, aligned with the source.

Pictures are close to linear in light and taken as linear; a subject's sources share its frontal landmarks.
"""

import argparse
import importlib
import json
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor
from yale_table import Row, results, table

from facerf_cli.face.landmarks import find_faces
from facerf_cli.pipeline import (
    Models,
    crop_face,
    explain_photo,
    fit_face,
    load_models,
    predict_olat,
    see_face,
    see_head,
    unwrap_face,
    weigh_batches,
)
from facerf_cli.raster.camera import CROP_FOCAL_PER_SIDE, Camera
from facerf_cli.raster.texture import inpaint, sample_texture

SHARED = Path("../shared")
CROP_PX, TEXTURE_SIDE = 512, 256  # as the verbs have them
_DARK = 0.02  # keeps ratios finite in the source's shadows


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
    everyone = load_yale(given.bench).Yale(str(given.data)).subjects
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
    add("--bench", type=Path, default=SHARED / "bench/yale_b", help="its yale.py and score.py")
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


def load_yale(bench: Path) -> ModuleType:
    """The benchmark's own module of data, lights and cases."""
    return load_bench(bench)[0]


@lru_cache(maxsize=1)
def load_bench(bench: Path) -> tuple[ModuleType, ModuleType]:
    """Its yale.py and its score.py."""
    if not (bench / "yale.py").is_file():
        raise SystemExit(f"{bench}: no yale.py there; give the benchmark's folder with --bench")
    sys.path.insert(0, str(bench.resolve()))
    return importlib.import_module("yale"), importlib.import_module("score")


@lru_cache(maxsize=1)
def _load_all(checkpoints: tuple[Path | None, ...], face_model: str) -> list[Models]:
    return [load_models(path, face_model, torch.device("cpu")) for path in checkpoints]


def score_subject(task: Task, subject: str) -> list[list[Row]]:
    """The measures of all of a subject's cases, for every checkpoint."""
    yale, score = load_bench(task.bench)
    data = yale.Yale(str(task.data))
    frontal = np.repeat(data.source(subject, "frontal")[..., None], 3, -1)
    landmarks_px = find_faces(frontal, subject)[0].landmarks_px
    scored = []
    for number, models in enumerate(_load_all(task.checkpoints, task.face_model)):
        rows = []
        for case, picture in relight_subject(models, yale, data, subject, landmarks_px):
            name = dict(zip(("task", "source", "light"), case, strict=True))
            measures = score.measure(picture, data.target(subject, name["light"]))
            angle_deg = _angle_deg(yale, name["light"])
            rows.append({"subject": subject, "angle_deg": angle_deg, **name, **measures})
            if task.out:
                _keep(task.out / f"{number}-{models.checkpoint_name}" / subject, name, picture)
        scored.append(rows)
    return scored


def _angle_deg(yale: ModuleType, light: str) -> float | None:
    """Between a single light and the camera."""
    parsed = yale.parse_light(light)
    return None if parsed is None else float(yale.angle_to_camera(*parsed))


def _keep(folder: Path, name: dict[str, str], picture: np.ndarray) -> None:
    (folder / name["source"]).mkdir(parents=True, exist_ok=True)
    np.save(folder / name["source"] / f"{name['light']}.npy", picture)


def relight_subject(
    models: Models, yale: ModuleType, data: Any, subject: str, landmarks_px: np.ndarray
) -> Iterator[tuple[tuple[str, str, str], np.ndarray]]:
    """Every case of a subject (task, source, light), and its prediction [H, W]."""
    lights = data.lights(subject)
    directions = torch.tensor(np.array([yale.light_dir(*light) for light in lights]), dtype=torch.float32)
    names = [yale.light_name(*light) for light in lights]
    for source in yale.SOURCES:
        cases = [case for case in data.cases(subject) if case[1] == source]
        weights = torch.stack([target_weights(yale, names, lights, case[2]) for case in cases])
        used = weights.sum(0) > 0
        picture = data.source(subject, source)
        predicted = relight(models, picture, landmarks_px, directions[used], weights[:, used])
        yield from zip(cases, predicted.numpy(), strict=True)


def target_weights(yale: ModuleType, names: list[str], lights: list[tuple[int, int]], target: str) -> Tensor:
    """Weight [L] of every light of a subject under one target, a single light or an environment."""
    if target in yale.ENV:
        return torch.from_numpy(yale.env_weights(target, lights)).float()
    return torch.tensor([float(name == target) for name in names])


def relight(
    models: Models, picture: np.ndarray, landmarks_px: np.ndarray, directions: Tensor, weights: Tensor
) -> Tensor:
    """Pictures [M, H, W] of a grey source [H, W] under M sums, weights [M, L], of lights [L, 3]."""
    photo = np.repeat(picture[..., None], 3, -1).astype(np.float32)
    crop, cropped = crop_face(photo, landmarks_px, CROP_PX)
    fit = fit_face(models.face, crop, landmarks_px, photo.shape, see_head(models, cropped))
    face = unwrap_face(models.face, fit, cropped, TEXTURE_SIDE, photo.shape)
    grey_weights = weights[..., None].expand(-1, -1, 3)
    textures = weigh_batches(
        predict_olat(models, face, directions, quotient=explain_photo(models, face)), grey_weights
    ).mean(1)  # [M, T, T]
    height, width = picture.shape
    centre_px = crop.x0_px + crop.side_px / 2, crop.y0_px + crop.side_px / 2
    camera = Camera(CROP_FOCAL_PER_SIDE * crop.side_px, width, height, *centre_px)
    uv, covered = see_face(fit.vertices_camera(models.face), camera)
    relit = sample_texture(torch.cat([textures, face.texture.mean(0)[None]]), uv).permute(2, 0, 1)
    return fill_uncovered(relit[:-1], relit[-1], torch.from_numpy(photo[..., 0]), covered)


def fill_uncovered(relit: Tensor, source: Tensor, photo: Tensor, covered: Tensor) -> Tensor:
    """Pictures [M, H, W] that go on beyond the mesh: the photo times the nearest change of light."""
    change = inpaint((relit + _DARK) / (source + _DARK) * covered, covered)
    return covered * relit + (1 - covered) * (change * (photo + _DARK) - _DARK).clamp_min(0)


if __name__ == "__main__":
    main()
