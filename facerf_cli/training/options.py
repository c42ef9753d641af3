"""Options of `facerf train`. Light to import."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from facerf_cli.batch.settings import Settings
from facerf_cli.errors import UsageError
from facerf_cli.option import DATA, LENGTH, LOSSES, RUN, SPEED, option
from facerf_cli.training.settings import PRESETS, STAGES, Preset, Stage, TrainSettings, preset_of, with_tables

_UNITS_S = {"s": 1, "m": 60, "h": 3600}
_DEFAULT_TIME = "2h"


def _by_preset(value: Callable[[TrainSettings], Any]) -> str:
    """Return the defaults of an option in all presets, for the help."""
    default, paper, tiny = (value(PRESETS[name]) for name in ("default", "paper", "tiny"))
    return f"{default}; paper {paper}, tiny {tiny}"


def _or_none(value: float | None, default: float | None) -> float | None:
    """Return the default for None, and None for 0."""
    return (default if value is None else value) or None


def _seconds(text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh])", text)
    if not match or not float(match[1]):
        raise UsageError(f"--max-time {text}: not a time; use a number and s, m or h, such as 45m")
    return float(match[1]) * _UNITS_S[match[2]]


@dataclass(frozen=True)
class TrainOptions:
    """Options of a training: its networks, data, losses, length and speed; None is the preset's value.

    Attributes:
        output: Folder that the run is written to.
        preset: Networks, losses and optimizer of the shipped checkpoint (default), of the paper, or small
            ones for trials (tiny).
        form: Form of the Reflectance Network to train: default, paper, or an installed class.
        objective: Installed subclass of the stage's objective to train with (docs/training.md).
        resume: Continue the run in DIR from its last save; use it with the same options.
        start_from: Checkpoint to start from; networks that the stage does not train are copied.
        dataset: Dataset of prepare-dataset and relight-dataset to train on, in place of synthetic heads.
        texture_size: Side of the textures that a dataset is unwrapped to, in texels; in the stages joint and
            appearance-features also of its crops.
        photos: Folder of photos of faces to train on in a fifth of the batches of the stage joint.
        heads_from: Face model that synthetic heads are drawn from; for whole people, several with commas.
        fit_with: Face model that is fitted to the heads; for a dataset, its own model. In the stage joint it
            requires --geometry landmarks.
        heads: Number of synthetic heads to bake.
        views: Number of views to fit for each head.
        bank: Folder of baked heads.
        jobs: Number of worker processes that bake heads or detect faces.
        vgg_weights: Add the feature loss of VGG-16 to the stage joint: imagenet downloads its weights; or a
            file.
        appearance_features: Checkpoint of the stage appearance-features to use in place of --vgg-weights.
        light_features: Add the feature loss on textures, with a checkpoint of the stage light-features.
        without_normals: Train the Reflectance Network without normal maps (ablation).
        mean_face: Fit only poses, with the mean face for everyone (ablation).
        geometry: In the stage joint, also train the Geometry Network, or fit heads to landmarks and train
            only the Reflectance Network.
        workers: Number of processes that draw samples ahead.
        learning_rate: Highest learning rate.
        steps: Number of steps of the run.
        max_time: Duration of the run, such as 90s, 45m or 2h, summed over all resumptions.
        validate_every: Number of steps between validations on held-out people, each followed by a save.
        batch: Samples per step, of all processes together.
        gradient_clip: Largest norm of the gradient; a larger one is scaled down. 0: no clipping.
        ema_decay: Decay of the weights' average over steps, which is validated and saved; 0: no average.
        bf16: Train in mixed precision (bfloat16) if the device has instructions for it.
        accumulate: Number of parts that a process's share of a batch is divided into, to save memory.
        compile: Compile the networks with torch; the first steps take minutes.
    """

    settings: Settings
    output: Path = option(Path(), metavar="DIR", flags=("--output", "-o"), panel=RUN, required=True)
    preset: Preset = option("default", panel=RUN)
    form: str = option(
        "default",
        metavar="NAME|MODULE:CLASS",
        shown_default="paper with --preset paper, else default",
        typed=str | None,
        panel=RUN,
    )
    objective: str | None = option(None, metavar="MODULE:CLASS", shown_default="the stage's", panel=LOSSES)
    stage: Stage = option(
        "reflectance",
        f"Stage whose networks are trained: {', '.join(STAGES)}.",
        "STAGE",
        shown_default="joint with --preset paper, else reflectance",
        typed=Stage | None,
        panel=RUN,
        everyday=True,
    )
    resume: bool = option(False, panel=RUN)
    start_from: Path | None = option(None, metavar="FILE", shown_default="none", panel=RUN, everyday=True)
    dataset: Path | None = option(None, metavar="DIR", shown_default="synthetic heads", panel=DATA)
    texture_size: int | None = option(
        None,
        metavar="PX",
        shown_default="128, joint 256; with --preset paper 512",
        least=32,
        most=1024,
        panel=DATA,
    )
    photos: Path | None = option(None, metavar="DIR", shown_default="none", panel=DATA)
    heads_from: str = option("builtin", metavar="NAME|PATH", panel=DATA)
    fit_with: str = option("builtin", metavar="NAME|PATH", panel=DATA)
    heads: int | None = option(None, shown_default="240; tiny 16", least=2, panel=DATA)
    views: int | None = option(None, shown_default="8; tiny 2", least=1, panel=DATA)
    bank: Path | None = option(None, metavar="DIR", shown_default="DIR/bank", panel=DATA)
    jobs: int = option(2, flags=("--jobs", "-j"), least=1, panel=DATA)
    vgg_weights: str | None = option(
        None, metavar="imagenet|PATH", shown_default="without this loss", panel=LOSSES
    )
    appearance_features: Path | None = option(
        None, metavar="FILE", shown_default="without this loss", panel=LOSSES
    )
    light_features: Path | None = option(
        None, metavar="FILE", shown_default="without this loss", panel=LOSSES
    )
    without_normals: bool = option(False, panel=LOSSES)
    mean_face: bool = option(False, panel=LOSSES)
    geometry: Literal["landmarks", "network"] = option("network", panel=LOSSES)
    workers: int | None = option(
        None, shown_default="1 on a CPU of more than one core, 4 on a GPU", least=0, panel=SPEED
    )
    learning_rate: float | None = option(
        None,
        shown_default=_by_preset(lambda settings: settings.optimizer.learning_rate),
        least=1e-9,
        panel=RUN,
    )
    steps: int | None = option(None, shown_default="no limit", least=1, panel=LENGTH)
    max_time: float | None = option(
        None,
        metavar="TIME",
        shown_default=f"{_DEFAULT_TIME}; no limit with --steps",
        parse=_seconds,
        panel=LENGTH,
    )
    validate_every: int | None = option(
        None,
        metavar="STEPS",
        shown_default=_by_preset(lambda settings: settings.validate_every),
        least=1,
        panel=LENGTH,
    )
    batch: int | None = option(
        None, shown_default=_by_preset(lambda settings: settings.batch), least=1, panel=SPEED
    )
    bf16: bool | None = option(
        None,
        flags=("--bf16/--no-bf16",),
        shown_default="on; presets paper and tiny, and --form paper, off",
        panel=SPEED,
    )
    accumulate: int = option(1, least=1, panel=SPEED)
    compile: bool = option(False, panel=SPEED)
    gradient_clip: float | None = option(
        None, shown_default=_by_preset(lambda settings: settings.gradient_clip or 0), least=0, panel=RUN
    )
    ema_decay: float | None = option(
        None,
        shown_default=_by_preset(lambda settings: settings.ema_decay or 0),
        least=0,
        most=0.99999,
        panel=RUN,
    )

    def training(self, tables: Mapping[str, Any]) -> TrainSettings:
        """Return the preset's settings, changed by a configuration file's tables, then by the options."""
        training = with_tables(preset_of(self.preset, self.stage), tables)
        optimizer = training.optimizer
        max_seconds = _seconds(_DEFAULT_TIME) if self.max_time is self.steps is None else self.max_time
        return replace(
            training,
            steps=self.steps,
            max_seconds=max_seconds,
            seed=self.settings.seed,
            compile=self.compile,
            accumulate=self.accumulate,
            optimizer=replace(optimizer, learning_rate=self.learning_rate or optimizer.learning_rate),
            batch=self.batch or training.batch,
            validate_every=self.validate_every or training.validate_every,
            gradient_clip=_or_none(self.gradient_clip, training.gradient_clip),
            ema_decay=_or_none(self.ema_decay, training.ema_decay),
            # the gradients of the form paper overflow
            bf16=training.bf16 and self.form != "paper" if self.bf16 is None else self.bf16,
        )
