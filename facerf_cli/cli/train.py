"""`facerf train`: train the networks on synthetic heads or on a prepared dataset."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from facerf_cli.batch.settings import Settings
from facerf_cli.cli.options import flag, settings_of, was_given
from facerf_cli.cli.photo_options import Geometry
from facerf_cli.errors import UsageError
from facerf_cli.training.settings import PRESETS, Preset, Stage, TrainSettings, preset_of

_TEXTURE_STAGES = ("reflectance", "light-features", "diffuse-sh")
_PEOPLE_STAGES = ("parsing", "portrait")  # which draw whole synthetic people
_HEAD_STAGES = (*_TEXTURE_STAGES, "geometry", *_PEOPLE_STAGES)  # which draw synthetic heads
_CROP_STAGES = ("joint", "appearance-features")  # which read a dataset's crops
_STAGES = {  # the stages that an option applies to
    "vgg_weights": ("joint",),
    "appearance_features": ("joint",),
    "photos": ("joint",),
    "light_features": ("joint", "reflectance"),
    "form": ("joint", "reflectance"),
    "without_normals": ("joint", "reflectance"),
    "mean_face": ("joint", "reflectance"),
    "geometry": ("joint",),
    "views": _TEXTURE_STAGES,
    "texture_size": (*_TEXTURE_STAGES, *_CROP_STAGES),
    "dataset": (*_TEXTURE_STAGES, *_CROP_STAGES, "portrait"),
    "fit_with": _TEXTURE_STAGES,
    "heads_from": _HEAD_STAGES,
    "heads": _HEAD_STAGES,
    "bank": _HEAD_STAGES,
}
_UNITS_S = {"s": 1, "m": 60, "h": 3600}
_DEFAULT_TIME = "2h"

_run = partial(typer.Option, rich_help_panel="The run")
_data = partial(typer.Option, rich_help_panel="Data")
_length = partial(typer.Option, rich_help_panel="Length")
_loss = partial(typer.Option, rich_help_panel="Losses and ablations")
_speed = partial(typer.Option, rich_help_panel="Speed")


def _by_preset(value: Callable[[TrainSettings], Any]) -> str:
    """Defaults of an option in all presets, for the help."""
    default, paper, tiny = (value(PRESETS[name]) for name in ("default", "paper", "tiny"))
    return f"{default}; paper {paper}, tiny {tiny}"


@dataclass(frozen=True)
class TrainOptions:
    """The options of a run, checked; settings only."""

    output: Path
    preset: Preset
    form: str
    stage: Stage
    training: TrainSettings
    resume: bool
    start_from: Path | None
    dataset: Path | None
    heads_from: str
    fit_with: str
    heads: int | None
    views: int | None
    bank: Path | None
    texture_size: int | None
    photos: Path | None
    vgg_weights: str | None
    appearance_features: Path | None
    light_features: Path | None
    without_normals: bool
    mean_face: bool
    geometry: Geometry
    jobs: int
    workers: int | None  # None: by the device
    settings: Settings


def train(
    context: typer.Context,
    output: Annotated[Path, _run("--output", "-o", metavar="DIR", help="Write the run to this folder.")],
    preset: Annotated[
        Preset,
        _run(
            help="Use networks, losses and optimizer of the shipped checkpoint (default), of the paper, or "
            "small ones for trials (tiny)."
        ),
    ] = "default",
    form: Annotated[
        str | None,
        _run(
            metavar="NAME",
            help="Train this form of the Reflectance Network: default, paper, or a form of your own "
            "(docs/design.md).",
            show_default="paper with --preset paper, else default",
        ),
    ] = None,
    stage: Annotated[
        Stage | None,
        _run(
            metavar="STAGE",
            help=f"Train the networks of a stage: {', '.join(get_args(Stage))}.",
            show_default="joint with --preset paper, else reflectance",
        ),
    ] = None,
    resume: Annotated[
        bool,
        _run("--resume", help="Continue the run in DIR from its last save; give the same options."),
    ] = False,
    start_from: Annotated[
        Path | None,
        _run(
            metavar="FILE",
            help="Start from a checkpoint; networks that the stage does not train are copied.",
            show_default="none",
        ),
    ] = None,
    dataset: Annotated[
        Path | None,
        _data(
            metavar="DIR",
            help="Train on a dataset of prepare-dataset and relight-dataset instead of synthetic heads.",
            show_default="synthetic heads",
        ),
    ] = None,
    texture_size: Annotated[
        int | None,
        _data(
            min=32,
            max=1024,
            metavar="PX",
            help="Unwrap a dataset to textures of this side; the stages joint and appearance-features read "
            "its crops at this side, too.",
            show_default="128, joint 256; with --preset paper 512",
        ),
    ] = None,
    photos: Annotated[
        Path | None,
        _data(
            metavar="DIR",
            help="Train on photos of faces, too, in a fifth of the batches of the stage joint.",
            show_default="none",
        ),
    ] = None,
    heads_from: Annotated[
        str,
        _data(
            metavar="NAME|PATH",
            help="Draw synthetic heads from this face model; of whole people, from several with commas.",
        ),
    ] = "builtin",
    fit_with: Annotated[
        str,
        _data(metavar="NAME|PATH", help="Fit this face model to the heads; a dataset's own model."),
    ] = "builtin",
    heads: Annotated[
        int | None, _data(min=2, help="Bake so many synthetic heads.", show_default="240; tiny 16")
    ] = None,
    views: Annotated[
        int | None, _data(min=1, help="Fit so many views of each head.", show_default="8; tiny 2")
    ] = None,
    bank: Annotated[
        Path | None, _data(metavar="DIR", help="Keep baked heads in this folder.", show_default="DIR/bank")
    ] = None,
    jobs: Annotated[int, _data("--jobs", "-j", min=1, help="Bake or unwrap in so many processes.")] = 2,
    steps: Annotated[
        int | None, _length(min=1, help="Stop after so many steps.", show_default="no limit")
    ] = None,
    max_time: Annotated[
        str | None,
        _length(
            metavar="TIME",
            help="Stop after a time, such as 90s, 45m or 2h, summed over all resumptions.",
            show_default=f"{_DEFAULT_TIME}; no limit with --steps",
        ),
    ] = None,
    validate_every: Annotated[
        int | None,
        _length(
            min=1,
            metavar="STEPS",
            help="Validate on held-out people, and save, every so many steps.",
            show_default=_by_preset(lambda settings: settings.validate_every),
        ),
    ] = None,
    vgg_weights: Annotated[
        str | None,
        _loss(
            metavar="imagenet|PATH",
            help="Add the feature loss of VGG-16 to the stage joint: imagenet downloads its weights; or a "
            "file.",
            show_default="without this loss",
        ),
    ] = None,
    appearance_features: Annotated[
        Path | None,
        _loss(
            metavar="FILE",
            help="Use a checkpoint of the stage appearance-features in place of --vgg-weights.",
            show_default="without this loss",
        ),
    ] = None,
    light_features: Annotated[
        Path | None,
        _loss(
            metavar="FILE",
            help="Add the feature loss on textures, with a checkpoint of the stage light-features.",
            show_default="without this loss",
        ),
    ] = None,
    without_normals: Annotated[
        bool, _loss("--without-normals", help="Train the Reflectance Network without normal maps (ablation).")
    ] = False,
    mean_face: Annotated[
        bool, _loss("--mean-face", help="Fit poses alone, with the mean face for everyone (ablation).")
    ] = False,
    geometry: Annotated[
        Geometry,
        _loss(
            help="Train the Geometry Network, too, in the stage joint; or fit heads to landmarks and train "
            "the Reflectance Network alone."
        ),
    ] = "network",
    learning_rate: Annotated[
        float | None,
        _run(
            min=1e-9,
            help="Set the highest learning rate.",
            show_default=_by_preset(lambda settings: settings.optimizer.learning_rate),
        ),
    ] = None,
    batch: Annotated[
        int | None,
        _speed(
            min=1,
            help="Use so many samples a step, of all processes together.",
            show_default=_by_preset(lambda settings: settings.batch),
        ),
    ] = None,
    workers: Annotated[
        int | None,
        _speed(
            min=0,
            help="Draw samples ahead in so many processes.",
            show_default="1 on a CPU of more than one core, 4 on a GPU",
        ),
    ] = None,
    bf16: Annotated[
        bool | None,
        _speed(
            "--bf16/--no-bf16",
            help="Train in mixed precision (bfloat16), where the device has instructions for it.",
            show_default="on; presets paper and tiny, and --form paper, off",
        ),
    ] = None,
    compile_model: Annotated[
        bool, _speed("--compile", help="Compile the networks with torch; the first steps take minutes.")
    ] = False,
) -> None:
    """Train the networks on synthetic heads, without a light stage, or on a prepared dataset.

    Stages: reflectance, the Reflectance Network on textures; geometry, the Geometry Network on rendered
    heads; joint, both through the rasterizer; parsing and portrait, the networks of those names on whole
    synthetic people; light-features and appearance-features, the networks of those options; diffuse-sh, the
    network of that baseline.

    Synthetic heads are drawn from a face model, and their light transport is baked once; each step draws new
    skins, lights and cameras. A dataset is unwrapped once into DATASET/textures-PX. Training uses its split
    train and validation its split validation; the split test stays unused. Sources are those of
    relight-dataset or, if there are none, the stacks under random lights.

    DIR gets last.safetensors and best.safetensors (for --checkpoint and --start-from), log.jsonl,
    validation-STEP.png, TensorBoard events (tensorboard --logdir DIR), and state.pt for --resume. On a CPU a
    run of --steps gives the same result to the last digit however often it is stopped.

    Several processes, one a GPU: torchrun --nproc-per-node N -m facerf_cli train ...
    """
    stage = stage or ("joint" if preset == "paper" else "reflectance")
    _refuse_conflicts(context, stage)
    settings = settings_of(context)
    if max_time is None and steps is None:
        max_time = _DEFAULT_TIME
    training = preset_of(preset, stage)
    optimizer = training.optimizer
    form = form or ("paper" if preset == "paper" else "default")
    training = replace(
        training,
        steps=steps,
        max_seconds=_seconds(max_time) if max_time else None,
        seed=settings.seed,
        compile=compile_model,
        optimizer=replace(optimizer, learning_rate=learning_rate or optimizer.learning_rate),
        batch=batch or training.batch,
        validate_every=validate_every or training.validate_every,
        bf16=training.bf16 and form != "paper" if bf16 is None else bf16,  # its gradients overflow
    )
    from facerf_cli.work.train import run_training

    run_training(
        TrainOptions(
            output=output,
            preset=preset,
            form=form,
            stage=stage,
            training=training,
            resume=resume,
            start_from=start_from,
            dataset=dataset,
            heads_from=heads_from,
            fit_with=fit_with,
            heads=heads,
            views=views,
            bank=bank,
            texture_size=texture_size,
            photos=photos,
            vgg_weights=vgg_weights,
            appearance_features=appearance_features,
            light_features=light_features,
            without_normals=without_normals,
            mean_face=mean_face,
            geometry=geometry,
            jobs=jobs,
            workers=workers,
            settings=settings,
        )
    )


def _refuse_conflicts(context: typer.Context, stage: Stage) -> None:
    """Raise UsageError for options that do not apply to the stage or contradict each other."""
    given = {name for name in context.params if was_given(context, name)}
    for name, stages in _STAGES.items():
        if name in given and stage not in stages:
            raise UsageError(f"{flag(name)}: does not apply to the stage {stage}; leave it out")
    if stage in _CROP_STAGES and "dataset" not in given:
        raise UsageError(f"--stage {stage}: needs a prepared dataset; give --dataset")
    if {"vgg_weights", "appearance_features"} <= given:
        raise UsageError("--appearance-features: takes the place of --vgg-weights; give one of them")
    for name in ("heads_from", "heads", "views", "bank"):
        if {name, "dataset"} <= given:
            raise UsageError(
                f"{flag(name)}: is for synthetic heads, which --dataset replaces; give one of them"
            )
    for name in ("photos", "mean_face"):
        if name in given and context.params["geometry"] == "landmarks":
            raise UsageError(
                f"{flag(name)}: is for the Geometry Network, which --geometry landmarks leaves out"
            )
    if "texture_size" in given and "dataset" not in given:
        raise UsageError("--texture-size: applies to a dataset; give --dataset, too")
    if {"mean_face", "dataset"} <= given and stage == "reflectance":
        raise UsageError("--mean-face: the dataset is fitted already; give --stage joint, or synthetic heads")
    if {"form", "start_from"} <= given:
        raise UsageError("--form: --start-from fixes the form; give one of them")
    if {"without_normals", "start_from"} <= given:
        raise UsageError("--without-normals: --start-from fixes the networks' inputs; give one of them")


def _seconds(text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh])", text)
    if not match or not float(match[1]):
        raise UsageError(f"--max-time {text}: not a time; write a number and s, m or h, such as 45m")
    return float(match[1]) * _UNITS_S[match[2]]
