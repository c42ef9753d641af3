"""Settings of a training run: stage, optimizer, schedule, precision and length; and the presets.

The command line reads its defaults here, so this module imports no torch.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from facerf_cli.batch.settings import NOT_IN_RECIPE

Preset = Literal["default", "paper", "tiny"]
Stage = Literal[
    "reflectance",
    "geometry",
    "joint",
    "light-features",
    "appearance-features",
    "diffuse-sh",
    "parsing",
    "portrait",
]
_BATCHES = {"parsing": 16, "portrait": 8}  # of stages that look at whole people
FEATURE_STAGES = ("light-features", "appearance-features")  # of networks that a loss compares images with


_BESIDE_THE_PAPER = (*FEATURE_STAGES, *_BATCHES)


@dataclass(frozen=True)
class AdamW:
    """Optimizer of the presets `default` and `tiny`."""

    learning_rate: float = 1.5e-3
    betas: tuple[float, float] = (0.9, 0.98)
    weight_decay: float = 1e-4


@dataclass(frozen=True)
class Adadelta:
    """Optimizer of the preset `paper` (paper, 'Training'); rho and eps are TensorFlow's, which it used."""

    learning_rate: float = 0.05
    rho: float = 0.95
    eps: float = 1e-8


@dataclass(frozen=True)
class Cosine:
    """Linear warm-up, then half a cosine down to `floor`, over the run's steps or time."""

    warmup_steps: int = 150
    floor: float = 0.02

    def factor(self, step: int, done: float) -> float:
        """Factor of the learning rate at a step, from 0, when the share `done` of the run is over."""
        warm = min(1.0, (step + 1) / self.warmup_steps)
        return warm * (self.floor + (1 - self.floor) * 0.5 * (1 + math.cos(math.pi * min(done, 1.0))))


@dataclass(frozen=True)
class Constant:
    """Constant learning rate."""

    def factor(self, step: int, done: float) -> float:
        """Factor of the learning rate: 1."""
        return 1.0


@dataclass(frozen=True)
class PaperWeights:
    """The paper's lambda_l, lambda_r, lambda_p and lambda_f, and lambda_alpha and lambda_beta of L_r.

    With `channels_apart` S_f and a V_f of facerf compare the colour channels by themselves; ImageNet's V_f
    always sees colours, as the paper's does.
    """

    landmarks: float = 25.0
    regularisation: float = 1.0
    photometric: float = 5.0
    features: float = 1.0
    alpha: float = 0.4
    beta: float = 0.002
    channels_apart: bool = True


# The groups of settings that a configuration file may change, and their kinds by name.
KINDS: dict[str, dict[str, Any]] = {
    "loss": {"PaperWeights": PaperWeights},
    "optimizer": {"AdamW": AdamW, "Adadelta": Adadelta},
    "schedule": {"Cosine": Cosine, "Constant": Constant},
}


def _may_change(default: Any) -> Any:
    return field(default=default, metadata=NOT_IN_RECIPE)


@dataclass(frozen=True)
class TrainSettings:
    """Settings of the training loop; the defaults are the preset `default`."""

    batch: int = 4  # samples a step, of all processes together
    optimizer: AdamW | Adadelta = AdamW()
    schedule: Cosine | Constant = Cosine()
    gradient_clip: float | None = 1.0  # largest norm; None: no clipping
    ema_decay: float | None = 0.998  # of the weights that are validated and saved; None: not averaged
    bf16: bool = True
    loss: PaperWeights = PaperWeights()  # of the stage joint
    seed: int = 0
    # What may differ between a run and its resumption.
    validate_every: int = _may_change(500)  # steps
    steps: int | None = _may_change(None)  # the run ends after so many steps or max_seconds, if that is first
    max_seconds: float | None = _may_change(None)
    workers: int = _may_change(0)  # processes that draw batches; 0: the training process itself
    compile: bool = _may_change(False)
    accumulate: int = _may_change(1)  # parts of a step's batch, one after another in each process

    def done(self, step: int, seconds: float) -> float:
        """Share of the run that is over before a step, counted from 0."""
        by_steps = step / self.steps if self.steps else 0.0
        return max(by_steps, seconds / self.max_seconds if self.max_seconds else 0.0)


PRESETS: dict[Preset, TrainSettings] = {
    "default": TrainSettings(),
    "paper": TrainSettings(
        batch=1,
        optimizer=Adadelta(),
        schedule=Constant(),
        gradient_clip=None,
        ema_decay=None,
        bf16=False,
        validate_every=1000,
    ),
    "tiny": TrainSettings(
        batch=2,
        optimizer=AdamW(learning_rate=4e-3),
        schedule=Cosine(warmup_steps=5),
        ema_decay=0.9,
        bf16=False,
        validate_every=10,
    ),
}


def preset_of(preset: Preset, stage: Stage) -> TrainSettings:
    """Settings of a preset; the paper's optimizer is for its own loss, not for networks besides it.

    It does not say how those of its features were trained.
    """
    settings = PRESETS["default" if preset == "paper" and stage in _BESIDE_THE_PAPER else preset]
    own = preset != "tiny" and stage in _BATCHES
    return replace(settings, batch=_BATCHES[stage]) if own else settings
