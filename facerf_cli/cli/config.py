"""Defaults of options from a TOML file, and `facerf config`, which shows what is in force and from where."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.texts import read_toml

GLOBAL = "global"  # the table of options before the verb
_LIMIT_BYTES = 1 << 20


def read_config(path: Path, group: Any) -> dict[str, Any]:
    """Read defaults by verb: `[relight]`, `[evaluate.yale-b]`, `[global]`; names as they are typed.

    Raises UsageError for a file that is no TOML, and for verbs and options that do not exist.
    """
    too_long = f"larger than {_LIMIT_BYTES >> 20} MiB; give a TOML file"
    try:
        tables = read_toml(path, _LIMIT_BYTES, too_long, "mend it")
    except InputError as error:
        raise UsageError(f"--config {error}") from None
    own = tables.pop(GLOBAL, {})
    return _checked(path, GLOBAL, own, group) | _by_verb(path, "", tables, group)


def _by_verb(path: Path, above: str, tables: Mapping[str, Any], group: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, table in tables.items():
        command = group.commands.get(name)
        if command is None:
            known = ", ".join(sorted([*group.commands, *(() if above else (GLOBAL,))]))
            raise UsageError(f"--config {path}: [{above}{name}] is no verb; give one of {known}")
        if not isinstance(table, Mapping):
            raise UsageError(f"--config {path}: {above}{name} is no table; write [{above}{name}]")
        is_group = hasattr(command, "commands")
        found[name] = (
            _by_verb(path, f"{name}.", table, command)
            if is_group
            else _checked(path, f"{above}{name}", table, command)
        )
    return found


def _checked(path: Path, verb: str, table: Any, command: Any) -> dict[str, Any]:
    """The options of a table by the names of their parameters."""
    if not isinstance(table, Mapping):
        raise UsageError(f"--config {path}: {verb} is no table; write [{verb}]")
    names = {
        option.lstrip("-").replace("-", "_"): parameter.name
        for parameter in _options(command)
        for option in parameter.opts
        if parameter.name not in ("help", "version", "config")
    }
    values = {}
    for key, value in table.items():
        name = key.replace("-", "_")
        if name not in names:
            of_verb = "" if verb == GLOBAL else f"{verb} ".replace(".", " ")
            raise UsageError(f"--config {path}: [{verb}] {key}: no such option; see `facerf {of_verb}--help`")
        values[names[name]] = value
    return values


def _options(command: Any) -> Iterator[Any]:
    return (parameter for parameter in command.params if parameter.param_type_name == "option")


def config(
    context: typer.Context,
    verb: Annotated[
        str | None,
        typer.Argument(metavar="[VERB]", help="Show all options of this verb.", show_default=False),
    ] = None,
) -> None:
    """Show the defaults in force, and where each comes from: a configuration file, or facerf itself.

    Without VERB: those that the file of --config (or FACERF_CONFIG) sets. With VERB the others follow, each
    after a #. The file is TOML with a table for
    each verb ([relight], [evaluate.yale-b]) and one for global options ([global]); options have the names of
    the command line, without dashes in front. What the command line gives comes first.
    """
    root = context.find_root()
    given, source = root.default_map or {}, root.params.get("config")
    if verb is None:
        if source is None:
            print("no configuration file; give one with --config FILE or FACERF_CONFIG")
        _print_given(given, str(source), "")
        return
    command: Any = root.command
    for name in verb.split("."):
        command, given = getattr(command, "commands", {}).get(name), given.get(name, {})
        if command is None:
            raise UsageError(f"config {verb}: no such verb; see `facerf --help`")
    defaults = []
    for parameter in _options(command):
        if parameter.name in given:
            print(f"{parameter.opts[0]} = {_shown(given[parameter.name])}  ({source})")
        elif parameter.name != "help" and not parameter.required:
            defaults.append(f"# {parameter.opts[0]} = {_shown(parameter.get_default(context))}")
    print("\n".join(["# not set, and so by default:", *defaults]))


def _print_given(tables: Mapping[str, Any], source: str, above: str) -> None:
    for name, value in tables.items():
        if isinstance(value, Mapping):
            _print_given(value, source, f"{above}{name} ")
        else:
            print(f"{above}--{name.strip('_').replace('_', '-')} = {_shown(value)}  ({source})")


def _shown(value: Any) -> str:
    return "not set" if value is None or value == () else str(value)
