"""The options that verbs share, each named, explained and read once; and the choice of workers."""

import dataclasses
import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from facerf_cli.batch.settings import Overwrite, Settings, Shard
from facerf_cli.errors import UsageError
from facerf_cli.option import Only, Option, option_fields

_FILE_SUFFIX = re.compile(
    r"\.(exr|hdr|png|jpe?g|tiff?|webp|gif|bmp|heic|jsonl?|txt|csv|html|pdf|zip|npz|safetensors|glb|obj"
    r"|mp4|mov|m4v|webm|avi|mkv)",
    re.IGNORECASE,
)
EPILOG = (
    "Global options (--checkpoint, --device, --memory, --seed, -v, -q; see 'facerf --help') may stand before "
    "or after the verb."
)
HELP_NAMES = {"help_option_names": ["-h", "--help"]}

# Panels of a verb's options in its help, in the order in which verbs list them. What must be given, --output
# and --help have none: they stand first, under Options.
LIGHT, IMAGE, FACE, METHOD, BATCH = "Light", "Image", "Face", "Method", "Batch"


def settings_of(context: typer.Context) -> Settings:
    """The global options of this call."""
    settings = context.obj
    assert isinstance(settings, Settings)
    return settings


def was_given(context: typer.Context, name: str) -> bool:
    """True if the command line names an option, even with its default value."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def flag(name: str) -> str:
    """An option as it is typed on the command line."""
    return f"--{name.replace('_', '-')}"


def refuse_given(context: typer.Context, names: Sequence[str], why: str) -> None:
    """Raise UsageError for an option that is given but would do nothing; `why` completes the message."""
    for name in names:
        if was_given(context, name):
            raise UsageError(f"{flag(name)} {why}")


InputsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="PHOTO...",
        help="Images, folders (walked recursively), frames (plate.1001-1050.exr, plate.%04d.exr), or - to "
        "read a list of paths from standard input.",
        show_default=False,
    ),
]


def folder_not_file(output: Path) -> Path:
    """The folder that `-o` names; raises UsageError for a file's name, unless such a folder is there."""
    if _FILE_SUFFIX.fullmatch(output.suffix) and not output.is_dir():
        raise UsageError(f"-o {output}: is a file's name; give a folder, such as -o {output.with_suffix('')}")
    return output


OutputOption = Annotated[
    Path,
    typer.Option(
        "--output",
        "-o",
        metavar="DIR",
        help="Write the results to this folder.",
        show_default=False,
        callback=folder_not_file,
    ),
]
NameOption = Annotated[
    str | None,
    typer.Option(
        "--name",
        metavar="PATTERN",
        help="Name the outputs by a pattern of {dir}, {parent}, {stem}, {ext} and {frame:04}; what each is "
        "follows it.",
        show_default="{dir}/{stem}.{frame}",
        rich_help_panel=BATCH,
    ),
]
OverwriteOption = Annotated[
    Overwrite,
    typer.Option(
        help="Make again results that exist: never; those that were made from other inputs, options or "
        "networks (changed); or always.",
        rich_help_panel=BATCH,
    ),
]
DryRunOption = Annotated[
    bool,
    typer.Option(
        "--dry-run", help="List what would be read and written; write nothing.", rich_help_panel=BATCH
    ),
]
JobsOption = Annotated[
    int,
    typer.Option("--jobs", "-j", min=1, help="Process this many items at a time.", rich_help_panel=BATCH),
]
ShardOption = Annotated[
    str | None,
    typer.Option(
        "--shard",
        metavar="K/N",
        help="Process every Nth item only, from the Kth on; other machines take the rest.",
        show_default="all items",
        rich_help_panel=BATCH,
    ),
]
RayOption = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="ADDRESS",
        help="Run as tasks of Ray on a cluster (HOST:PORT of its head, or auto) or on this machine (local).",
        show_default=False,
        rich_help_panel=BATCH,
    ),
]
InputColourspaceOption = Annotated[
    str | None,
    typer.Option(
        "--input-colourspace",
        metavar="NAME",
        help="Read the input in this colour space: sRGB, linear, ACEScg, Rec.2020, 'Display P3', or any name "
        "of the OCIO configuration.",
        show_default="the file's",
        rich_help_panel=IMAGE,
    ),
]
NetworkAloneOption = Annotated[
    bool,
    typer.Option(
        "--network-alone",
        help="Use the network's own field, without the correction by the photo's quotient.",
        rich_help_panel=METHOD,
    ),
]
FaceModelOption = Annotated[
    str,
    typer.Option(
        "--face-model",
        metavar="NAME|PATH",
        help="Fit this morphable model: builtin, or a .npz of `face-model import`.",
        rich_help_panel=FACE,
    ),
]


