"""`facerf train`: train the networks on synthetic heads or on a prepared dataset."""

from dataclasses import replace
from typing import Any

import typer

from facerf_cli.cli.options import is_default, was_given
from facerf_cli.option import flag
from facerf_cli.training.options import PaceOptions, TrainOptions
from facerf_cli.training.settings import KINDS, TrainSettings
from facerf_cli.work.photo_options import refuse

_TEXTURE_STAGES = ("reflectance", "light-features", "diffuse-sh")
_PEOPLE_STAGES = ("parsing", "portrait")  # draw whole synthetic people
_HEAD_STAGES = (*_TEXTURE_STAGES, "geometry", *_PEOPLE_STAGES)  # draw synthetic heads
_CROP_STAGES = ("joint", "appearance-features")  # read a dataset's crops
_STAGES = {  # that options apply to
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
_EXCLUSIVE = (
    ("heads_from", "dataset"),
    ("heads", "dataset"),
    ("views", "dataset"),
    ("bank", "dataset"),
    ("appearance_features", "vgg_weights"),
    ("form", "start_from"),
    ("without_normals", "start_from"),
)


def train(context: typer.Context, options: TrainOptions, pace: PaceOptions) -> None:
    """Train the networks on synthetic heads, without a light stage, or on a prepared dataset.

    Stages: reflectance trains the Reflectance Network on textures; geometry, the Geometry Network on rendered
    heads; joint, both through the rasterizer; parsing and portrait, the networks of these names on whole
    synthetic people; light-features and appearance-features, the networks of these options; diffuse-sh, the
    network of that baseline.

    Synthetic heads are drawn from a face model, and their light transport is baked once; each step draws new
    skins, lights and cameras. A dataset is unwrapped once into DATASET/textures-PX. Training uses the splits
    train and validation; the split test is not used. Sources are those of relight-dataset or, if there are
    none, the stacks under random lights.

    DIR gets last.safetensors and best.safetensors (for --checkpoint and --start-from), log.jsonl,
    validation-STEP.png, TensorBoard events (tensorboard --logdir DIR), and state.pt for --resume. On a CPU, a
    run of --steps gives bit-identical results no matter how often it is interrupted.

    Use torchrun for several processes, one per GPU: torchrun --nproc-per-node N -m facerf_cli train ...
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
    """Return the options as typed, by name, and the values that a preset set."""
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
    """Raise UsageError for options that do not apply to the stage or exclude each other."""
    stage, given = options.stage, {name for name in context.params if was_given(context, name)}
    rules = {
        f"{flag(name)}: does not apply to the stage {stage}; remove it": name in given and stage not in stages
        for name, stages in _STAGES.items()
    }
    rules |= {
        f"--stage {stage}: requires a prepared dataset; add --dataset": (
            stage in _CROP_STAGES and options.dataset is None
        ),
        "--texture-size: requires a dataset; add --dataset": (
            "texture_size" in given and options.dataset is None
        ),
        "--mean-face: datasets are fitted already; use --stage joint, or synthetic heads": (
            {"mean_face", "dataset"} <= given and stage == "reflectance"
        ),
        "--fit-with: the Geometry Network needs the built-in face model; add --geometry landmarks": (
            stage == "joint" and options.geometry == "network" and options.fit_with != "builtin"
        ),
    }
    rules |= {
        f"{flag(name)}: requires the Geometry Network; remove --geometry landmarks": (
            name in given and options.geometry == "landmarks"
        )
        for name in ("photos", "mean_face")
    }
    rules |= {
        f"{flag(one)}: cannot be combined with {flag(other)}; use one of them": {one, other} <= given
        for one, other in _EXCLUSIVE
    }
    refuse(rules)
