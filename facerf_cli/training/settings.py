"""How a run of training goes: optimiser, schedule, precision and when it ends; and the presets."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import nn


@dataclass(frozen=True)
class AdamW:
    """Of the presets `default` and `tiny`."""

    learning_rate: float = 1.5e-3
    betas: tuple[float, float] = (0.9, 0.98)
    weight_decay: float = 1e-4

    def build(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        """The optimiser of these weights."""
        return torch.optim.AdamW(
            parameters, lr=self.learning_rate, betas=self.betas, weight_decay=self.weight_decay
        )


@dataclass(frozen=True)
class Adadelta:
    """Of the preset `paper` (its 'Training'); rho and eps are TensorFlow's, which the paper used."""

    learning_rate: float = 0.05
    rho: float = 0.95
    eps: float = 1e-8

    def build(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        """The optimiser of these weights."""
        return torch.optim.Adadelta(parameters, lr=self.learning_rate, rho=self.rho, eps=self.eps)


@dataclass(frozen=True)
class Cosine:
    """Linear warm-up, then a half cosine over the steps or the time of the run down to `floor`."""

    warmup_steps: int = 150
    floor: float = 0.02

    def factor(self, step: int, done: float) -> float:
        """Of the learning rate at a step, counted from 0, when the share `done` of the run is over."""
        warm = min(1.0, (step + 1) / self.warmup_steps)
        return warm * (self.floor + (1 - self.floor) * 0.5 * (1 + math.cos(math.pi * min(done, 1.0))))


@dataclass(frozen=True)
class Constant:
    """The same rate throughout."""

    def factor(self, step: int, done: float) -> float:
        """1."""
        return 1.0


@dataclass(frozen=True)
class TrainSettings:
    """What the loop goes by; its own values are the preset `default`."""

    batch: int = 4  # of all processes together
    optimizer: AdamW | Adadelta = AdamW()
    schedule: Cosine | Constant = Cosine()
    gradient_clip: float | None = 1.0  # longest norm; None: as it comes
    ema_decay: float | None = 0.998  # of the weights that are validated and saved; None: the last ones
    bf16: bool = True
    validate_every: int = 500
    steps: int | None = None  # the run ends with whichever of these two comes first
    max_seconds: float | None = None
    seed: int = 0
    workers: int = 0  # processes that draw batches; 0: the loop itself
    compile: bool = False

    def done(self, step: int, seconds: float) -> float:
        """Share of the run that is over before a step, counted from 0."""
        by_steps = step / self.steps if self.steps else 0.0
        return max(by_steps, seconds / self.max_seconds if self.max_seconds else 0.0)


PRESETS = {
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
# Settings that a run may be resumed with although it was begun with others.
MAY_CHANGE = frozenset({"steps", "max_seconds", "validate_every", "workers", "compile"})
