"""The training loop: draw a batch, compute losses, step, log, validate, save, resume.

An `Objective` gives the stage's batches, losses and validation; the loop is the same for all stages. Several
processes train by `torchrun --nproc-per-node N -m facerf_cli train ...`.
"""

import copy
import datetime
import logging
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, Dataset

from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.atomic import atomic_path
from facerf_cli.network.checkpoint import load_networks, save_networks
from facerf_cli.network.inputs import Batch, SourceColours, concatenate, mixed_precision
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.training.run_folder import (
    RunLog,
    State,
    averaged,
    begin,
    load_state,
    refuse_another_run,
    save_state,
    stop_on_signals,
    update_average,
)
from facerf_cli.training.settings import TrainSettings

# Entries of a checkpoint's metadata that say what its networks expect at test time (`models.py`).
INPUTS = ("source_colours", "geometry", "texture_side", "crop_px")


@dataclass(frozen=True)
class Validation:
    """Quality of the networks on held-out people."""

    metrics: dict[str, float]
    sheet: np.ndarray | None  # contact sheet [H, W, 3], scene-linear


class Objective(nn.Module):
    """A training stage: its batches, its loss terms and its validation.

    Subclasses set `held_out` and `settings` where they use `held_out_samples`; they implement `draw_one`,
    `forward` and `validate`.
    """

    chooses_by: str  # metric of `validate` (lower is better) that selects best.safetensors
    source_colours: SourceColours | None = None  # of a trained Reflectance Network's sources
    skips_networks: bool = False  # True if a batch may leave some weights without a gradient
    bf16: bool = False  # set by the loop, for `mixed_precision`
    held_out: Any  # numbers of the people that are not trained on
    settings: Any  # with `held_out_draws`, of each of them
    validation_seed: int = 12345

    def __init__(self, networks: dict[str, nn.Module], provenance: dict[str, Any]) -> None:
        """Make a stage that trains, averages and saves networks, by the names of `network/checkpoint.py`.

        provenance: of the data, for the checkpoint; 'licence' is that of the whole.
        """
        super().__init__()
        self.networks = nn.ModuleDict(networks)
        self.provenance = provenance
        self.inputs: dict[str, Any] = {}  # entries of `INPUTS`
        self._held_out_samples: list[Any] = []

    def draw(self, count: int, generator_of: Callable[..., torch.Generator], step: int) -> Batch:
        """Draw `count` samples, sample i from `generator_of(i)` alone, independent of the others.

        `generator_of(i, step)` is that of another step, for samples that share what costs much to read. A
        choice for the whole batch is drawn from `seeded(seed, step)`. Runs in data-loading workers, on the
        CPU and without the networks.
        """
        return concatenate([self.draw_one(generator_of(i)) for i in range(count)])

    def draw_one(self, generator: torch.Generator) -> Any:
        """Draw one sample of a random person, B = 1."""
        raise NotImplementedError

    def draw_held_out(self, person: int, generator: torch.Generator) -> Any:
        """Draw one sample of a held-out person, B = 1."""
        raise NotImplementedError

    def held_out_samples(self) -> list[Any]:
        """Samples of the held-out people, B = 1, drawn once."""
        if not self._held_out_samples:
            self._held_out_samples = [
                self.draw_held_out(int(person), seeded(self.validation_seed, int(person), index))
                for index in range(self.settings.held_out_draws)
                for person in self.held_out
            ]
        return self._held_out_samples

    def measure(self) -> None:
        """Measure what the losses need by the networks, once all processes have them on their device."""

    def forward(self, batch: Any) -> dict[str, Tensor]:
        """Compute the weighted terms of the loss, each a mean over samples; the loop minimises their sum."""
        raise NotImplementedError

    def validate(self) -> Validation:
        """Measure the networks on held-out people, on the same samples every time."""
        raise NotImplementedError

    def mixed_precision(self) -> torch.autocast:
        """Context for the networks in `forward`; geometry and losses need single precision."""
        return mixed_precision(self.device, self.bf16)

    @property
    def network(self) -> Any:
        """The network of a stage that trains one."""
        (network,) = self.networks.values()
        return network

    @property
    def device(self) -> torch.device:
        """Device of the networks."""
        return next(self.networks.parameters()).device


def seeded(*numbers: int) -> torch.Generator:
    """Make a CPU generator from non-negative numbers; their order and count matter, too."""
    state = int(np.random.SeedSequence((len(numbers), *numbers)).generate_state(1, np.uint64)[0])
    return torch.Generator().manual_seed(state >> 1)


