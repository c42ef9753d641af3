"""Si-MSE of a checkpoint on the held-out heads of a bank: by pose, by angle of the light, by skin tone.

    python benchmarks/held_out_heads.py --bank RUN/bank [--checkpoint RUN/best.safetensors]

Every held-out head is drawn several times: skin, camera, light of the source, lights of the targets. 95 %
intervals are over heads. The network works alone, as in the validation of `facerf train`; the photo's
quotient is left out. Textures are scaled to a mean albedo of 0.25. On dark skin this lifts highlights far
above white, where they outweigh the rest, so there is a second error with both textures clipped at 1.

Naive twin: Lambert, the source's texture times the cosine of the target light, without shadows.

Skin tones are classes of the individual typology angle (ITA: Chardon et al. 1991, Del Bino and Bernerd 2013)
of the drawn albedo, before lips, brows, beard and make-up; faces of random colours have none. Tone drift is
the ITA of the relit skin less that of the true one, of the median texel under white lights near the camera's
axis. Both are exposed so that the truth is as light as its albedo.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from _common import arguments, first_heads, interval_text, print_header, print_row, required
from torch import Tensor

from facerf_cli.evaluation.metrics import TONES, mean_interval, tone_drift_deg, tone_of
from facerf_cli.face.topology import region_mask
from facerf_cli.image.colour import ita_deg
from facerf_cli.relighting.models import load_models
from facerf_cli.synth.appearance import skin
from facerf_cli.synth.appearance.people import People, draw_people
from facerf_cli.synth.bank.heads import Bank
from facerf_cli.synth.bank.texture_samples import Sample
from facerf_cli.training.losses import clipped_si_mse, si_mse
from facerf_cli.training.objective import seeded

ANGLES_DEG = (0, 30, 60, 90, 180)  # between the light and the camera
_NEAR_AXIS = float(np.cos(np.radians(25)))  # of the lights under which tone drift is measured
_SEED = 2021
_COLUMNS = ("n", "Si-MSE", "its median", "sd", "Lambert", "Si-MSE, both clipped at 1")


@dataclass(frozen=True)
class RelitTexture:
    """The errors of one relit texture of a held-out head, and its group in each table."""

    head: int
    same_pose: bool
    angle_deg: float
    tone: str | None
    si_mse: float
    clipped: float  # with both textures clipped at 1
    lambert: float
    drift_deg: float | None


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--bank", type=Path, help="folder that `facerf train --bank` filled")
    parser.add_argument("--checkpoint", type=Path, help="default: the shipped one")
    parser.add_argument("--held-out", type=int, default=12, help="heads of the bank that were not trained on")
    parser.add_argument("--draws", type=int, default=20, help="samples of each head")
    parser.add_argument("--lights", type=int, default=6, help="targets of each sample")
    given = parser.parse_args()
    bank = first_heads(required(given.bank, "a bank of heads", "--bank"), given.held_out)
    network = load_models([given.checkpoint] if given.checkpoint else ()).networks.reflectance
    textures = list(measure(network, bank, given.draws, given.lights))
    print_tables(textures)


@torch.no_grad()
def measure(network: Any, bank: Bank, draws: int, lights: int) -> Iterator[RelitTexture]:
    """Yield the errors of `draws` samples of each head; a sample depends on its head and number alone."""
    for head in range(1, len(bank.baked)):
        for number in range(draws):
            with _recorded() as people:
                sample = bank.draw(torch.tensor([head]), lights, seeded(_SEED, head, number))
            encoded = network.encode(sample.source, sample.normals_source, sample.visible)
            predicted = network.decode(encoded, sample.normals_target, sample.lights)
            yield from _errors(head, sample, predicted, people[-1])


@contextmanager
def _recorded() -> Iterator[list[People]]:
    """Record the people that are drawn; a sample itself does not hold its skin."""
    seen: list[People] = []

    def recording(count: int, generator: torch.Generator) -> People:
        seen.append(draw_people(count, generator))
        return seen[-1]

    with patch.object(skin, "draw_people", recording):
        yield seen


def _errors(head: int, sample: Sample, predicted: Tensor, person: People) -> Iterator[RelitTexture]:
    cosine = torch.einsum("blc,bcij->blij", sample.lights, sample.normals_target).clamp_min(0)
    lambert = sample.source[:, None] * cosine[:, :, None]
    measured = (
        si_mse(predicted, sample.target, sample.weight),
        clipped_si_mse(predicted, sample.target, sample.weight),
        si_mse(lambert, sample.target, sample.weight),
    )
    errors = torch.cat(measured).T.tolist()  # [L, 3]
    same = bool((sample.normals_source - sample.normals_target).abs().amax() < 1e-3)
    albedo = None if person.random_texture[0] else skin.bare_skin(person)[0].numpy()
    tone = None if albedo is None else tone_of(float(ita_deg(albedo)))
    for light, direction in enumerate(sample.lights[0]):
        drift_deg = None
        if albedo is not None and direction[2] > _NEAR_AXIS:
            drift_deg = drift_of(predicted[0, light], sample.target[0, light], sample.weight[0, 0], albedo)
        angle_deg = float(torch.rad2deg(direction[2].clamp(-1, 1).acos()))
        whole, clipped, naive = errors[light]
        yield RelitTexture(head, same, angle_deg, tone, whole, clipped, naive, drift_deg)


def drift_of(predicted: Tensor, truth: Tensor, weight: Tensor, albedo: np.ndarray) -> float | None:
    """`metrics.tone_drift_deg` of a relit skin: textures [3, T, T], weight [T, T], the skin's albedo [3]."""
    side = truth.shape[-1]
    skin = region_mask("skin", side) * region_mask("face", side) * weight
    ours, true = (texture.permute(1, 2, 0).numpy() for texture in (predicted, truth))
    return tone_drift_deg(ours, true, skin.numpy(), albedo)