def unwrapped(docstring: str) -> str:
    """A docstring with a line for each paragraph, which the help breaks at the terminal's width."""
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in docstring.split("\n\n"))


def with_groups(verb: Callable[..., Any]) -> Callable[..., Any]:
    """Replace each parameter of a verb that is a group of options (`option.py`) by the options themselves.

    A group's field `settings` is filled with the global options of the call.
    """
    hints = get_type_hints(verb, include_extras=True)
    groups = {name: chosen for name, hint in hints.items() if (chosen := _group_of(hint)) is not None}
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(verb).parameters.values():
        if parameter.name in groups:
            parameters += map(_parameter, *zip(*groups[parameter.name][1].items(), strict=True))
        else:
            parameters.append(parameter.replace(annotation=hints[parameter.name]))

    def run(**values: Any) -> Any:
        for name, (group, fields) in groups.items():
            given = {field: values.pop(field) for field in fields}
            if "settings" in group.__dataclass_fields__:
                given["settings"] = settings_of(values["context"])
            values[name] = group(**given)
        return verb(**values)

    return _with_signature(run, parameters, verb) if groups else verb


def _group_of(hint: Any) -> tuple[Any, dict[str, Any]] | None:
    """The dataclass of a parameter and its options by name; None where the parameter is no group."""
    group, *notes = (hint.__origin__, *hint.__metadata__) if hasattr(hint, "__metadata__") else (hint,)
    fields = option_fields(group)
    for note in notes:
        if isinstance(note, Only):
            fields = {name: fields[name] for name in note.names}
    types = get_type_hints(group, include_extras=True) if fields else {}
    return (group, {name: (field, types[name]) for name, field in fields.items()}) if fields else None


def _parameter(name: str, typed: tuple[Any, Any]) -> inspect.Parameter:
    """A field of a group as typer reads it."""
    field, kind = typed
    about: Option = field.metadata["option"]
    declared = typer.Option(
        *(about.flags or (flag(name),)),
        metavar=about.metavar,
        help=about.help,
        show_default=about.shown_default,
        rich_help_panel=about.panel,
        min=about.least,
        max=about.most,
        callback=about.check,
    )
    default = inspect.Parameter.empty if field.default is dataclasses.MISSING else field.default
    keyword = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, keyword, default=default, annotation=Annotated[kind, declared])


def _with_signature(
    run: Callable[..., Any], parameters: Sequence[inspect.Parameter], verb: Callable[..., Any]
) -> Callable[..., Any]:
    """`run` under a verb's name, with a signature for typer, which reads those; all parameters by keyword."""
    listed = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
    as_typer_reads_it: Any = run
    as_typer_reads_it.__signature__ = inspect.Signature(listed)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in listed}
    run.__name__, run.__doc__ = verb.__name__, verb.__doc__
    return run


_AFTER, _ALSO = "jobs", "dry_run"  # by these a verb that walks folders is known


def with_machines(verb: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--shard` and `--ray` after a verb's `--jobs`; a verb that walks no folders stays as it is.

    Their values go into the verb's `Settings`, where `run_items` finds them.
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

    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=option)
        for name, option in (("shard", ShardOption), ("ray", RayOption))
    ]
    parameters = list(own.values())
    place = list(own).index(_AFTER) + 1
    return _with_signature(run, parameters[:place] + added + parameters[place:], verb)
