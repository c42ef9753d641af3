"""Settings of a training run: stage, optimizer, schedule, precision and length; and the presets.

The command line reads its defaults here, so this module imports no torch. Each run writes DIR/config.toml:
[train] has options of the command line; [train.loss], [train.optimizer] and [train.schedule] have the rest.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.errors import UsageError
from facerf_cli.files.atomic import atomic_path

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
CONFIG = "config.toml"
_BELOW_1 = ("rho", "betas", "floor")


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


def with_tables(training: TrainSettings, tables: Mapping[str, Any]) -> TrainSettings:
    """Change settings by the tables `loss`, `optimizer` and `schedule`; UsageError for a wrong one."""
    changed = {name: _changed(getattr(training, name), name, table) for name, table in tables.items()}
    return replace(training, **changed)


def _changed(before: Any, name: str, table: Any) -> Any:
    """A group of settings with a table's values; `name` in the table chooses another kind of it."""
    where, kinds = f"--config: [train.{name}]", KINDS[name]
    if not isinstance(table, Mapping):
        raise UsageError(f"{where} is no table; write [train.{name}]")
    chosen = table.get("name", type(before).__name__)
    if chosen not in kinds:
        raise UsageError(f"{where} name is {chosen!r}; give one of {', '.join(kinds)}")
    values = asdict(before if kinds[chosen] is type(before) else kinds[chosen]())
    for key in table.keys() - {"name"}:
        if key not in values:
            raise UsageError(f"{where} {key}: no such setting; give one of {', '.join(values)}")
        values[key] = _like(values[key], table[key], f"{where} {key}")
    return kinds[chosen](**values)


def _like(default: Any, value: Any, where: str) -> Any:
    """A value as true or false, or numbers of the default's kind and count, from 0 on."""
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise UsageError(f"{where} is {value}; give true or false")
        return value
    several = isinstance(default, tuple)
    numbers = list(value) if several and isinstance(value, list) else [value]
    kind = int if isinstance(default, int) else (int, float)
    most = 1.0 if where.endswith(_BELOW_1) else math.inf
    sound = [isinstance(x, kind) and not isinstance(x, bool) and 0 <= x < most for x in numbers]
    if not all(sound) or len(numbers) != (len(default) if several else 1):
        wanted = f"{len(default)} numbers" if several else "a whole number" if kind is int else "a number"
        raise UsageError(f"{where} is {value}; give {wanted} from 0{' to below 1' if most == 1 else ' on'}")
    return tuple(map(float, numbers)) if several else type(default)(value)


def write_config(folder: Path, options: Mapping[str, Any], training: TrainSettings, seed: int) -> None:
    """Write DIR/config.toml: the options of the command line by name, and all other settings in force."""
    tables = {"global": {"seed": seed}, "train": options}
    for name in KINDS:
        group = getattr(training, name)
        kind = {"name": type(group).__name__} if len(KINDS[name]) > 1 else {}
        tables[f"train.{name}"] = kind | asdict(group)
    text = "\n".join(
        "".join([f"[{name}]\n", *(f"{key} = {_toml(value)}\n" for key, value in table.items())])
        for name, table in tables.items()
    )
    with atomic_path(folder / CONFIG) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _toml(value: Any) -> str:
    """A value in TOML, whose strings, numbers and lists are JSON's; paths are made absolute."""
    return json.dumps(str(value.absolute()) if isinstance(value, Path) else value)
