"""Steps of training a second, next to a bare loop of the same network and loss on one batch in memory.

    python benchmarks/training_speed.py --bank RUN/bank [--dataset DATASET --presets default tiny paper]

Both loops take turns in this process. The first step of a round, whose batch nothing drew ahead, and the last
one, which saves, are left out. The bare loop goes forward, backward and down the gradient: no drawing,
clipping, averaging or logging. `waiting` is the share of time in which the loop waits for batches. The ratio
is also given in processor time, which a busy machine does not disturb. The preset `paper` needs a prepared
dataset; its VGG networks have random weights here, which cost the same.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _common import arguments, first_heads, print_header, print_row, required

from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.face.morphable import load_face_model
from facerf_cli.network.features import LightNetwork, VggFeatures
from facerf_cli.network.geometry import GeometryNetwork, GeometryNetworkSettings
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.network.reflectance_paper import PaperReflectanceNetwork
from facerf_cli.training.joint import JointObjective
from facerf_cli.training.loop import build_optimizer, train
from facerf_cli.training.objective import Objective, Validation, seeded
from facerf_cli.training.settings import PRESETS, TrainSettings
from facerf_cli.training.texture import TextureObjective

_TINY_WIDTHS = (8, 12, 16)  # as in `facerf train --preset tiny`
TINY_NETWORK = DefaultReflectanceSettings(32, _TINY_WIDTHS, _TINY_WIDTHS, template_channels=2)
_NEVER = 1_000_000_000  # steps between validations
_LEAST_STEPS = 5  # of a round, two of which are left out
Times = np.ndarray  # [N, 2] seconds of steps: by the clock, and of the processor


def main() -> None:
    parser = arguments(__doc__)
    add = parser.add_argument
    add("--bank", type=Path, help="folder that `facerf train --bank` filled")
    add("--heads", type=int, default=40, help="of the bank; a step does not depend on how many there are")
    add("--dataset", type=Path, help="prepared, with pairs, for the preset paper")
    add("--presets", nargs="+", default=["default", "tiny"], choices=list(PRESETS))
    add("--steps", type=int, default=20, help="of a round")
    add("--rounds", type=int, default=3)
    add("--workers", type=int, default=0, help="processes that draw batches")
    add("--threads", type=int, default=torch.get_num_threads())
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    objectives = {name: build(name, given.bank, given.heads, given.dataset) for name in given.presets}
    print_header("preset", "steps a second", "bare loop", "ratio", "of processor time", "waiting on data")
    for name, objective in objectives.items():
        settings = replace(PRESETS[name], workers=given.workers)
        ours, bare, waiting = measure(objective, settings, max(given.steps, _LEAST_STEPS), given.rounds)
        (our_s, our_cpu_s), (bare_s, bare_cpu_s) = ours.mean(0), bare.mean(0)
        ratios = f"{bare_s / our_s:.2f}", f"{bare_cpu_s / our_cpu_s:.2f}"
        print_row(name, f"{1 / our_s:.2f}", f"{1 / bare_s:.2f}", *ratios, f"{100 * waiting:.1f} %")


def measure(
    objective: Objective, settings: TrainSettings, steps: int, rounds: int
) -> tuple[Times, Times, float]:
    """Times of the steps of a preset's loop and of the bare one, and the share of waiting."""
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
    return np.concatenate(ours), np.concatenate(bare), float(np.mean(waiting))


class _Watch:
    """Note when each step of the loop ends."""

    def __init__(self) -> None:
        self.times, self.waiting = [_now()], 0.0

    def __call__(self, row: dict[str, Any]) -> None:
        self.times.append(_now())
        self.waiting = row["waiting"]


def _now() -> tuple[float, float]:
    return time.monotonic(), time.process_time()


def _bare_step(objective: Objective, settings: TrainSettings) -> Callable[[], None]:
    """Make a step on one batch that is drawn here."""
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
    """The duration of each step, except the first and the last."""
    return np.diff(times, axis=0)[1:-1]


def build(name: str, bank: Path | None, heads: int, dataset: Path | None) -> Objective:
    """Make the untrained objective of a preset."""
    if name == "paper":
        return _paper(required(dataset, "a prepared dataset", "--dataset"))
    source = first_heads(required(bank, "a bank of heads", "--bank"), heads)
    settings = TINY_NETWORK if name == "tiny" else DefaultReflectanceSettings()
    settings = replace(settings, rig_lights=len(source.baked[0].directions))
    return TextureObjective(source, DefaultReflectanceNetwork(settings))


def _paper(folder: Path) -> Objective:
    """Both networks of the paper, V_f and S_f, without photos: their batches cost less."""
    dataset, model = read_dataset(folder), load_face_model()
    geometry = GeometryNetwork(GeometryNetworkSettings("paper", len(model.identity), len(model.expression)))
    networks = PaperReflectanceNetwork(), geometry, VggFeatures(), LightNetwork()
    return JointObjective(dataset, model, *networks)


if __name__ == "__main__":
    main()
