"""Settings of a training run: its stage, optimizer, schedule, precision and length; and the presets.

Presets are the files `presets/*.toml`. The command line reads its defaults here, so this module does not
import torch. Each run writes DIR/config.toml: [train] contains options of the command line; [train.loss],
[train.optimizer] and [train.schedule] contain the other settings.
"""

import json
import math
import tomllib
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
CONFIG = "config.toml"
_BELOW_1 = ("rho", "betas", "floor")


@dataclass(frozen=True)
class StageEntry:
    """How a stage is built, and which options it has.

    Attributes:
        build: Module and function that make its objective from a `Run` (`training/run.py`).
        options: Options that apply to some stages, by name, and apply to this one.
        networks: The networks that it trains, if they are not named like the stage.
        in_paper: The preset paper trains it as the paper does.
    """

    build: str
    options: frozenset[str]
    networks: tuple[str, ...] = ()
    in_paper: bool = True


_HEADS = frozenset({"heads_from", "heads", "bank"})
_CROPS = frozenset({"dataset", "texture_size"})
_TEXTURES = _HEADS | _CROPS | {"views", "fit_with"}
_REFLECTANCE = frozenset({"light_features", "form", "without_normals", "mean_face"})
_JOINT = _CROPS | _REFLECTANCE | {"fit_with", "geometry", "photos", "vgg_weights", "appearance_features"}
STAGES: dict[Stage, StageEntry] = {
    "reflectance": StageEntry("texture:build", _TEXTURES | _REFLECTANCE),
    "geometry": StageEntry("geometry:build", _HEADS),
    "joint": StageEntry("joint:build", _JOINT, ("reflectance", "geometry")),
    "light-features": StageEntry("light_features:build", _TEXTURES, in_paper=False),
    "appearance-features": StageEntry("light_features:build_appearance", _CROPS, in_paper=False),
    "diffuse-sh": StageEntry("diffuse_sh:build", _TEXTURES),
    "parsing": StageEntry("parsing:build", _HEADS, in_paper=False),
    "portrait": StageEntry("portrait:build", _HEADS | {"dataset"}, in_paper=False),
}


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
        """Return the factor of the learning rate at a step, from 0; `done` is the fraction of the run."""
        warm = min(1.0, (step + 1) / self.warmup_steps)
        return warm * (self.floor + (1 - self.floor) * 0.5 * (1 + math.cos(math.pi * min(done, 1.0))))


@dataclass(frozen=True)
class Constant:
    """Constant learning rate."""

    def factor(self, step: int, done: float) -> float:
        """Return the factor of the learning rate: 1."""
        return 1.0


@dataclass(frozen=True)
class PaperWeights:
    """Weights of the paper: lambda_l, lambda_r, lambda_p, lambda_f; of L_r, lambda_alpha and lambda_beta."""

    landmarks: float = 25.0
    regularisation: float = 1.0
    photometric: float = 5.0
    features: float = 1.0
    alpha: float = 0.4
    beta: float = 0.002


# The tables of settings that a configuration file may change, and their kinds.
KINDS: dict[str, tuple[type[Any], ...]] = {
    "loss": (PaperWeights,),
    "optimizer": (AdamW, Adadelta),
    "schedule": (Cosine, Constant),
}


def _may_change(default: Any) -> Any:
    return field(default=default, metadata=NOT_IN_RECIPE)


@dataclass(frozen=True)
class TrainSettings:
    """Settings of the training loop."""

    batch: int  # samples per step, of all processes together
    optimizer: AdamW | Adadelta
    schedule: Cosine | Constant
    gradient_clip: float | None = None  # largest norm; None: no clipping
    ema_decay: float | None = None  # of the weights that are validated and saved; None: not averaged
    bf16: bool = False
    loss: PaperWeights = PaperWeights()  # of the stage joint
    seed: int = 0
    # What may differ between a run and its resumption.
    validate_every: int = _may_change(500)  # steps
    steps: int | None = _may_change(None)  # the run ends after this many steps or max_seconds
    max_seconds: float | None = _may_change(None)
    workers: int = _may_change(0)  # processes that draw batches; 0: the training process itself
    compile: bool = _may_change(False)
    accumulate: int = _may_change(1)  # parts of a step's batch, one after another in each process

    def done(self, step: int, seconds: float) -> float:
        """Return the fraction of the run that is over before a step, counted from 0."""
        by_steps = step / self.steps if self.steps else 0.0
        return max(by_steps, seconds / self.max_seconds if self.max_seconds else 0.0)


