"""Si-MSE of a checkpoint on the held-out heads of a bank: by pose, by the light's angle, by skin tone.

    python benchmarks/synthetic.py --bank RUN/bank [--checkpoint RUN/best.safetensors] [--json FILE]

Every held-out head is drawn DRAWS times: skin, camera, source light and target lights. Intervals are over
heads. Textures are scaled to a mean albedo of 0.25, which on dark skin lifts highlights far above white, and
they outweigh the rest; so errors stand there twice, once with both clipped at 1. Beside it a naive twin:
the source's own texture, shaded by Lambert's cosine without shadows. This is the network alone, as training
validates it: what holds the field to its photo (`pipeline.explain_photo`) is left out.

Skin tones are classes of the individual typology angle (ITA: Chardon et al. 1991, Del Bino and Bernerd 2013)
of the albedo that was drawn, before lips, brows, beard and make-up; faces of random colours have none. Tone
drift is ITA of the relit skin less that of the truth, of its median texel under white lights near the
camera's axis, both exposed so that the truth is as light as its albedo. Grey pictures have no ITA.
"""

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from facerf_cli.face.topology import region_mask
from facerf_cli.metrics import TONES, Interval, ita_deg, mean_interval, tone_drift_deg, tone_of
from facerf_cli.pipeline import load_models
from facerf_cli.synth.appearance import skin as appearance
from facerf_cli.synth.appearance.people import People, draw_people
from facerf_cli.synth.head_fields import head_fields
from facerf_cli.synth.heads_bank import Bank
from facerf_cli.synth.texture_samples import Sample
from facerf_cli.training.losses import clipped_si_mse, si_mse
from facerf_cli.training.objective import seeded

HELD_OUT = 12  # as `facerf train` holds out
ANGLES_DEG = (0, 30, 60, 90, 180)  # between the light and the camera
_NEAR_AXIS = float(np.cos(np.radians(25)))
_SEED = 2021


@dataclass(frozen=True)
class LinearImage:
    """One relit texture of a held-out head, and what is known of it."""

    head: int
    same_pose: bool
    angle_deg: float
    tone: str | None
    si_mse: float
    clipped: float  # the same, of both clipped at 1
    lambert: float
    drift_deg: float | None


def main() -> None:
    given = _arguments()
    bank, heads = held_out_bank(given.bank, given.fit_with, given.held_out)
    network = load_models(given.checkpoint, "builtin", torch.device("cpu")).network
    images = list(measure(network, bank, heads, given.draws, given.lights))
    found = summary(images) | {"checkpoint": str(given.checkpoint or "shipped")}
    print(table(found))
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--bank", type=Path, required=True, help="folder that `facerf train` filled")
    add("--fit-with", default="builtin", help="the name of the face model of its views")
    add("--checkpoint", type=Path, help="default: the one shipped")
    add("--held-out", type=int, default=HELD_OUT, help="heads after the mean face that were not trained on")
    add("--draws", type=int, default=40, help="samples of each head")
    add("--lights", type=int, default=8, help="targets of each sample")
    add("--json", type=Path, help="write all figures here")
    return parser.parse_args()


def held_out_bank(folder: Path, fit_with: str, count: int) -> tuple[Bank, Tensor]:
    """The mean face and the `count` heads after it, without the rest of the bank; and their numbers."""
    views = folder / f"views-{fit_with}"
    paths = [
        path for path in sorted((folder / "heads").glob("*.safetensors")) if (views / path.name).exists()
    ]
    if len(paths) <= count:
        raise SystemExit(f"{folder}: {len(paths)} heads with {views.name}, {count + 1} are needed")
    held = paths[: count + 1]
    baked = [head_fields(load_file(path)) for path in held]
    return Bank(baked, [load_file(views / path.name) for path in held], {}), torch.arange(1, count + 1)


@torch.no_grad()
def measure(network: Any, bank: Bank, heads: Tensor, draws: int, lights: int) -> Iterator[LinearImage]:
    """Every head `draws` times; a sample depends on its head and number alone."""
    for head in heads.tolist():
        for number in range(draws):
            with _recorded() as people:
                sample = bank.draw(torch.tensor([head]), lights, seeded(_SEED, head, number))
            encoded = network.encode(sample.source, sample.normals_source, sample.visible)
            predicted = network.decode(encoded, sample.normals_target, sample.lights)
            yield from _images(head, sample, predicted, people[-1])


@contextmanager
def _recorded() -> Iterator[list[People]]:
    """Whom the stage paints meanwhile: a sample itself does not say."""
    seen: list[People] = []

    def recording(count: int, generator: torch.Generator) -> People:
        seen.append(draw_people(count, generator))
        return seen[-1]

    with patch.object(appearance, "draw_people", recording):
        yield seen


