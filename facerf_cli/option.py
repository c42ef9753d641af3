"""Options of the command line as fields of frozen dataclasses, in the files of the functions that take them.

A field made by `option` has its limits; the docstring's section `Attributes` has its help. `cli/options.py`
turns the fields of a command's groups into options. This module does not depend on typer.
"""

import dataclasses
import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

# Panels of options in the help, in this order. Required options, --output and --help have none: they come
# first, under Options.
LIGHT, IMAGE, FACE, METHOD, BATCH = "Light", "Image", "Face", "Method", "Batch"
RUN, DATA, LENGTH, LOSSES, SPEED = "The run", "Data", "Length", "Losses and ablations", "Speed"
METHODS, MEASURES = "Methods", "Measures"
PANELS = (RUN, DATA, METHODS, MEASURES, LENGTH, LOSSES, SPEED, LIGHT, IMAGE, FACE, METHOD, BATCH)


@dataclass(frozen=True)
class Option:
    """An option of the command line; the annotation of its field defines the possible values."""

    help: str
    metavar: str | None = None
    flags: tuple[str, ...] = ()  # by default --field-name
    panel: str | None = None  # of the help
    everyday: bool = False  # also in --help, like the options of the examples; --help-all has all
    shown_default: bool | str = True  # the help shows the default, this text instead, or nothing
    least: float | None = None
    most: float | None = None
    parse: Callable[[Any], Any] | None = None  # converts the typed value to the field's value
    typed: Any = None  # type of the typed value, if not the field's; str | None with `parse`
    default_text: Any = None  # with `parse`: the typed value by default
    required: bool = False  # on the command line, although the dataclass has a default


@dataclass(frozen=True)
class Only:
    """Options of a group that a command has: `Annotated[Group, Only("face")]`; others keep defaults."""

    names: frozenset[str]

    def __init__(self, *names: str) -> None:
        object.__setattr__(self, "names", frozenset(names))


class Without(Only):
    """Options of a group that a command does not have."""


def option(
    default: Any, help: str = "", metavar: str | None = None, in_recipe: bool = True, **more: Any
) -> Any:
    """Make a dataclass field that is an option.

    Args:
        default: Value without the option; `...` if the option is required.
        help: Help text; by default the one of `Attributes` in the dataclass's docstring.
        metavar: Placeholder of the value in the help.
        in_recipe: False for a field that shapes no output.
        more: Other fields of `Option`.
    """
    metadata = {"option": Option(help, metavar, **more), "in_recipe": in_recipe}
    if default is ...:
        return dataclasses.field(metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def attributes_of(kind: type) -> dict[str, str]:
    """Return the text of each name in the sections `Attributes` of a class and its bases."""
    texts = {}
    for base in reversed(kind.__mro__):
        section = inspect.cleandoc(base.__doc__ or "").partition("\nAttributes:\n")[2]
        for name, text in re.findall(r"^    (\w+): (.+(?:\n {8}.+)*)", section, re.MULTILINE):
            texts[name] = " ".join(text.split())
    return texts


def flag(name: str) -> str:
    """Return the option of a field as it is typed on the command line, without the unit of the name."""
    return f"--{name.removesuffix('_px').replace('_', '-')}"
