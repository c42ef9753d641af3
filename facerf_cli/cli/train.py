"""`facerf train`: train the networks on synthetic heads or on a prepared dataset."""

from dataclasses import replace

import typer

from facerf_cli.cli.options import is_default, was_given
from facerf_cli.errors import UsageError
from facerf_cli.option import flag
from facerf_cli.training.options import TrainOptions
from facerf_cli.training.settings import KINDS, STAGES


def train(context: typer.Context, options: TrainOptions) -> None:
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
    training = options.training({name: table for name, table in of_file.items() if name in KINDS})
    names = {parameter.name: parameter.opts[0].lstrip("-") for parameter in context.command.params}
    typed = {
        names[name]: list(value) if isinstance(value, tuple) else value
        for name, value in context.params.items()
        if name not in ("resume", "learning_rate") and not is_default(context, name)
    }
    from facerf_cli.training.run import run_training

    run_training(options, training, typed)


def _refuse_conflicts(context: typer.Context, options: TrainOptions) -> None:
    """Raise UsageError for options that do not apply to the stage or contradict each other."""
    stage, given = options.stage, {name for name in context.params if was_given(context, name)}
    of_some = frozenset().union(*(entry.options for entry in STAGES.values()))
    for name in sorted(given & of_some - STAGES[stage].options):
        raise UsageError(f"{flag(name)}: does not apply to the stage {stage}; remove it")
    if (
        options.dataset is None
        and "dataset" in STAGES[stage].options
        and "heads" not in STAGES[stage].options
    ):
        raise UsageError(f"--stage {stage}: needs a prepared dataset; pass --dataset")
    if {"vgg_weights", "appearance_features"} <= given:
        raise UsageError("--appearance-features: replaces --vgg-weights; use one of them")
    for name in ("heads_from", "heads", "views", "bank"):
        if {name, "dataset"} <= given:
            raise UsageError(
                f"{flag(name)}: only for synthetic heads, which --dataset replaces; use one of them"
            )
    for name in ("photos", "mean_face"):
        if name in given and context.params["geometry"] == "landmarks":
            raise UsageError(f"{flag(name)}: only for the Geometry Network; remove --geometry landmarks")
    if stage == "joint" and options.geometry == "network" and options.fit_with != "builtin":
        raise UsageError(
            "--fit-with: the Geometry Network learns the built-in face model; remove it, or use "
            "--geometry landmarks"
        )
    if "texture_size" in given and options.dataset is None:
        raise UsageError("--texture-size: applies to a dataset; also pass --dataset")
    if {"mean_face", "dataset"} <= given and stage == "reflectance":
        raise UsageError("--mean-face: the dataset is already fitted; use --stage joint, or synthetic heads")
    if {"form", "start_from"} <= given:
        raise UsageError("--form: --start-from fixes the form; use one of them")
    if {"without_normals", "start_from"} <= given:
        raise UsageError("--without-normals: --start-from fixes the networks' inputs; use one of them")
