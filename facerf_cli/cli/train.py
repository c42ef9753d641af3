"""Options of `facerf train` that make no sense together, each refused in a line.

`facerf train`: the networks, on synthetic heads baked for them or on a prepared dataset.
"""

import os
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from facerf_cli.cli.items.train import (
    Preset,
    Stage,
    TrainOptions,
    TrainProgress,
    build_objective,
    trained_networks,
)
from facerf_cli.cli.options import flag, settings_of, torch_device, was_given
from facerf_cli.errors import UsageError

if TYPE_CHECKING:
    from torch import nn

    from facerf_cli.training.loop import Start
    from facerf_cli.training.settings import TrainSettings

_IN_CHART = ("reflectance", "light-features", "diffuse-sh")  # stages that learn from textures alone
_STAGES = {  # that an option means something to
    "vgg_weights": ("joint",),
    "photos": ("joint",),
    "light_features": ("joint", "reflectance"),
    "without_normals": ("joint", "reflectance"),
    "mean_face": ("joint", "reflectance"),
    "views": _IN_CHART,
    "texture_size": _IN_CHART,
    "dataset": (*_IN_CHART, "joint"),
    "fit_with": _IN_CHART,
    "heads_from": (*_IN_CHART, "geometry"),
    "heads": (*_IN_CHART, "geometry"),
    "bank": (*_IN_CHART, "geometry"),
}


def refuse_what_makes_no_sense(context: "typer.Context", stage: str) -> None:
    """UsageError for what was given although it means nothing beside the rest of the line."""
    given = {name for name in context.params if was_given(context, name)}
    for name, stages in _STAGES.items():
        if name in given and stage not in stages:
            raise UsageError(f"{flag(name)} means nothing to the stage {stage}; leave it out")
    if stage == "joint" and "dataset" not in given:
        raise UsageError("the stage joint learns from a prepared dataset; give --dataset")
    for name in ("heads_from", "heads", "views", "bank"):
        if {name, "dataset"} <= given:
            raise UsageError(
                f"{flag(name)} is for synthetic heads, and --dataset takes their place; give one of them"
            )
    if "texture_size" in given and "dataset" not in given:
        raise UsageError("--texture-size is for a prepared dataset; give --dataset beside it")
    if {"mean_face", "dataset"} <= given and stage == "reflectance":
        raise UsageError("--mean-face: a dataset was fitted already; give --stage joint, or synthetic heads")
    if {"without_normals", "start_from"} <= given:
        raise UsageError("--without-normals: the networks of --start-from are as they are; give one of them")


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
    from facerf_cli.training.batches import joined_processes

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
    from facerf_cli.training.batches import first_process_first, process_rank
    from facerf_cli.training.loop import train as run_training
    from facerf_cli.training.run_folder import refuse_another_run

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
    from facerf_cli.training.settings import PRESETS

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
    from facerf_cli.network.checkpoint import load_networks
    from facerf_cli.training.loop import Start

    if path is None:
        return {}, Start()
    networks, metadata = load_networks(path, LAYOUT_VERSION)
    names = trained_networks(stage)
    trained = {name: network for name, network in networks.items() if name in names}
    return trained, Start({k: v for k, v in networks.items() if k not in names}, metadata)
