"""`facerf train`: train the networks on synthetic heads or on a prepared dataset."""

from dataclasses import replace

import typer

from facerf_cli.cli.options import is_default, was_given
from facerf_cli.option import flag
from facerf_cli.training.options import TrainOptions
from facerf_cli.training.settings import KINDS, STAGES
from facerf_cli.work.photo_options import refuse

_EXCLUSIVE = (
    ("heads_from", "dataset"),
    ("heads", "dataset"),
    ("views", "dataset"),
    ("bank", "dataset"),
    ("appearance_features", "vgg_weights"),
    ("form", "start_from"),
    ("without_normals", "start_from"),
)


def train(context: typer.Context, options: TrainOptions) -> None:
    """Train the networks on synthetic heads, without a light stage, or on a prepared dataset.

    Stages: reflectance trains the Reflectance Network on textures; geometry, the Geometry Network on rendered
    heads; joint, both through the rasterizer; parsing and portrait, the networks of these names on whole
    synthetic people; light-features and appearance-features, the networks of these options; diffuse-sh, the
    network of that baseline.

    Synthetic heads are drawn from a face model, and their light transport is baked once; each step draws new
    skins, lights and cameras. A dataset is read from its OLAT stacks: sources are lit as the recipes of
    relight-dataset say or, if there are none, by random lights. Training uses its split train and validation
    its split validation; the split test stays unused.

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
    """Raise UsageError for options that do not apply to the stage or exclude each other."""
    stage, typed = options.stage, {name for name in context.params if was_given(context, name)}
    of_stage = STAGES[stage].options
    of_any_stage = frozenset().union(*(entry.options for entry in STAGES.values()))
    rules = {
        f"{flag(name)}: does not apply to the stage {stage}; remove it": name not in of_stage
        for name in sorted(typed & of_any_stage)
    }
    rules |= {
        f"--stage {stage}: requires a prepared dataset; add --dataset": (
            "dataset" in of_stage and "heads" not in of_stage and options.dataset is None
        ),
        "--texture-size: requires a dataset; add --dataset": (
            "texture_size" in typed and options.dataset is None
        ),
        "--mean-face: datasets are fitted already; use --stage joint, or synthetic heads": (
            {"mean_face", "dataset"} <= typed and stage == "reflectance"
        ),
        "--fit-with: the Geometry Network needs the built-in face model; add --geometry landmarks": (
            stage == "joint" and options.geometry == "network" and options.fit_with != "builtin"
        ),
    }
    rules |= {
        f"{flag(name)}: requires the Geometry Network; remove --geometry landmarks": (
            name in typed and options.geometry == "landmarks"
        )
        for name in ("photos", "mean_face")
    }
    rules |= {
        f"{flag(one)}: cannot be combined with {flag(other)}; use one of them": {one, other} <= typed
        for one, other in _EXCLUSIVE
    }
    refuse(rules)