def metrics_by_pose(errors: Tensor, same_pose: Tensor) -> dict[str, float]:
    """Mean Si-MSE of errors [N]: of all, and by whether the target has the source's pose [N]."""
    parts = {"": torch.ones_like(same_pose), "_same_pose": same_pose, "_other_pose": ~same_pose}
    return {f"si_mse{name}": float(errors[part].mean()) for name, part in parts.items() if part.any()}


_TIMEOUT = datetime.timedelta(hours=24)  # others wait while the first process bakes heads or validates


@contextmanager
def joined_processes() -> Iterator[None]:
    """Join torchrun's group of processes, if the environment describes one, and leave it at the end."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2 or dist.is_initialized():
        yield
        return
    # Imported once the group exists, it would keep the group (as defaults of its functions), whose threads
    # then outlive the interpreter and abort the process.
    import torch.distributed.nn

    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    dist.init_process_group(backend, timeout=_TIMEOUT)
    try:
        yield
        _meet()  # a process that leaves while others still talk to it can be aborted
    finally:
        dist.destroy_process_group()


def process_count() -> int:
    """Number of training processes."""
    return dist.get_world_size() if dist.is_initialized() else 1


def process_rank() -> int:
    """Index of this process; only process 0 writes files."""
    return dist.get_rank() if dist.is_initialized() else 0


def process_device(device: torch.device) -> torch.device:
    """GPU of this process where a machine has several; otherwise `device`."""
    if device.type != "cuda" or process_count() == 1:
        return device
    own = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
    torch.cuda.set_device(own)
    return own


@contextmanager
def first_process_first() -> Iterator[None]:
    """Run a block in process 0, then in all others at once, so that they find the files that it made."""
    if process_rank() > 0:
        _meet()
    yield
    if process_rank() == 0:
        _meet()


def _meet() -> None:
    """Wait for all processes, on the CPU, where a barrier would take a GPU."""
    mean_over_processes(torch.zeros(1))


def distributed(objective: nn.Module, skips_networks: bool) -> nn.Module:
    """Wrap the objective so that gradients are averaged over all processes; not needed for one process."""
    if process_count() == 1:
        return objective
    return DistributedDataParallel(objective, find_unused_parameters=skips_networks)


def broadcast_from_first(values: Tensor) -> Tensor:
    """The values of process 0."""
    if process_count() > 1:
        dist.broadcast(values, 0)
    return values


def mean_over_processes(values: Tensor) -> Tensor:
    """Mean of values over all processes."""
    if process_count() > 1:
        dist.all_reduce(values)
        values = values / process_count()
    return values


CPU = torch.device("cpu")
_ENDLESS = 1 << 31  # steps that the sampler lists; the loop ends the run
Row = dict[str, Any]  # of log.jsonl
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class Start:
    """Checkpoint of --start-from: the networks that the stage does not train, and the metadata."""

    carried: dict[str, nn.Module] = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)


def train(
    objective: Objective,
    folder: Path,
    settings: TrainSettings,
    start: Start = Start(),
    resume: bool = False,
    device: torch.device = CPU,
    report: Callable[[Row], None] = lambda row: None,
) -> Path:
    """Minimise an objective until the steps or the time are up; return `folder/last.safetensors`.

    On a CPU a run that ends by its steps is the same to the last digit however often it is stopped and
    resumed, for draws and dropout depend on (seed, step, index) alone. Rows go to `folder/log.jsonl` and
    `report`. Under torchrun (`training/loop.py`) every process calls this; process 0 alone writes.
    """
    if process_rank() == 0 and not resume:
        refuse_another_run(folder)
    device = process_device(device)
    objective.to(device)
    objective.networks.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    objective.bf16 = settings.bf16
    torch.backends.cudnn.benchmark = True  # the sides of images stay as they are
    objective.measure()
    state = begin(objective.networks, settings, start.metadata, objective.provenance)
    if resume and (folder / "state.pt").exists():
        load_state(folder / "state.pt", state, settings)
        saved, _ = load_networks(folder / "last.safetensors", LAYOUT_VERSION)
        start = Start({name: saved[name] for name in saved.keys() - objective.networks.keys()})
    if settings.done(state.step, state.seconds) >= 1:
        log.info("%s: complete at step %d; increase --steps or --max-time to continue", folder, state.step)
        return folder / "last.safetensors"
    with RunLog(folder, state.step) if process_rank() == 0 else nullcontext() as run_log:
        _loop(_Run(objective, folder, settings, state, start.carried, device, run_log, report))
    return folder / "last.safetensors"


@dataclass(frozen=True)
class _Run:
    """Arguments and state that all parts of the loop share."""

    objective: Objective
    folder: Path
    settings: TrainSettings
    state: State
    carried: dict[str, nn.Module]
    device: torch.device
    log: RunLog | None  # of process 0 alone
    report: Callable[[Row], None]


def _loop(run: _Run) -> None:
    """Take steps from the state's on, to the end or to a signal."""
    settings, state = run.settings, run.state
    if settings.compile:
        run.objective.compile()
    model, clock = distributed(run.objective, run.objective.skips_networks), _Clock(state.seconds)
    run.objective.networks.train()
    with stop_on_signals() as stop:
        for drawn in _draws(run):
            clock.waited_s += drawn.waited_s
            # clocks differ between processes, and all must end at one step
            local = torch.tensor([clock.seconds(), stop.signal]).double()
            seconds, signal = broadcast_from_first(local).tolist()
            row = {"step": drawn.step, "seconds": seconds}
            row |= _step(run, model, drawn, settings.done(drawn.step - 1, seconds))
            row |= {"waiting": clock.waiting()}
            state.step, state.seconds = drawn.step, clock.seconds()
            ended = bool(signal) or settings.done(state.step, seconds) >= 1
            due = not signal and (ended or state.step % settings.validate_every == 0)
            if run.log:
                with clock.stopped():
                    _write(run, row, validate=due, save=due or ended)
            if ended:
                break
        stop.leave()


