"""`facerf train`: the networks, on synthetic heads baked for them or on a prepared dataset."""

import os
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from facerf_cli.commands.options import settings_of, torch_device
from facerf_cli.commands.train_objective import (
    Preset,
    Stage,
    TrainOptions,
    build_objective,
    trained_networks,
)
from facerf_cli.commands.train_progress import TrainProgress
from facerf_cli.commands.train_refusals import refuse_what_makes_no_sense
from facerf_cli.errors import UsageError

if TYPE_CHECKING:
    from torch import nn

    from facerf_cli.runs.settings import TrainSettings
    from facerf_cli.training import Start

_UNITS_S = {"s": 1, "m": 60, "h": 3600}
_DEFAULT_TIME = "2h"
_WORKERS_ON_GPU = 4

_run = partial(typer.Option, rich_help_panel="The run")
_data = partial(typer.Option, rich_help_panel="Data")
_length = partial(typer.Option, rich_help_panel="Length")
_loss = partial(typer.Option, rich_help_panel="Losses and ablations")
_speed = partial(typer.Option, rich_help_panel="Speed")


def train(
    context: typer.Context,
    output: Annotated[Path, _run("--output", "-o", metavar="DIR", help="Folder of the run.")],
    preset: Annotated[
        Preset,
        _run(
            help="default: what is shipped; paper: the paper's networks, losses and Adadelta; tiny: small "
            "networks, to try things out."
        ),
    ] = "default",
    stage: Annotated[
        Stage | None,
        _run(
            help="reflectance: that network, in the chart; geometry: that network, on rendered heads; joint: "
            "both, through the rasterizer; light-features: what --light-features takes; diffuse-sh: the "
            "network of that baseline.",
            show_default="joint with --preset paper, else reflectance",
        ),
    ] = None,
    resume: Annotated[
        bool,
        _run("--resume", help="Go on with the run in DIR where it was last saved; give its options."),
    ] = False,
    start_from: Annotated[
        Path | None,
        _run(
            metavar="FILE",
            help="Checkpoint to begin with; networks that the stage does not train are carried over.",
            show_default="none",
        ),
    ] = None,
    dataset: Annotated[
        Path | None,
        _data(
            metavar="DIR",
            help="Train on this prepared dataset (prepare-dataset, relight-dataset) in the place of heads.",
            show_default="synthetic heads",
        ),
    ] = None,
    texture_size: Annotated[
        int, _data(min=32, max=1024, metavar="PX", help="Side of a dataset's textures.")
    ] = 128,
    photos: Annotated[
        Path | None,
        _data(
            metavar="DIR",
            help="Photos of faces, for a fifth of the batches of the stage joint.",
            show_default="none",
        ),
    ] = None,
    heads_from: Annotated[
        str, _data(metavar="NAME|PATH", help="Face model that the synthetic heads are drawn from.")
    ] = "builtin",
    fit_with: Annotated[
        str,
        _data(metavar="NAME|PATH", help="Face model that they are, or the dataset was, fitted with."),
    ] = "builtin",
    heads: Annotated[
        int | None, _data(min=2, help="Synthetic heads to bake.", show_default="240; tiny 16")
    ] = None,
    views: Annotated[
        int | None, _data(min=1, help="Fitted views of each head.", show_default="8; tiny 2")
    ] = None,
    bank: Annotated[
        Path | None, _data(metavar="DIR", help="Where baked heads are kept.", show_default="DIR/bank")
    ] = None,
    jobs: Annotated[int, _data("--jobs", "-j", min=1, help="Processes that bake, or unwrap.")] = 2,
    steps: Annotated[
        int | None, _length(min=1, help="Stop after so many steps.", show_default="no limit")
    ] = None,
    max_time: Annotated[
        str | None,
        _length(
            metavar="TIME",
            help="Stop after 90s, 45m or 2h, counted over all legs of a resumed run.",
            show_default=f"{_DEFAULT_TIME}; no limit with --steps",
        ),
    ] = None,
    validate_every: Annotated[
        int | None,
        _length(
            min=1,
            metavar="STEPS",
            help="Measure on held-out people, and save, after so many steps.",
            show_default="500; paper 1000, tiny 10",
        ),
    ] = None,
    vgg_weights: Annotated[
        str | None,
        _loss(
            metavar="imagenet|PATH",
            help="VGG-16 for the feature loss of the stage joint: imagenet fetches it; or a file.",
            show_default="without this loss",
        ),
    ] = None,
    light_features: Annotated[
        Path | None,
        _loss(
            metavar="FILE",
            help="Checkpoint of the stage light-features, for the feature loss on textures.",
            show_default="without this loss",
        ),
    ] = None,
    without_normals: Annotated[
        bool, _loss("--without-normals", help="Ablation: the Reflectance Network sees no normal maps.")
    ] = False,
    mean_face: Annotated[
        bool, _loss("--mean-face", help="Ablation: the mean face for everybody; only poses are fitted.")
    ] = False,
    learning_rate: Annotated[
        float | None,
        _run(
            min=1e-9,
            help="Highest step size of the optimiser.",
            show_default="0.0015; paper 0.05, tiny 0.004",
        ),
    ] = None,
    batch: Annotated[
        int | None,
        _speed(min=1, help="Samples a step, of all processes together.", show_default="4; paper 1, tiny 2"),
    ] = None,
    workers: Annotated[
        int | None,
        _speed(
            min=0,
            help="Processes that draw samples ahead.",
            show_default="1 on a CPU of more than one core, 4 on a GPU",
        ),
    ] = None,
    bf16: Annotated[
        bool | None,
        _speed("--bf16/--no-bf16", help="Mixed precision.", show_default="on; paper and tiny off"),
    ] = None,
    compile_model: Annotated[
        bool, _speed("--compile", help="Let torch compile the step; the first ones take minutes.")
    ] = False,
) -> None:
    """Train the networks on synthetic heads, without a light stage, or on a prepared dataset.

    Heads are drawn from a face model and their light transport is baked once; skins, lights and cameras are
    drawn anew at every step. A dataset is unwrapped once into DATASET/textures-PX; its split train is trained
    on, its split validation measured, its split test left alone. Sources are those of relight-dataset, or,
    where there are none, the stacks under lights that are drawn.

    DIR gets last.safetensors and best.safetensors (for --checkpoint and --start-from), log.jsonl,
    validation-STEP.png, what TensorBoard shows (tensorboard --logdir DIR), and state.pt, from which --resume
    goes on. On a CPU a run of --steps is the same to the last digit however often it was stopped.

    Several processes, one a GPU: torchrun --nproc-per-node N -m facerf_cli train ...
    """
    from facerf_cli.runs.processes import joined_processes

    stage = stage or ("joint" if preset == "paper" else "reflectance")
    refuse_what_makes_no_sense(context, stage)
    settings = settings_of(context)
    training = _training(preset, steps, max_time, settings.seed, compile_model)
    optimizer = training.optimizer
    training = replace(
        training,
        optimizer=replace(optimizer, learning_rate=learning_rate or optimizer.learning_rate),
        batch=batch or training.batch,
        validate_every=validate_every or training.validate_every,
        bf16=training.bf16 if bf16 is None else bf16,
    )
    options = TrainOptions(
        output=output,
        preset=preset,
        stage=stage,
        dataset=dataset,
        heads_from=heads_from,
        fit_with=fit_with,
        heads=heads,
        views=views,
        bank=bank,
        texture_size=texture_size,
        photos=photos,
        vgg_weights=vgg_weights,
        light_features=light_features,
        without_normals=without_normals,
        mean_face=mean_face,
        jobs=jobs,
        settings=settings,
    )
    with joined_processes():
        _train(options, training, workers, start_from, resume)


