"""The options that verbs share, so that each is named, explained and read once.

`--shard` and `--ray`, for every verb that walks folders.
"""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from facerf_cli.errors import UsageError
from facerf_cli.workers import Workers

if TYPE_CHECKING:
    import torch

T = TypeVar("T")
DeviceName = Literal["auto", "cpu", "cuda", "mps"]


@dataclass(frozen=True)
class Shard:
    """Which of the items are this process's: every `of`th, from number `number` on, which counts from 1."""

    number: int = 1
    of: int = 1

    @staticmethod
    def parse(text: str | None) -> "Shard":
        """`K/N`; all items where nothing is given. UsageError for what is no such share."""
        if text is None:
            return Shard()
        number, slash, of = text.partition("/")
        if not (slash and number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
            raise UsageError(f"--shard {text}: give K/N with K from 1 to N, as 3/8")
        return Shard(int(number), int(of))

    def share(self, items: Sequence[T]) -> Sequence[T]:
        """This process's items."""
        return items[self.number - 1 :: self.of]


@dataclass(frozen=True)
class Settings:
    """The global options, and which items are worked on where; `ctx.obj` in every verb."""

    verbosity: int = 0  # -1 errors only, 0 notes and warnings, 1 everything and tracebacks
    log_json: bool = False
    device: DeviceName = "auto"
    checkpoint: Path | None = None  # None: the one in assets/
    seed: int = 0
    shard: Shard = Shard()
    ray: str | None = None  # None: this machine, without Ray


def settings_of(context: typer.Context) -> Settings:
    """The global options of this call."""
    settings = context.obj
    assert isinstance(settings, Settings)
    return settings


def workers_of(settings: Settings, jobs: int) -> Workers:
    """The workers that `--jobs`, `--ray` and `--device` ask for."""
    return Workers(jobs, settings.ray, int(settings.device == "cuda"))


def was_given(context: typer.Context, name: str) -> bool:
    """Whether the command line names an option, be it with its default."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def flag(name: str) -> str:
    """An option as it is typed."""
    return f"--{name.replace('_', '-')}"


def refuse_given(context: typer.Context, names: Sequence[str], why: str) -> None:
    """UsageError for those of the options that were given although they would do nothing; `why` goes on."""
    for name in names:
        if was_given(context, name):
            raise UsageError(f"{flag(name)} {why}")


def torch_device(settings: Settings) -> "torch.device":
    """Seed torch and give the device that `--device` names; `auto` takes cuda, then mps, then cpu."""
    import torch

    torch.manual_seed(settings.seed)
    present = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    name = next(kind for kind in present if present[kind]) if settings.device == "auto" else settings.device
    if not present[name]:
        found = ", ".join(kind for kind in present if present[kind])
        raise UsageError(f"--device {name}: torch finds no such device here (it finds: {found})")
    return torch.device(name)


InputsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="PHOTO...",
        help="Pictures, folders (walked recursively), or - for a list of paths on standard input.",
        show_default=False,
    ),
]
OutputOption = Annotated[
    Path,
    typer.Option("--output", "-o", metavar="DIR", help="Folder for the results.", show_default=False),
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Make results anew that are already there (default: skip them).")
]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="Say what would be read and written; write nothing.")
]
JobsOption = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Pictures worked on at a time.")]
ShardOption = Annotated[
    str | None,
    typer.Option(
        "--shard",
        metavar="K/N",
        help="Every Nth item only, from the Kth on; the other shards are for other machines.",
        show_default="all items",
    ),
]
RayOption = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="ADDRESS",
        help="Work as tasks of Ray: HOST:PORT of a cluster's head, auto, or local for this machine; --jobs "
        "tasks at a time, by default one a processor, and with --device cuda one a GPU.",
        show_default=False,
    ),
]
InputColourspaceOption = Annotated[
    str | None,
    typer.Option(
        "--input-colourspace",
        metavar="NAME",
        help="Colour space of the input, over what the file says: sRGB, linear (lin_rec709), ACEScg, "
        "Rec.2020, lin_rec2020, 'Display P3', or any name of the OCIO configuration.",
        show_default="what the file says",
    ),
]
FaceModelOption = Annotated[
    str,
    typer.Option(
        "--face-model",
        metavar="NAME|PATH",
        help="Morphable model: builtin, or a .npz by `face-model import`.",
    ),
]

_AFTER, _ALSO = "jobs", "dry_run"  # by these a verb that walks folders is known


def with_machines(verb: Callable[..., Any]) -> Callable[..., Any]:
    """The verb with `--shard` and `--ray` after its `--jobs`; a verb that walks no folders stays as it is.

    They go where `run_items` finds them, into the verb's `Settings`, so that the verb need not know them.
    typer reads signatures, so the function that it gets has one that lists them.
    """
    own = inspect.signature(verb).parameters
    if not {_AFTER, _ALSO} <= own.keys():
        return verb

    def run(**values: Any) -> Any:
        context = values["context"]
        shard, ray = Shard.parse(values.pop("shard")), values.pop("ray")
        context.obj = replace(settings_of(context), shard=shard, ray=ray)
        if ray is not None and context.get_parameter_source(_AFTER).name == "DEFAULT":
            values[_AFTER] = 0  # as many as Ray has processors
        return verb(**values)

    kind = inspect.Parameter.KEYWORD_ONLY
    added = [
        inspect.Parameter(name, kind, default=None, annotation=option)
        for name, option in (("shard", ShardOption), ("ray", RayOption))
    ]
    parameters = [parameter.replace(kind=kind) for parameter in own.values()]
    place = list(own).index(_AFTER) + 1
    parameters[place:place] = added
    as_typer_reads_it: Any = run
    as_typer_reads_it.__signature__ = inspect.Signature(parameters)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__name__, run.__doc__ = verb.__name__, verb.__doc__
    return run