def _draws(run: _Run) -> "Iterator[Drawn]":
    """This process's share of every batch after the state's step."""
    processes, settings = process_count(), run.settings
    parts = processes * settings.accumulate
    if settings.batch % parts:
        raise UsageError(
            f"--batch {settings.batch}: {processes} processes cannot share it in parts of --accumulate "
            f"{settings.accumulate}; give a multiple of {parts}"
        )
    share, pinned = settings.batch // processes, run.device.type == "cuda"
    mine, first = range(settings.batch)[process_rank() * share :][:share], run.state.step + 1
    return drawn_batches(run.objective, first, mine, settings.seed, settings.workers, pinned)


@dataclass(frozen=True)
class Drawn:
    """The batch of a step, and how long the loop waited for it."""

    step: int
    batch: Batch
    waited_s: float


def drawn_batches(
    objective: Objective, first_step: int, samples: range, seed: int, workers: int, pinned: bool = False
) -> Iterator[Drawn]:
    """Yield some samples of the batch of every step from `first_step` on.

    `workers` processes draw ahead. Each sample depends on (seed, step, index) alone.
    """
    steps = range(first_step, _ENDLESS)
    loader = DataLoader(
        _Draws(objective, samples, seed),
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        pin_memory=pinned,
        generator=torch.Generator(),  # not the global one, which would differ in a resumed run
    )
    batches = iter(loader)
    for step in steps:
        begin_s = time.monotonic()
        batch = next(batches)
        if isinstance(batch, FacerfError):
            raise batch
        yield Drawn(step, batch, time.monotonic() - begin_s)


class _Draws(Dataset[Batch | FacerfError]):
    """An objective's batches by step, for data-loading workers."""

    def __init__(self, objective: Objective, samples: range, seed: int) -> None:
        self.objective = copy.copy(objective)
        # Drawing needs no networks, so none are sent to the workers.
        self.objective.__dict__ |= {"_modules": {}, "_buffers": {}}
        self.samples, self.seed = samples, seed

    def __getitem__(self, step: int) -> Batch | FacerfError:
        def generator_of(index: int, step: int = step) -> torch.Generator:
            return seeded(self.seed, step, self.samples[index])

        try:
            return self.objective.draw(len(self.samples), generator_of, step)
        except FacerfError as error:  # returned, for the loader would turn it into a traceback
            return error


def _step(run: _Run, model: nn.Module, drawn: Drawn, done: float) -> Row:
    """Take one step down the gradient and return its log entries; raise where the loss is not finite."""
    settings, state = run.settings, run.state
    rate = settings.optimizer.learning_rate * settings.schedule.factor(drawn.step - 1, done)
    for group in state.optimizer.param_groups:
        group["lr"] = rate
    torch.manual_seed(seeded(settings.seed, drawn.step, process_rank(), 0).initial_seed())  # for dropout
    state.optimizer.zero_grad(set_to_none=True)
    terms = _gradients(model, drawn.batch, settings.accumulate, run.device)
    loss = torch.stack(list(terms.values())).sum()
    clip = settings.gradient_clip or math.inf
    norm = nn.utils.clip_grad_norm_(state.networks.parameters(), clip)
    values = mean_over_processes(torch.stack([loss, *terms.values()]))
    total, gradient, *parts = torch.cat([values[:1], norm[None], values[1:]]).tolist()
    _require_finite(run, drawn, total, gradient)
    state.optimizer.step()
    if settings.ema_decay:
        update_average(state, settings.ema_decay, drawn.step)
    return {"loss": total, "terms": dict(zip(terms, parts, strict=True)), "gradient": gradient, "rate": rate}