def groups(
    textures: list[RelitTexture],
) -> tuple[dict[str, list[RelitTexture]], dict[str, list[RelitTexture]]]:
    """Group the textures by pose and angle, and by skin tone."""
    rows = {
        "same pose": [t for t in textures if t.same_pose],
        "different pose": [t for t in textures if not t.same_pose],
    }
    for low, high in pairwise(ANGLES_DEG):
        rows[f"{low} to {high} deg"] = [t for t in textures if low <= t.angle_deg < high]
    tones = {tone: [t for t in textures if t.tone == tone] for tone in TONES}
    tones["random colours"] = [t for t in textures if t.tone is None]
    return rows, tones


def print_tables(textures: list[RelitTexture]) -> None:
    """Print both tables in Markdown, as they are in docs/results.md."""
    rows, tones = groups(textures)
    print_header("held-out heads", *_COLUMNS)
    for name, chosen in rows.items():
        if chosen:
            print_row(name, *_cells(chosen))
    print()
    print_header("skin", *_COLUMNS, "tone drift, degrees of ITA", "its size")
    for name, chosen in tones.items():
        if chosen:
            print_row(name, *_cells(chosen), *_drift_cells(chosen))


def _cells(chosen: list[RelitTexture]) -> list[str]:
    si_mse, clipped, lambert = (
        mean_interval((t.head, getattr(t, name)) for t in chosen) for name in ("si_mse", "clipped", "lambert")
    )
    assert si_mse and clipped and lambert
    spread = f"{si_mse.median:.5f}", f"{si_mse.sd:.5f}", f"{lambert.mean:.5f}"
    return [f"{len(chosen)}", interval_text(si_mse, ".5f"), *spread, interval_text(clipped, ".5f")]


def _drift_cells(chosen: list[RelitTexture]) -> list[str]:
    drifts = [(t.head, t.drift_deg) for t in chosen if t.drift_deg is not None]
    size = mean_interval((head, abs(deg)) for head, deg in drifts)
    return [interval_text(mean_interval(drifts), "+.1f"), "" if size is None else f"{size.mean:.1f}"]


if __name__ == "__main__":
    main()
