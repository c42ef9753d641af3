"""The options that verbs share, and the groups of options (`option.py`) as options of a verb."""

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
    "before or after the verb."
)
_MANY = 14  # parameters of a verb whose --help leaves some out


def settings_of(context: typer.Context) -> Settings:
    """The global options of this call."""
    settings = context.obj
    assert isinstance(settings, Settings)
    return settings


def was_given(context: typer.Context, name: str) -> bool:
    """True if the command line names an option, even with its default value."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def is_default(context: typer.Context, name: str) -> bool:
    """True if neither the command line nor a configuration file sets an option."""
    source = context.get_parameter_source(name)
    return source is None or source.name == "DEFAULT"


def refuse_given(context: typer.Context, names: Sequence[str], why: str) -> None:
    """Raise UsageError for an option that is given but would do nothing; `why` completes the message."""
    typed = {parameter.name: parameter.opts[0] for parameter in context.command.params}
    for name in names:
        if was_given(context, name):
            raise UsageError(f"{typed[name]} {why}")


InputsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="PHOTO...",
        help="Images, folders (walked recursively), frames (plate.1001-1050.exr, plate.%04d.exr), or - for "
        "an image or a list on standard input.",
        show_default=False,
    ),
]
FramesArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="PHOTO|FILM...",
        help="Images, films (.mp4, .mov, .mkv and more), folders of images (walked recursively), frames "
        "(plate.%04d.exr), or - for an image or a list.",
        show_default=False,
    ),
]


def unwrapped(docstring: str) -> str:
    """A docstring with a line for each paragraph, which the help breaks at the terminal's width.

    Brackets are escaped: rich would take [relight] for a style.
    """
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in escape(docstring).split("\n\n"))


def with_groups(verb: Callable[..., Any]) -> Callable[..., Any]:
    """Replace each parameter of a verb that is a group of options (`option.py`) by the options themselves.

    A group's field that is a group in turn gives its options, too. A field `settings` is filled with the
    global options of the call.
    """
    hints = get_type_hints(verb, include_extras=True)
    groups = {name: group for name, hint in hints.items() if (group := _group_of(hint)) is not None}
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(verb).parameters.values():
        if parameter.name in groups:
            parameters += groups[parameter.name].parameters()
        else:
            parameters.append(parameter.replace(annotation=hints[parameter.name]))
    if not groups:
        return verb
    keyword = inspect.Parameter.KEYWORD_ONLY  # a required one may follow one with a default
    parameters = sorted((parameter.replace(kind=keyword) for parameter in parameters), key=_place)
    takes_context = "context" in hints
    if not takes_context:
        parameters.insert(0, inspect.Parameter("context", keyword, annotation=typer.Context))

    def run(**values: Any) -> Any:
        settings = settings_of(values["context"])
        if not takes_context:
            del values["context"]
        taken = {name: group.taken(values, settings) for name, group in groups.items()}
        return verb(**taken, **values)

    as_typer_reads_it: Any = run
    as_typer_reads_it.__signature__ = inspect.Signature(parameters)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__name__, run.__doc__ = verb.__name__, verb.__doc__
    if len(parameters) > _MANY:
        as_typer_reads_it.everyday = {one.name for one in parameters if getattr(_note(one), "everyday", True)}
    return run


@dataclass(frozen=True)
class _Group:
    """A dataclass whose fields are options, or groups of them; other fields keep their defaults."""

    kind: Any
    options: dict[str, "tuple[dataclasses.Field[Any], Any] | _Group"]

    def parameters(self) -> Iterator[inspect.Parameter]:
        """The options as typer reads them."""
        helps = defaultdict(str, attributes_of(self.kind))
        for name, part in self.options.items():
            if isinstance(part, _Group):
                yield from part.parameters()
            else:
                yield _parameter(name, *part, helps[name])

    def taken(self, values: dict[str, Any], settings: Settings) -> Any:
        """The dataclass, whose values are taken out of those of the command line."""
        given = {"settings": settings} if "settings" in self.kind.__dataclass_fields__ else {}
        for name, part in self.options.items():
            if isinstance(part, _Group):
                given[name] = part.taken(values, settings)
                continue
            value, about = values.pop(name), part[0].metadata["option"]
            if about.parse is None and about.typed is None:
                given[name] = value
            elif value is not None:
                given[name] = about.parse(value) if about.parse else value
        return self.kind(**given)


@cache  # verbs share groups, and --help is to be quick
def _group_of(hint: Any) -> _Group | None:
    """The group that a parameter's annotation names; None where it is no group."""
    kind, *notes = (hint.__origin__, *hint.__metadata__) if hasattr(hint, "__metadata__") else (hint,)
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        return None
    types = get_type_hints(kind, include_extras=True)
    parts: dict[str, Any] = {
        field.name: (field, types[field.name]) if "option" in field.metadata else _group_of(types[field.name])
        for field in dataclasses.fields(kind)
    }
    for note in notes:
        if isinstance(note, Only):
            assert note.names <= parts.keys(), f"{kind.__name__} has no {note.names - parts.keys()}"
            left_out = isinstance(note, Without)
            parts = {name: part for name, part in parts.items() if (name in note.names) != left_out}
    parts = {name: part for name, part in parts.items() if part is not None}
    return _Group(kind, parts) if parts else None


def _parameter(name: str, field: "dataclasses.Field[Any]", kind: Any, help: str) -> inspect.Parameter:
    """A field of a group as typer reads it."""
    about: Option = field.metadata["option"]
    assert about.help or help, f"{name} has no help"
    declared = typer.Option(
        *(about.flags or (flag(name),)),
        metavar=about.metavar,
        help=about.help or help,
        show_default=about.shown_default,
        rich_help_panel=about.panel,
        min=about.least,
        max=about.most,
    )
    declared.everyday = about.everyday or about.required or field.default is dataclasses.MISSING
    default = field.default
    if about.parse is not None or about.typed is not None:
        kind, default = about.typed or str | None, about.default_text
    if about.required or field.default is dataclasses.MISSING:
        default = inspect.Parameter.empty
    keyword = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, keyword, default=default, annotation=Annotated[kind, declared])


def _note(parameter: inspect.Parameter) -> Any:
    """The declaration of a parameter that typer reads; None of the context."""
    return next(iter(getattr(parameter.annotation, "__metadata__", ())), None)


def _place(parameter: inspect.Parameter) -> int:
    """The place of a parameter's panel; those that a verb has for itself come first."""
    panel = getattr(_note(parameter), "rich_help_panel", None)
    return PANELS.index(panel) if panel in PANELS else -1