def _images(head: int, sample: Sample, predicted: Tensor, person: People) -> Iterator[LinearImage]:
    cosine = torch.einsum("blc,bcij->blij", sample.lights, sample.normals_target).clamp_min(0)
    lambert = sample.source[:, None] * cosine[:, :, None]
    measured = (
        si_mse(predicted, sample.target, sample.weight),
        clipped_si_mse(predicted, sample.target, sample.weight),
        si_mse(lambert, sample.target, sample.weight),
    )
    errors = torch.cat(measured).T.tolist()  # [L, 3]
    same = bool((sample.normals_source - sample.normals_target).abs().amax() < 1e-3)
    albedo = None if person.random_texture[0] else appearance.bare_skin(person)[0].numpy()
    tone = None if albedo is None else tone_of(float(ita_deg(albedo)))
    for light, direction in enumerate(sample.lights[0]):
        drift_deg = None
        if albedo is not None and direction[2] > _NEAR_AXIS:
            drift_deg = drift_of(predicted[0, light], sample.target[0, light], sample.weight[0, 0], albedo)
        angle_deg = float(torch.rad2deg(direction[2].clamp(-1, 1).acos()))
        whole, clipped, naive = errors[light]
        yield LinearImage(head, same, angle_deg, tone, whole, clipped, naive, drift_deg)


def drift_of(predicted: Tensor, truth: Tensor, weight: Tensor, albedo: np.ndarray) -> float | None:
    """`metrics.tone_drift_deg` of a relit skin: textures [3, T, T], weight [T, T], the skin's albedo [3]."""
    side = truth.shape[-1]
    skin = region_mask("skin", side) * region_mask("face", side) * weight
    ours, true = (image.permute(1, 2, 0).numpy() for image in (predicted, truth))
    return tone_drift_deg(ours, true, skin.numpy(), albedo)


def summary(images: list[LinearImage]) -> dict[str, Any]:
    """Figures by row, each with its interval over heads."""
    rows = {
        "same pose": [p for p in images if p.same_pose],
        "different pose": [p for p in images if not p.same_pose],
    }
    for low, high in pairwise(ANGLES_DEG):
        rows[f"{low} to {high} deg"] = [p for p in images if low <= p.angle_deg < high]
    tones = {tone: [p for p in images if p.tone == tone] for tone in TONES}
    tones["random colours"] = [p for p in images if p.tone is None]
    return {
        "rows": {name: _errors(chosen) for name, chosen in rows.items()},
        "tones": {name: _errors(chosen) | _drifts(chosen) for name, chosen in tones.items()},
    }


def _errors(images: list[LinearImage]) -> dict[str, Any]:
    measures = ("si_mse", "clipped", "lambert")
    return {name: _plain(mean_interval((p.head, getattr(p, name)) for p in images)) for name in measures}


def _drifts(images: list[LinearImage]) -> dict[str, Any]:
    drifts = [(p.head, p.drift_deg) for p in images if p.drift_deg is not None]
    size = mean_interval((head, abs(drift)) for head, drift in drifts)
    return {"drift_deg": _plain(mean_interval(drifts)), "drift_size_deg": _plain(size)}


def _plain(interval: Interval | None) -> dict[str, float] | None:
    return None if interval is None else interval.as_dict()


def table(found: dict[str, Any]) -> str:
    """The figures for reading."""
    head = f"{'':16}{'n':>6}{'Si-MSE':>10}   {'95 % interval':19}"
    head += f"{'median':>9}{'sd':>9}{'Lambert':>9}{'ratio':>7}   clipped [95 % interval]  "
    lines = [f"held-out heads, {found['checkpoint']}", head]
    lines += [_line(name, row) for name, row in found["rows"].items() if row["si_mse"]]
    lines += ["", f"{head}   tone drift, degrees of ITA: mean [interval], mean size, n"]
    lines += [_line(name, row) + _drift(row) for name, row in found["tones"].items() if row["si_mse"]]
    return "\n".join(lines)


def _line(name: str, row: dict[str, Any]) -> str:
    ours, clip, naive = row["si_mse"], row["clipped"], row["lambert"]["mean"]
    return (
        f"{name:16}{ours['pictures']:6}{ours['mean']:10.5f}   "
        f"[{ours['low']:.5f}, {ours['high']:.5f}]{ours['median']:9.5f}{ours['sd']:9.5f}{naive:9.5f}"
        f"{ours['mean'] / naive:7.2f}   {clip['mean']:.5f} [{clip['low']:.5f}, {clip['high']:.5f}]"
    )


def _drift(row: dict[str, Any]) -> str:
    drift, size = row["drift_deg"], row["drift_size_deg"]
    if drift is None:
        return ""
    return (
        f"   {drift['mean']:+6.1f} [{drift['low']:+.1f}, {drift['high']:+.1f}], "
        f"{size['mean']:.1f}, {drift['pictures']}"
    )


if __name__ == "__main__":
    main()
