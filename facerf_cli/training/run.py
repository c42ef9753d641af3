"""Run `facerf train`: build the objective of its stage and start the training loop."""

import importlib
import logging
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from facerf_cli.batch.settings import Settings, torch_device
from facerf_cli.errors import UsageError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.atomic import alone_in
from facerf_cli.network.checkpoint import load_networks, use_form
from facerf_cli.network.files import serving_files
from facerf_cli.relighting.models import Networks
from facerf_cli.run.logs import LOGGER_NAME, STDERR
from facerf_cli.run.machine import processors
from facerf_cli.training.build import Run
from facerf_cli.training.loop import Start, train
from facerf_cli.training.objective import Objective
from facerf_cli.training.options import TrainOptions
from facerf_cli.training.processes import first_process_first, joined_processes, process_rank
from facerf_cli.training.run_folder import refuse_another_run
from facerf_cli.training.settings import CONFIG, STAGES, TrainSettings, write_config

_WORKERS_ON_GPU = 4
_SMOOTH = 0.95  # of the moving average of the losses
_PACE_S = 600.0  # of the last steps, whose pace gives the time left
log = logging.getLogger(LOGGER_NAME)


def run_training(options: TrainOptions, training: TrainSettings, typed: dict[str, Any]) -> None:
    """Train in this process or, under torchrun, in several, and print the path of the last checkpoint.

    typed: The options that were set, by name, for config.toml.
    """
    with joined_processes(), ExitStack() as stack:
        device, first, workers = _device(options.settings), process_rank() == 0, options.workers
        use_form(options.form)
        if first:
            stack.enter_context(alone_in(options.output, ".facerf-lock"))
        if workers is None:
            workers = _WORKERS_ON_GPU if device.type == "cuda" else int(processors() > 1)
        training, people = replace(training, workers=workers), _people_networks(options, device)
        trained, start = _load_start(options)
        with first_process_first():
            if first and not options.resume:
                refuse_another_run(options.output)  # before hours of baking
            module, _, build = STAGES[options.stage].build.partition(":")
            stage = importlib.import_module(f"facerf_cli.training.{module}")
            objective: Objective = getattr(stage, build)(Run(options, training, trained, people))
        if first and not (options.resume and (options.output / CONFIG).exists()):
            write_config(options.output, typed, training, options.settings.seed)
        progress = TrainProgress(training, options.settings, first)
        with progress.bar:
            checkpoint = train(
                objective, options.output, training, start, options.resume, device, progress.row
            )
        if first:
            print(checkpoint)


def _device(settings: Settings) -> torch.device:
    """Return the device of --device; `auto` ignores Apple's GPUs."""
    device: torch.device = torch_device(settings)
    if device.type != "mps":
        return device
    if settings.device == "auto":
        return torch.device("cpu")
    raise UsageError("--device mps: training needs float64, which Apple's GPUs lack; use --device cpu")


def _people_networks(options: TrainOptions, device: torch.device) -> Networks:
    """Return the networks that look at people in photos; UsageError for a --checkpoint that is not used."""
    looks = options.stage == "portrait" or options.photos is not None
    uses = ["parsing"] if looks or options.settings.checkpoints_by_default else []
    user = f"facerf train --stage {options.stage}"
    return Networks(serving_files(options.settings.checkpoints, uses, user), device)


def _load_start(options: TrainOptions) -> tuple[dict[str, Any], Start]:
    """Load --start-from: the networks that the stage trains, and the content that the run copies."""
    if options.start_from is None:
        return {}, Start()
    networks, metadata = load_networks(options.start_from, LAYOUT_VERSION)
    names = STAGES[options.stage].networks or (options.stage.replace("-", "_"),)
    trained = {name: network for name, network in networks.items() if name in names}
    return trained, Start({k: v for k, v in networks.items() if k not in names}, metadata)


class TrainProgress:
    """Show progress: a bar on a terminal, otherwise a log line per validation.

    It contains losses, the last validation, the fraction of time spent waiting for batches, and the time
    left.
    """

    def __init__(self, training: TrainSettings, settings: Settings, shown: bool) -> None:
        text, left = TextColumn("{task.description}"), TextColumn("left")
        columns = (text, BarColumn(bar_width=20), TimeElapsedColumn(), TimeRemainingColumn(), left)
        self.on = shown and STDERR.is_terminal and settings.verbosity >= 0 and not settings.log_json
        self.training = training
        self.bar = Progress(*columns, console=STDERR, disable=not self.on, speed_estimate_period=_PACE_S)
        self.task = self.bar.add_task("training", total=1.0)
        self.smooth: dict[str, float] = {}
        self.validation = ""

    def row(self, row: dict[str, Any]) -> None:
        """Show one row of the log."""
        losses = {"loss": row["loss"], **(row["terms"] if len(row["terms"]) > 1 else {})}
        for name, value in losses.items():
            self.smooth[name] = _SMOOTH * self.smooth.get(name, value) + (1 - _SMOOTH) * value
        words = _figures(self.smooth)
        if "validation" in row:
            self.validation = _figures(row["validation"])
            if not self.on:
                log.info("step %d  %s  |  %s", row["step"], words, self.validation)
        text = f"step {row['step']}  {words}  waiting {100 * row['waiting']:.0f} %"
        text += f"  |  {self.validation}" if self.validation else ""
        done = self.training.done(row["step"], row["seconds"])
        self.bar.update(self.task, completed=done, description=text)


def _figures(values: dict[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in values.items())
