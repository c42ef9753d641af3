"""Options that commands share, and groups of options (`option.py`) as options of a command."""

import dataclasses
import inspect
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, get_type_hints

import typer
from rich.markup import escape

from facerf_cli.batch.settings import Settings
from facerf_cli.errors import UsageError
from facerf_cli.option import PANELS, Only, Option, Without, attributes_of, flag

EPILOG = (
    "Global options (--checkpoint, --device, --memory, --seed, -v, -q; see 'facerf --help-all') may stand "
    "before or after the command."
)
_MANY = 14  # parameters of a command whose --help omits some


def settings_of(context: typer.Context) -> Settings:
    """Return the global options of this call."""
    settings = context.find_root().obj
    assert isinstance(settings, Settings)
    return settings


def was_given(context: Any, name: str) -> bool:
    """Tell whether the command line contains an option, even with its default value."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def is_default(context: typer.Context, name: str) -> bool:
    """Tell whether neither the command line nor a configuration file sets an option."""
    source = context.get_parameter_source(name)
    return source is None or source.name == "DEFAULT"


def refuse_given(context: typer.Context, names: Sequence[str], why: str) -> None:
    """Raise UsageError for an option on the command line that has no effect; `why` completes the message."""
    typed = {parameter.name: parameter.opts[0] for parameter in context.command.params}
    for name in names:
        if was_given(context, name):
            raise UsageError(f"{typed[name]} {why}")


InputsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="PHOTO...",
        help="Images, folders (searched recursively), frames (plate.1001-1050.exr, plate.%04d.exr), or - for "
        "an image or a list on standard input.",
        show_default=False,
    ),
]
FramesArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="PHOTO|VIDEO...",
        help="Images, videos (.mp4, .mov, .mkv and more), folders of images (searched recursively), frames "
        "(plate.%04d.exr), or - for an image or a list.",
        show_default=False,
    ),
]


def unwrapped(docstring: str) -> str:
    """Join the lines of each paragraph of a docstring; the help wraps them at the terminal's width.

    Brackets are escaped: rich would take [relight] for a style.
    """
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in escape(docstring).split("\n\n"))


def with_groups(command: Callable[..., Any]) -> Callable[..., Any]:
    """Replace each parameter of a command that is a group of options (`option.py`) by these options.

    Groups may contain groups. A field `settings` is filled with the global options of the call.
    """
    hints = get_type_hints(command, include_extras=True)
    groups = {name: group for name, hint in hints.items() if (group := _group_of(hint)) is not None}
    if not groups:
        return command
    keyword = inspect.Parameter.KEYWORD_ONLY  # a required one may follow one with a default
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        if name in groups:
            parameters += groups[name].parameters()
        else:
            parameters.append(parameter.replace(annotation=hints[name], kind=keyword))
    parameters.sort(key=lambda parameter: PANELS.index(panel) if (panel := _panel(parameter)) else -1)
    takes_context = "context" in hints
    if not takes_context:
        parameters.insert(0, inspect.Parameter("context", keyword, annotation=typer.Context))

    def run(**values: Any) -> Any:
        settings = values["context"].find_root().obj
        if not takes_context:
            del values["context"]
        made = {name: group.made(values, settings) for name, group in groups.items()}
        return command(**made, **values)

    as_typer_reads_it: Any = run
    as_typer_reads_it.__signature__ = inspect.Signature(parameters)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    if len(parameters) > _MANY:
        as_typer_reads_it.everyday = {
            parameter.name for parameter in parameters if getattr(_declared(parameter), "everyday", True)
        }
    return run


@dataclass(frozen=True)
class _Group:
    """A dataclass whose fields are options, or groups of them; other fields keep their defaults."""

    kind: Any
    options: dict[str, "tuple[dataclasses.Field[Any], Any] | _Group"]

    def parameters(self) -> Iterator[inspect.Parameter]:
        """Yield the options as typer reads them."""
        helps = defaultdict(str, attributes_of(self.kind))
        for name, part in self.options.items():
            if isinstance(part, _Group):
                yield from part.parameters()
            else:
                yield _parameter(name, *part, helps[name])

    def made(self, values: dict[str, Any], settings: Settings) -> Any:
        """Make the dataclass from values of the command line, which are removed from `values`."""
        arguments = {"settings": settings} if "settings" in self.kind.__dataclass_fields__ else {}
        for name, part in self.options.items():
            if isinstance(part, _Group):
                arguments[name] = part.made(values, settings)
                continue
            value, about = values.pop(name), part[0].metadata["option"]
            if about.parse is None and about.typed is None:
                arguments[name] = value
            elif value is not None:
                arguments[name] = about.parse(value) if about.parse else value
        return self.kind(**arguments)


@cache  # commands share groups, and --help must be fast
def _group_of(hint: Any) -> _Group | None:
    """Return the group that a parameter's annotation names; None if it names none."""
    kind, *notes = (hint.__origin__, *hint.__metadata__) if hasattr(hint, "__metadata__") else (hint,)
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        return None
    types = get_type_hints(kind, include_extras=True)
    parts: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        if "option" in field.metadata:
            parts[field.name] = field, types[field.name]
        elif field.name != "settings" and (group := _group_of(types[field.name])):
            parts[field.name] = group
    for note in notes:
        if isinstance(note, Only):
            assert note.names <= parts.keys(), f"{kind.__name__} has no {note.names - parts.keys()}"
            is_left_out = isinstance(note, Without)
            parts = {name: part for name, part in parts.items() if (name in note.names) != is_left_out}
    return _Group(kind, parts) if parts else None


def _parameter(name: str, field: "dataclasses.Field[Any]", kind: Any, help: str) -> inspect.Parameter:
    """Return a field of a group as typer reads it."""
    about: Option = field.metadata["option"]
    assert about.help or help, f"{name} has no help"
    is_required = about.required or field.default is dataclasses.MISSING
    declared = typer.Option(
        *(about.flags or (flag(name),)),
        metavar=about.metavar,
        help=about.help or help,
        show_default=about.shown_default,
        rich_help_panel=about.panel,
        min=about.least,
        max=about.most,
    )
    declared.everyday = about.everyday or is_required
    default = field.default
    if about.parse is not None or about.typed is not None:
        kind, default = about.typed or str | None, about.default_text
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if is_required else default,
        annotation=Annotated[kind, declared],
    )


def _declared(parameter: inspect.Parameter) -> Any:
    """Return typer's declaration of a parameter; None for the context."""
    return next(iter(getattr(parameter.annotation, "__metadata__", ())), None)


def _panel(parameter: inspect.Parameter) -> str | None:
    """Return the panel of an option in the help; options of a command itself have none and come first."""
    panel = getattr(_declared(parameter), "rich_help_panel", None)
    return panel if panel in PANELS else None