@dataclass(frozen=True)
class Sizes:
    """Amounts of data and sizes of networks."""

    heads: int = 240
    views: int = 8
    texture_side: int = 128  # of a dataset's textures
    joint_side: int = 256  # of the stage joint's crops and textures
    held_out_people: int = 12
    light_width: float = 0.25  # of S_f and V_f; 1 is VGG-16's
    bake_side: int = 128  # texels along a side of baked heads
    rig_lights: int = 150  # that heads and the mean face are baked under


_TABLES: dict[str, dict[str, Any]] = {
    path.stem: tomllib.loads(path.read_text())
    for path in sorted(Path(__file__).with_name("presets").glob("*.toml"))
}


def _training_of(preset: str) -> TrainSettings:
    table = dict(_TABLES[preset]["training"])
    kinds = {kind.__name__: kind for group in KINDS.values() for kind in group}
    for group in ("optimizer", "schedule"):
        values = dict(table[group])
        table[group] = kinds[values.pop("name")](**values)
    return TrainSettings(**table)


PRESETS: dict[str, TrainSettings] = {preset: _training_of(preset) for preset in _TABLES}


def preset_of(preset: Preset, stage: Stage) -> TrainSettings:
    """Return a preset's settings for a stage."""
    if preset == "paper" and not STAGES[stage].in_paper:
        preset = "default"
    batch = _TABLES[preset].get("batches", {}).get(stage)
    return replace(PRESETS[preset], batch=batch) if batch else PRESETS[preset]


def sizes_of(preset: Preset) -> Sizes:
    """Return a preset's sizes."""
    return Sizes(**_TABLES[preset].get("sizes", {}))


def network_settings_of(preset: Preset, name: str, form: str) -> dict[str, Any]:
    """Return a preset's settings of a network, as far as they differ from its form's."""
    settings: dict[str, Any] = _TABLES[preset].get("networks", {}).get(f"{name} {form}", {})
    return settings


def with_tables(training: TrainSettings, tables: Mapping[str, Any]) -> TrainSettings:
    """Change settings by the tables `loss`, `optimizer` and `schedule`; UsageError for a wrong one."""
    changed = {name: _changed(getattr(training, name), name, table) for name, table in tables.items()}
    return replace(training, **changed)


def _changed(before: Any, name: str, table: Any) -> Any:
    """Change a group of settings by a table, whose `name` may choose another kind of the group."""
    from pydantic import ConfigDict, TypeAdapter, ValidationError  # takes a tenth of a second

    where = f"--config: [train.{name}]"
    if not isinstance(table, Mapping):
        raise UsageError(f"{where} is not a table; write [train.{name}]")
    kinds = {kind.__name__: kind for kind in KINDS[name]}
    chosen = table.get("name", type(before).__name__)
    if chosen not in kinds:
        raise UsageError(f"{where} name is {chosen!r}; use one of {', '.join(kinds)}")
    values = asdict(before) if kinds[chosen] is type(before) else {}
    values |= {key: value for key, value in table.items() if key != "name"}
    try:
        kind = kinds[chosen]
        kind.__pydantic_config__ = ConfigDict(strict=True, extra="forbid")
        made = TypeAdapter(kind).validate_json(json.dumps(values))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise UsageError(f"{where} {first['loc'][0]}: {first['msg'].lower()}; see docs/training.md") from None
    for key, value in asdict(made).items():
        most = 1.0 if key in _BELOW_1 else math.inf
        if not all(0 <= number < most for number in (value if isinstance(value, tuple) else (value,))):
            raise UsageError(
                f"{where} {key} is {value}; use numbers from 0{' to below 1' if most == 1 else ''}"
            )
    return made


def write_config(folder: Path, options: Mapping[str, Any], training: TrainSettings, seed: int) -> None:
    """Write DIR/config.toml: the options of the command line by name, and the tables of `KINDS`.

    TOML's strings, numbers and lists are JSON's; paths are made absolute.
    """
    tables: dict[str, Mapping[str, Any]] = {"global": {"seed": seed}, "train": options}
    for name in KINDS:
        group = getattr(training, name)
        tables[f"train.{name}"] = {"name": type(group).__name__, **asdict(group)}
    lines = []
    for name, table in tables.items():
        lines.append(f"[{name}]")
        for key, value in table.items():
            lines.append(f"{key} = {json.dumps(str(value.absolute()) if isinstance(value, Path) else value)}")
    with atomic_path(folder / CONFIG) as temporary:
        temporary.write_text("\n".join([*lines, ""]), encoding="utf-8")