def _train(
    options: TrainOptions,
    training: "TrainSettings",
    workers: int | None,
    start_from: Path | None,
    resume: bool,
) -> None:
    from facerf_cli.runs.folder import refuse_another_run
    from facerf_cli.runs.processes import first_process_first, process_rank
    from facerf_cli.training import train as run_training

    device, first = torch_device(options.settings), process_rank() == 0
    if workers is None:
        workers = _WORKERS_ON_GPU if device.type == "cuda" else int((os.cpu_count() or 1) > 1)
    training = replace(training, workers=workers)
    trained, start = _start(start_from, options.stage)
    with first_process_first():
        if first and not resume:
            refuse_another_run(options.output)  # before hours of baking
        objective = build_objective(replace(options, networks=trained))
    with TrainProgress(training.steps, training.max_seconds, options.settings, first) as progress:
        checkpoint = run_training(objective, options.output, training, start, resume, device, progress.row)
    if first:
        print(checkpoint)


def _training(
    preset: Preset, steps: int | None, max_time: str | None, seed: int, compile_model: bool
) -> "TrainSettings":
    from facerf_cli.runs.settings import PRESETS

    if max_time is None and steps is None:
        max_time = _DEFAULT_TIME
    max_seconds = _seconds(max_time) if max_time else None
    return replace(PRESETS[preset], steps=steps, max_seconds=max_seconds, seed=seed, compile=compile_model)


def _seconds(text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh])", text)
    if not match or not float(match[1]):
        raise UsageError(f"--max-time {text}: write a number and s, m or h, such as 45m")
    return float(match[1]) * _UNITS_S[match[2]]


def _start(path: Path | None, stage: Stage) -> "tuple[dict[str, nn.Module], Start]":
    """The networks of a checkpoint that the stage goes on with, and what the run carries over."""
    from facerf_cli.face.topology import LAYOUT_VERSION
    from facerf_cli.network.saved import load_networks
    from facerf_cli.training import Start

    if path is None:
        return {}, Start()
    networks, metadata = load_networks(path, LAYOUT_VERSION)
    names = trained_networks(stage)
    trained = {name: network for name, network in networks.items() if name in names}
    return trained, Start({k: v for k, v in networks.items() if k not in names}, metadata)
