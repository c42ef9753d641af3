"""The training loop: draw a batch, compute losses, step, log, validate, save, resume.

An `Objective` gives the stage's batches, losses and validation; the loop is the same for all stages. Several
processes train by `torchrun` (`training/processes.py`).
"""

import copy
import logging
import math
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, Dataset

from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.workarounds import read_in_one_thread
from facerf_cli.network.checkpoint import load_networks, save_networks
from facerf_cli.network.inputs import Batch
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.training.objective import INPUTS, Objective, seeded
from facerf_cli.training.processes import (
    broadcast_from_first,
    distributed,
    mean_over_processes,
    process_count,
    process_device,
    process_rank,
)
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

CPU = torch.device("cpu")
_ENDLESS = 1 << 31  # steps that the sampler lists; the loop ends the run
_PATIENCE_S = 30  # of workers that are asked to end: as long as Slurm waits
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
    `report`. Under torchrun (`training/processes.py`) every process calls this; process 0 alone writes.
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
    if workers:
        read_in_one_thread()
    loader = DataLoader(
        _Draws(objective, samples, seed),
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        pin_memory=pinned,
        worker_init_fn=_leave_signals,
        generator=torch.Generator(),  # not the global one, which would differ in a resumed run
    )
    batches = iter(loader)
    try:
        for step in steps:
            begin_s = time.monotonic()
            batch = next(batches)
            if isinstance(batch, FacerfError):
                raise batch
            yield Drawn(step, batch, time.monotonic() - begin_s)
    finally:
        del batches  # ends its workers, though a traceback may hold this frame


def _leave_signals(_: int) -> None:
    """Let a worker draw on for a while when all processes of a job are asked to end: the run ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, lambda *_: signal.alarm(_PATIENCE_S))


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
            run.objective.networks.eval()
            with torch.no_grad():
                validation = run.objective.validate()
            run.objective.networks.train()
            if validation.sheet is not None and run.log:
                run.log.sheet(row["step"], validation.sheet)
            row["validation"] = validation.metrics
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
