"""Steps of training per second, beside a bare loop of the same network and loss on one batch in memory.

    python benchmarks/training_speed.py --bank RUN/bank [--dataset DATASET] [--presets default tiny paper]

Both run by turns in this process, a round of steps each, so that whatever else the machine does falls on both
alike; the first step of a round, whose batch nobody began ahead, and the last, which saves, are left out.
The bare loop only goes forward, back, and down the gradient: no drawing, clipping, averaging, logging.
`waiting` is the share of the loop's time in which it waits for batches. The processor's time is shown beside
the clock's, for a busy machine. The preset `paper` wants a prepared dataset; its VGG networks have random
weights here, which cost the same.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from synthetic import held_out_bank

from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.face.morphable import load_face_model
from facerf_cli.network.feature_networks import LightNetwork, VggFeatures
from facerf_cli.network.geometry import GeometryNetwork, GeometryNetworkSettings
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.network.reflectance_paper import PaperReflectanceNetwork
from facerf_cli.training.joint_objective import JointObjective
from facerf_cli.training.loop import train
from facerf_cli.training.objective import Objective, Validation, seeded
from facerf_cli.training.settings import PRESETS, TrainSettings
from facerf_cli.training.state import build_optimizer
from facerf_cli.training.texture_objective import TextureObjective

_HEADS = 40  # of the bank, besides the mean face: a step does not depend on how many there are
_TINY_WIDTHS = (8, 12, 16)  # as `facerf train --preset tiny` has them
TINY_NETWORK = DefaultReflectanceSettings(32, _TINY_WIDTHS, _TINY_WIDTHS, template_channels=2)
_NEVER = 1_000_000_000
Times = np.ndarray  # [N, 2] seconds of steps: by the clock, and of the processor


def main() -> None:
    given = _arguments()
    torch.set_num_threads(given.threads)
    presets = {}
    for name in given.presets:
        settings = replace(PRESETS[name], workers=given.workers)
        presets[name] = measure(build(name, given.bank, given.dataset), settings, given.steps, given.rounds)
        print(_line(name, presets[name]), flush=True)
    found = {"presets": presets, "workers": given.workers, "threads": given.threads}
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")


def measure(objective: Objective, settings: TrainSettings, steps: int, rounds: int) -> dict[str, float]:
    """Rates of a preset's loop and of the bare one, and the share of waiting."""
    objective.validate = lambda: Validation({objective.chooses_by: 0.0}, None)  # type: ignore[method-assign]
    objective.networks.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    objective.bf16 = settings.bf16
    objective.provenance = {"licence": "none: a benchmark"}
    step = _bare_step(objective, settings)
    bare, ours, waiting = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(rounds):
            bare.append(_timed(step, steps))
            until = replace(settings, steps=(number + 1) * steps, validate_every=_NEVER)
            watch = _Watch()
            train(objective, Path(folder), until, resume=number > 0, report=watch)
            ours.append(_without_ends(watch.times))
            waiting.append(watch.waiting)
    return _rates(np.concatenate(ours), np.concatenate(bare)) | {"waiting": float(np.mean(waiting))}


class _Watch:
    """Notes when each step of the loop ends."""

    def __init__(self) -> None:
        self.times, self.waiting = [_now()], 0.0

    def __call__(self, row: dict[str, Any]) -> None:
        self.times.append(_now())
        self.waiting = row["waiting"]


def _now() -> tuple[float, float]:
    return time.monotonic(), time.process_time()


def _bare_step(objective: Objective, settings: TrainSettings) -> Callable[[], None]:
    """A step on one batch that is drawn here."""
    batch = objective.draw(settings.batch, lambda index: seeded(settings.seed, 1, index), 1)
    optimizer = build_optimizer(settings.optimizer, objective.networks.parameters())

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        torch.stack(list(objective(batch).values())).sum().backward()  # type: ignore[no-untyped-call]
        optimizer.step()

    return step


def _timed(step: Callable[[], None], steps: int) -> Times:
    times = [_now()]
    for _ in range(steps):
        step()
        times.append(_now())
    return _without_ends(times)


def _without_ends(times: list[tuple[float, float]]) -> Times:
    """How long each step took, but for the first and the last."""
    return np.diff(times, axis=0)[1:-1]


def _rates(ours: Times, bare: Times) -> dict[str, float]:
    our_s, our_cpu_s = ours.mean(0).tolist()
    bare_s, bare_cpu_s = bare.mean(0).tolist()
    return {
        "steps_per_s": 1 / our_s,
        "bare_steps_per_s": 1 / bare_s,
        "ratio": bare_s / our_s,
        "processor_ratio": bare_cpu_s / our_cpu_s,
        "processor_steps_per_s": 1 / our_cpu_s,
    }


def build(name: str, bank: Path | None, dataset: Path | None) -> Objective:
    """What a preset minimises, untrained."""
    if name == "paper":
        return _paper(_needed(dataset, "--dataset"))
    heads, _ = held_out_bank(_needed(bank, "--bank"), "builtin", _HEADS)
    network = DefaultReflectanceNetwork(TINY_NETWORK) if name == "tiny" else DefaultReflectanceNetwork()
    return TextureObjective(heads, network)


def _needed(path: Path | None, option: str) -> Path:
    if path is None:
        raise SystemExit(f"this preset wants {option}")
    return path


def _paper(folder: Path) -> Objective:
    """Both networks of the paper, V_f and S_f, without photos: their batches cost less."""
    dataset, model = read_dataset(folder), load_face_model()
    geometry = GeometryNetwork(GeometryNetworkSettings("paper", len(model.identity), len(model.expression)))
    networks = PaperReflectanceNetwork(), geometry, VggFeatures(), LightNetwork()
    return JointObjective(dataset, model, *networks)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--bank", type=Path, help="folder that `facerf train` filled")
    add("--dataset", type=Path, help="prepared, with pairs")
    add("--presets", nargs="+", default=["default", "tiny"], choices=list(PRESETS))
    add("--steps", type=int, default=20, help="of a round")
    add("--rounds", type=int, default=3)
    add("--workers", type=int, default=0, help="processes that draw batches")
    add("--threads", type=int, default=torch.get_num_threads())
    add("--json", type=Path, help="write all figures here")
    given = parser.parse_args()
    if given.steps < 5:
        parser.error("--steps: five at the least, two of which are left out")
    return given


def _line(name: str, row: dict[str, float]) -> str:
    return (
        f"{name:8} {row['steps_per_s']:6.2f} steps a second, bare {row['bare_steps_per_s']:6.2f}, ratio "
        f"{row['ratio']:.2f} (of processor time {row['processor_ratio']:.2f}), waiting "
        f"{100 * row['waiting']:.1f} %"
    )


if __name__ == "__main__":
    main()
