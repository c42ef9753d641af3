"""Options of the command line as fields of frozen dataclasses, in the files of the functions that take them.

A field made by `option` holds its limits; the docstring's section `Attributes` has its help. `cli/options.py`
turns the fields of the groups that a verb names into the verb's options. Nothing here knows the library of
the command line.
"""

import dataclasses
import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

# Panels of a verb's options in its help, in this order, after others. What must be given, --output and --help
# have none: they stand first, under Options.
LIGHT, IMAGE, FACE, METHOD, BATCH = "Light", "Image", "Face", "Method", "Batch"
RUN, DATA, LENGTH, LOSSES, SPEED = "The run", "Data", "Length", "Losses and ablations", "Speed"
METHODS, MEASURES = "Methods", "Measures"
PANELS = (RUN, DATA, METHODS, MEASURES, LENGTH, LOSSES, SPEED, LIGHT, IMAGE, FACE, METHOD, BATCH)


@dataclass(frozen=True)
class Option:
    """The command line's side of a field; the field's annotation says what values it takes."""

    help: str
    metavar: str | None = None
    flags: tuple[str, ...] = ()  # --field-name where there are none
    panel: str | None = None  # of the help
    everyday: bool = False  # in --help, as is what the verb's examples use; others are in --help-all
    shown_default: bool | str = True  # shown in the help: the default, a text in its place, or nothing
    least: float | None = None
    most: float | None = None
    parse: Callable[[Any], Any] | None = None  # makes the field's value of what is typed
    typed: Any = None  # the type of what is typed, if not the field's; str | None with `parse`
    default_text: Any = None  # with `parse`: what is typed by default
    required: bool = False  # on the command line, though the dataclass has a default


@dataclass(frozen=True)
class Only:
    """The options of a group that a verb has: `Annotated[Group, Only("face")]`; others keep defaults."""

    names: frozenset[str]

    def __init__(self, *names: str) -> None:
        object.__setattr__(self, "names", frozenset(names))


class Without(Only):
    """The options of a group that a verb has not."""


def option(
    default: Any, help: str = "", metavar: str | None = None, in_recipe: bool = True, **more: Any
) -> Any:
    """Make a dataclass field that is an option.

    Args:
        default: The value without the option; `...` where the option must be given.
        help: A sentence: verb, object, unit; by default that of `Attributes` in the dataclass's docstring.
        metavar: The placeholder of the value in the help.
        in_recipe: False for a field that shapes no output.
        more: Further fields of `Option`.
    """
    metadata = {"option": Option(help, metavar, **more), "in_recipe": in_recipe}
    if default is ...:
        return dataclasses.field(metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def attributes_of(kind: type) -> dict[str, str]:
    """The sections `Attributes` in the docstrings of a class and its bases: a line of words by name."""
    found = {}
    for one in reversed(kind.__mro__):
        section = inspect.cleandoc(one.__doc__ or "").partition("\nAttributes:\n")[2]
        for name, text in re.findall(r"^    (\w+): (.+(?:\n {8}.+)*)", section, re.MULTILINE):
            found[name] = " ".join(text.split())
    return found


def flag(name: str) -> str:
    """An option as it is typed on the command line: the name of its field, without its unit."""
    return f"--{name.removesuffix('_px').replace('_', '-')}"