def _gradients(model: nn.Module, batch: Batch, parts: int, device: torch.device) -> dict[str, Tensor]:
    """Add the gradients of a batch, part by part, and return the terms of its loss.

    Processes exchange the gradients once, with the last part.
    """
    totals: dict[str, Tensor] = {}
    for number, part in enumerate(batch.parts(parts), 1):
        with (
            model.no_sync()
            if isinstance(model, DistributedDataParallel) and number < parts
            else nullcontext()
        ):
            terms = {name: term / parts for name, term in model(part.to(device)).items()}
            torch.stack(list(terms.values())).sum().backward()  # type: ignore[no-untyped-call]
        totals = {name: totals.get(name, 0) + term.detach() for name, term in terms.items()}
    return totals


def _require_finite(run: _Run, drawn: Drawn, loss: float, gradient: float) -> None:
    """Raise FacerfError for a loss or gradient that is not finite, before it changes the weights."""
    if math.isfinite(loss) and math.isfinite(gradient):
        return
    what = "loss" if not math.isfinite(loss) else "gradient"
    heads = getattr(drawn.batch, "heads", None)
    of = f", heads {heads.tolist()}" if heads is not None else ""
    kept = run.folder / "state.pt"
    raise FacerfError(
        f"the {what} is not finite at step {drawn.step} (seed {run.settings.seed}{of}); "
        + (f"the last good state is kept in {kept}" if kept.exists() else "no state was saved before it")
    )


def _write(run: _Run, row: Row, validate: bool, save: bool) -> None:
    """Validate and save if due, and write the row; the state last, so that all files it refers to exist."""
    last = run.folder / "last.safetensors"
    with averaged(run.state) if save else nullcontext():
        if validate:
            row["validation"] = _validate(run, row["step"])
        if save:
            save_networks(last, {**run.carried, **run.objective.networks}, _metadata(run, row))
    metric = row.get("validation", {}).get(run.objective.chooses_by, math.inf)
    if metric < run.state.best:
        run.state.best = metric
        with atomic_path(run.folder / "best.safetensors") as temporary:
            shutil.copyfile(last, temporary)
    assert run.log
    run.log.write(row)
    if save:
        save_state(run.folder / "state.pt", run.state, run.settings)
    run.report(row)


@torch.no_grad()
def _validate(run: _Run, step: int) -> dict[str, float]:
    run.objective.networks.eval()
    validation = run.objective.validate()
    run.objective.networks.train()
    if validation.sheet is not None and run.log:
        run.log.sheet(step, validation.sheet)
    return validation.metrics


def _metadata(run: _Run, row: Row) -> dict[str, Any]:
    """Metadata of the checkpoint, with that of --start-from as its history."""
    start, provenance = run.state.start, dict(run.objective.provenance)
    licences = [*provenance["licence"].split("; "), *start.get("licence", "").split("; ")]
    if "provenance" in start:
        provenance["started_from"] = start["provenance"]
    colours = run.objective.source_colours
    inputs = {name: start[name] for name in INPUTS if name in start} | run.objective.inputs
    leg = {
        "objective": type(run.objective).__name__,
        "networks": sorted(run.objective.networks),
        "steps_done": row["step"],
        "seconds": round(run.state.seconds, 1),
        "processes": process_count(),
        **asdict(run.settings),
    }
    return {
        **inputs,
        **({"source_colours": colours.as_metadata()} if colours else {}),
        "layout_version": LAYOUT_VERSION,
        "licence": "; ".join(dict.fromkeys(words for words in licences if words)),
        "provenance": provenance,
        "training": [*start.get("training", []), leg],
        "metrics": {"step": row["step"], "loss": row["loss"], **row.get("validation", {})},
    }


@dataclass
class _Clock:
    """Duration of a run over all resumptions, and the share of step time spent waiting for batches."""

    before_s: float
    waited_s: float = 0.0
    begun: float = field(default_factory=time.monotonic)
    paused_s: float = 0.0

    def seconds(self) -> float:
        return self.before_s + time.monotonic() - self.begun

    def waiting(self) -> float:
        return self.waited_s / max(time.monotonic() - self.begun - self.paused_s, 1e-9)

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Leave the time of the block, for validation and saving, out of the steps' time."""
        begun = time.monotonic()
        yield
        self.paused_s += time.monotonic() - begun
