"""Run the training loop: draw a batch, compute losses, step, log, validate, save, resume.

An `Objective` provides the stage's batches, losses and validation; the loop is the same for all stages. With
torchrun, several processes train together (`training/processes.py`).
"""

import copy
import json
import logging
import math
import pickle
import shutil
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, Dataset

from facerf_cli.batch.recipe import Recipe, recipe_of, require_same
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.texts import file_sha256
from facerf_cli.files.workarounds import read_in_one_thread
from facerf_cli.network.batch import Batch
from facerf_cli.network.checkpoint import load_networks, save_networks
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
from facerf_cli.training.run_folder import RunLog, refuse_another_run, stop_on_signals
from facerf_cli.training.settings import Adadelta, AdamW, TrainSettings

CPU = torch.device("cpu")
_FORMAT = "facerf-state-2"
_ENDLESS = 1 << 31  # steps that the sampler lists; the loop ends the run
_PATIENCE_S = 30  # that workers asked to end continue for: as long as Slurm waits
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

    On a CPU, a run that ends by its steps is bit-identical however often it is interrupted and resumed,
    because draws and dropout depend only on (seed, step, index). Rows go to `folder/log.jsonl` and `report`.
    Under torchrun (`training/processes.py`) every process calls this; only process 0 writes.
    """
    if process_rank() == 0 and not resume:
        refuse_another_run(folder)
    return Trainer(objective, folder, settings, start, device, report).fit(resume)


class Trainer:
    """State of a run between two steps, and the methods that take a step."""

    def __init__(
        self,
        objective: Objective,
        folder: Path,
        settings: TrainSettings,
        start: Start,
        device: torch.device,
        report: Callable[[Row], None],
    ) -> None:
        self.objective, self.networks, self.settings = objective, objective.networks, settings
        self.folder, self.last, self.state_path = folder, folder / "last.safetensors", folder / "state.pt"
        self.carried, self.start, self.report = start.carried, start.metadata, report
        self.device = process_device(device)
        objective.to(self.device)
        objective.networks.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        objective.bf16 = settings.bf16
        torch.backends.cudnn.benchmark = True  # the sides of images do not change
        objective.measure()
        self.optimizer = build_optimizer(settings.optimizer, self.networks.parameters())
        self.average = [tensor.clone() for tensor in self._floats()] if settings.ema_decay else []
        self.step, self.best = 0, math.inf  # steps done; lowest validation metric
        self.seconds = 0.0  # duration of these steps, over all resumptions
        self.waited_s = self.paused_s = 0.0  # for batches; for validation and saving

    def fit(self, resume: bool) -> Path:
        """Take steps to the end or to a signal; return the last checkpoint."""
        if resume and self.state_path.exists():
            self._load_state()
        settings, before_s = self.settings, self.seconds
        if settings.done(self.step, self.seconds) >= 1:
            words = "%s: complete at step %d; increase --steps or --max-time to continue"
            log.info(words, self.folder, self.step)
            return self.last
        if settings.compile:
            self.objective.compile()
        model, begun = distributed(self.objective, self.objective.skips_networks), time.monotonic()
        self.networks.train()
        is_first = process_rank() == 0
        with (
            RunLog(self.folder, self.step) if is_first else nullcontext() as run_log,
            stop_on_signals() as stop,
        ):
            for step, batch, waited_s in self._batches():
                self.waited_s += waited_s
                # clocks differ between processes, and all must end at the same step
                local = torch.tensor([before_s + time.monotonic() - begun, stop.signal]).double()
                seconds, stopped = broadcast_from_first(local).tolist()
                row = {"step": step, "seconds": seconds}
                row |= self._take_step(model, step, batch, settings.done(step - 1, seconds))
                now = time.monotonic()
                row["waiting"] = self.waited_s / max(now - begun - self.paused_s, 1e-9)
                self.step, self.seconds = step, before_s + now - begun
                ended = bool(stopped) or settings.done(step, seconds) >= 1
                due = not stopped and (ended or step % settings.validate_every == 0)
                if run_log:
                    self._write(run_log, row, validate=due, save=due or ended)
                    self.paused_s += time.monotonic() - now
                if ended:
                    break
            stop.leave()
        return self.last

    def _batches(self) -> Iterator[tuple[int, Batch, float]]:
        """Yield this process's share of every batch after `step`."""
        processes, settings = process_count(), self.settings
        parts = processes * settings.accumulate
        if settings.batch % parts:
            raise UsageError(
                f"--batch {settings.batch}: {processes} processes cannot share it in parts of --accumulate "
                f"{settings.accumulate}; use a multiple of {parts}"
            )
        share, pinned = settings.batch // processes, self.device.type == "cuda"
        mine = range(settings.batch)[process_rank() * share :][:share]
        return drawn_batches(self.objective, self.step + 1, mine, settings.seed, settings.workers, pinned)

    def _take_step(self, model: nn.Module, step: int, batch: Batch, done: float) -> Row:
        """Take one step down the gradient and return its log entries; raise if the loss is not finite."""
        settings = self.settings
        rate = settings.optimizer.learning_rate * settings.schedule.factor(step - 1, done)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        torch.manual_seed(seeded(settings.seed, step, process_rank(), 0).initial_seed())  # for dropout
        self.optimizer.zero_grad(set_to_none=True)
        terms = self._gradients(model, batch)
        loss = torch.stack(list(terms.values())).sum()
        norm = nn.utils.clip_grad_norm_(self.networks.parameters(), settings.gradient_clip or math.inf)
        values = mean_over_processes(torch.stack([loss, *terms.values()]))
        total, gradient, *parts = torch.cat([values[:1], norm[None], values[1:]]).tolist()
        if not (math.isfinite(total) and math.isfinite(gradient)):  # before it changes the weights
            what = "gradient" if math.isfinite(total) else "loss"
            people = getattr(batch, "people", None)
            of = f", people {people.tolist()}" if people is not None else ""
            kept = f"the last good state is kept in {self.state_path}"
            kept = kept if self.state_path.exists() else "no state was saved before it"
            raise FacerfError(f"the {what} is not finite at step {step} (seed {settings.seed}{of}); {kept}")
        self.optimizer.step()
        if settings.ema_decay:
            self._update_average(min(settings.ema_decay, step / (step + 10)))
        return {
            "loss": total,
            "terms": dict(zip(terms, parts, strict=True)),
            "gradient": gradient,
            "rate": rate,
        }

    def _gradients(self, model: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Add the gradients of a batch, part by part, and return the terms of its loss.

        Processes exchange the gradients once, with the last part.
        """
        totals: dict[str, Tensor] = {}
        parts = self.settings.accumulate
        for number, part in enumerate(batch.parts(parts), 1):
            waits = isinstance(model, DistributedDataParallel) and number < parts
            with model.no_sync() if waits else nullcontext():  # type: ignore[operator]
                terms = model(part.to(self.device))
                if not (isinstance(terms, dict) and terms and all(map(_is_number, terms.values()))):
                    advice = "return a dict of tensors without dimensions"
                    raise UsageError(f"{type(self.objective).__name__}.forward: no terms of a loss; {advice}")
                terms = {name: term / parts for name, term in terms.items()}
                torch.stack(list(terms.values())).sum().backward()  # type: ignore[no-untyped-call]
            totals = {name: totals.get(name, 0) + term.detach() for name, term in terms.items()}
        return totals

    def _write(self, run_log: RunLog, row: Row, validate: bool, save: bool) -> None:
        """Validate and save if due, and log the row; the state is last, so that all its files exist."""
        with self._averaged() if save else nullcontext():
            if validate:
                self.networks.eval()
                with torch.no_grad():
                    validation = self.objective.validate()
                self.networks.train()
                if validation.sheet is not None:
                    run_log.sheet(row["step"], validation.sheet)
                row["validation"] = validation.metrics
            if save:
                save_networks(self.last, {**self.carried, **self.networks}, self._metadata(row))
        metric = row.get("validation", {}).get(self.objective.chooses_by, math.inf)
        if metric < self.best:
            self.best = metric
            with atomic_path(self.folder / "best.safetensors") as temporary:
                shutil.copyfile(self.last, temporary)
        run_log.write(row)
        if save:
            self._save_state()
        self.report(row)

    def _metadata(self, row: Row) -> dict[str, Any]:
        """Return the metadata of the checkpoint, with --start-from's as its history."""
        start, provenance, colours = (
            self.start,
            dict(self.objective.provenance),
            self.objective.source_colours,
        )
        licences = [*provenance["licence"].split("; "), *start.get("licence", "").split("; ")]
        if "provenance" in start:
            provenance["started_from"] = start["provenance"]
        training = {
            "objective": type(self.objective).__name__,
            "networks": sorted(self.networks),
            "steps_done": row["step"],
            "seconds": round(self.seconds, 1),
            "processes": process_count(),
            **asdict(self.settings),
        }
        return {
            **{name: start[name] for name in INPUTS if name in start},
            **self.objective.inputs,
            **({"source_colours": asdict(colours)} if colours else {}),
            "layout_version": LAYOUT_VERSION,
            "licence": "; ".join(dict.fromkeys(words for words in licences if words)),
            "provenance": provenance,
            "training": [*start.get("training", []), training],
            "metrics": {"step": row["step"], "loss": row["loss"], **row.get("validation", {})},
        }

    def _floats(self) -> list[Tensor]:
        return [tensor for tensor in self.networks.state_dict().values() if tensor.is_floating_point()]

    @torch.no_grad()
    def _update_average(self, decay: float) -> None:
        for mean, tensor in zip(self.average, self._floats(), strict=True):
            mean.lerp_(tensor, 1 - decay)

    @contextmanager
    def _averaged(self) -> Iterator[None]:
        """Give the networks their averaged weights within the block, to validate and save them."""
        kept = [tensor.clone() for tensor in self._floats()] if self.average else []
        self._copy_to_networks(self.average)
        try:
            yield
        finally:
            self._copy_to_networks(kept)

    @torch.no_grad()
    def _copy_to_networks(self, values: list[Tensor]) -> None:
        for tensor, value in zip(self._floats(), values, strict=bool(values)):
            tensor.copy_(value)

    def _recipe(self) -> Recipe:
        """Return what a run and its resumption must have in common, by the names of options."""
        recipe = recipe_of(self.settings, file_sha256)
        del recipe["results"]  # of commands that write images
        return {"optimizer": type(self.settings.optimizer).__name__, **recipe}

    def _save_state(self) -> None:
        content = {
            "format": _FORMAT,
            "networks": self.networks.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "average": self.average,
            "step": self.step,
            "seconds": self.seconds,
            "best": self.best,
            "start": json.dumps(self.start),
            "provenance": json.dumps(self.objective.provenance),
            "settings": json.dumps(self._recipe()),
        }
        with atomic_path(self.state_path) as temporary:
            torch.save(content, temporary)

    def _load_state(self) -> None:
        """Load what `_save_state` wrote; raise UsageError if the run began with other settings or data."""
        try:
            content = torch.load(self.state_path, map_location="cpu", weights_only=True)
            if content["format"] != _FORMAT:
                raise ValueError("another version's file")
            advice = "resume it with the same options"
            require_same(
                json.loads(content["settings"]),
                self._recipe(),
                f"{self.folder}: the run began otherwise",
                advice,
            )
            if content["provenance"] != json.dumps(self.objective.provenance):
                raise UsageError(
                    f"{self.folder}: the run began with other data; resume it with the same data"
                )
            self.networks.load_state_dict(content["networks"])
            self.optimizer.load_state_dict(content["optimizer"])
            for mean, saved in zip(self.average, content["average"], strict=True):
                mean.copy_(saved)
            self.step, self.seconds, self.best = content["step"], content["seconds"], content["best"]
            self.start = json.loads(content["start"])
        except FacerfError:
            raise
        except (pickle.UnpicklingError, EOFError, KeyError, RuntimeError, TypeError, ValueError) as error:
            words = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(
                f"{self.state_path}: cannot be resumed ({words}); start another run with --start-from "
                "last.safetensors"
            ) from None
        networks, _ = load_networks(self.last, LAYOUT_VERSION)
        self.carried = {name: networks[name] for name in networks.keys() - self.networks.keys()}


def _is_number(term: Any) -> bool:
    return isinstance(term, Tensor) and term.ndim == 0


def build_optimizer(settings: AdamW | Adadelta, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
    """Make the optimizer of some weights."""
    if isinstance(settings, Adadelta):
        return torch.optim.Adadelta(parameters, lr=settings.learning_rate, rho=settings.rho, eps=settings.eps)
    return torch.optim.AdamW(
        parameters, lr=settings.learning_rate, betas=settings.betas, weight_decay=settings.weight_decay
    )


def drawn_batches(
    objective: Objective, first_step: int, samples: range, seed: int, workers: int, pinned: bool = False
) -> Iterator[tuple[int, Batch, float]]:
    """Yield some samples of the batch of every step from `first_step` on: the step, batch and seconds waited.

    `workers` processes draw ahead. Each sample depends only on (seed, step, index).
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
            yield step, batch, time.monotonic() - begin_s
    finally:
        del batches  # ends its workers, though a traceback may hold this frame


def _leave_signals(_: int) -> None:
    """Let a worker continue for a while when all processes of a job are asked to end: the run ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, lambda *_: signal.alarm(_PATIENCE_S))


class _Draws(Dataset[Batch | FacerfError]):
    """Batches of an objective by step, for data-loading workers."""

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
        except FacerfError as error:  # returned, because the loader would turn it into a traceback
            return error
