"""`facerf train`: train the networks on synthetic heads or on a prepared dataset."""

from dataclasses import replace
from typing import Any

import typer

from facerf_cli.cli.options import is_default, was_given
from facerf_cli.errors import UsageError
from facerf_cli.option import flag
from facerf_cli.training.options import PaceOptions, TrainOptions
from facerf_cli.training.settings import KINDS, TrainSettings

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
    "fit_with": (*_TEXTURE_STAGES, "joint"),
    "heads_from": _HEAD_STAGES,
    "heads": _HEAD_STAGES,
    "bank": _HEAD_STAGES,
}


def train(context: typer.Context, options: TrainOptions, pace: PaceOptions) -> None:
    """Train the networks on synthetic heads, without a light stage, or on a prepared dataset.

    Stages: reflectance, the Reflectance Network on textures; geometry, the Geometry Network on rendered
    heads; joint, both through the rasterizer; parsing and portrait, the networks of those names on whole
    synthetic people; light-features and appearance-features, the networks of those options; diffuse-sh, the
    network of that baseline.

    Synthetic heads are drawn from a face model, and their light transport is baked once; each step draws new
    skins, lights and cameras. A dataset is read from its OLAT stacks: sources are lit as the recipes of
    relight-dataset say or, if there are none, by random lights. Training uses its split train and validation
    its split validation; the split test stays unused.

    DIR gets last.safetensors and best.safetensors (for --checkpoint and --start-from), log.jsonl,
    validation-STEP.png, TensorBoard events (tensorboard --logdir DIR), and state.pt for --resume. On a CPU a
    run of --steps gives the same result to the last digit however often it is stopped.

    Several processes, one a GPU: torchrun --nproc-per-node N -m facerf_cli train ...
    """
    if options.preset == "paper":
        joint, paper = is_default(context, "stage"), is_default(context, "form")
        options = replace(
            options, stage="joint" if joint else options.stage, form="paper" if paper else options.form
        )
    _refuse_conflicts(context, options)
    of_file = (context.find_root().default_map or {}).get("train", {})
    tables = {name: table for name, table in of_file.items() if name in KINDS}
    training = pace.of_run(options, tables)
    from facerf_cli.training.run import run_training

    run_training(replace(options, training=training, typed=_typed(context, options, training)))


def _typed(context: typer.Context, options: TrainOptions, training: TrainSettings) -> dict[str, Any]:
    """The options that were given, by name, and values in force that a preset gave."""
    names = {parameter.name: parameter.opts[0].lstrip("-") for parameter in context.command.params}
    given = {
        names[name]: list(value) if isinstance(value, tuple) else value
        for name, value in context.params.items()
        if name not in ("resume", "learning_rate") and not is_default(context, name)
    }
    in_force: dict[str, Any] = {
        "stage": options.stage,
        "validate-every": training.validate_every,
        "batch": training.batch,
        "gradient-clip": training.gradient_clip or 0,
        "ema-decay": training.ema_decay or 0,
        "bf16": training.bf16,
    }
    if training.max_seconds:
        in_force["max-time"] = f"{training.max_seconds:.3f}s"
    return given | in_force


def _refuse_conflicts(context: typer.Context, options: TrainOptions) -> None:
    """Raise UsageError for options that do not apply to the stage or contradict each other."""
    stage, given = options.stage, {name for name in context.params if was_given(context, name)}
    for name, stages in _STAGES.items():
        if name in given and stage not in stages:
            raise UsageError(f"{flag(name)}: does not apply to the stage {stage}; leave it out")
    if stage in _CROP_STAGES and options.dataset is None:
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
    if stage == "joint" and options.geometry == "network" and options.fit_with != "builtin":
        raise UsageError(
            "--fit-with: the Geometry Network learns the built-in face model; leave it out, or give "
            "--geometry landmarks"
        )
    if "texture_size" in given and options.dataset is None:
        raise UsageError("--texture-size: applies to a dataset; give --dataset, too")
    if {"mean_face", "dataset"} <= given and stage == "reflectance":
        raise UsageError("--mean-face: the dataset is fitted already; give --stage joint, or synthetic heads")
    if {"form", "start_from"} <= given:
        raise UsageError("--form: --start-from fixes the form; give one of them")
    if {"without_normals", "start_from"} <= given:
        raise UsageError("--without-normals: --start-from fixes the networks' inputs; give one of them")
