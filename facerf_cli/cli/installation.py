"""The installation (`doctor`), and defaults of options from a file (`--config`)."""

import logging
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from facerf_cli.cli.options import settings_of
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.texts import read_toml
from facerf_cli.run.logs import LOGGER_NAME, json_line
from facerf_cli.training.settings import KINDS
from facerf_cli.work.installed import MISSING, Facts, installation

GLOBAL = "global"  # the table of options before the verb
_NO_BREAK = "\N{NO-BREAK SPACE}"
_WIDTH, _HEAD = 100, 13  # columns of the screen, and of a section's or part's name
log = logging.getLogger(LOGGER_NAME)


def doctor(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Show what is installed, with licences, what is missing, and the command that adds it.

    The exit code is 1 if a part that facerf needs is missing. The extras are optional.
    """
    facts = installation()
    if MISSING not in facts["packages"].values():  # the rest needs all packages
        from facerf_cli.work.doctor_facts import examine

        facts |= examine(settings_of(context))
    print(json_line(facts) if as_json else as_screen(facts))
    raise typer.Exit(1 if MISSING in json_line(facts) else 0)


def as_screen(facts: Facts) -> str:
    """The facts as aligned text; sizes and nested provenance are left to --json."""
    lines: list[str] = []
    for section, part, text in _rows(facts):
        head = f"{section:<{_HEAD}}{part + ' ':<{_HEAD}}" if part else f"{section:<{_HEAD}}"
        lines += textwrap.wrap(
            text, _WIDTH, initial_indent=head, subsequent_indent=" " * len(head), break_on_hyphens=False
        )
    return "\n".join(lines).replace(_NO_BREAK, " ")


def _rows(facts: Facts) -> Iterator[tuple[str, str, str]]:
    """Yield section, part and text of each row; a section's name stands in its first row only."""
    facerf = facts["facerf"]
    yield "facerf", "", f"{facerf['version']}, Python {facerf['python']}, {facerf['system']}"
    yield "packages", "", "  ".join(_whole(f"{name} {found}") for name, found in facts["packages"].items())
    for command in facts["add"]:
        yield "", "", f"to add what is missing: {_whole(command)}"
    for row, (name, extra) in enumerate(facts["extras"].items()):
        if extra["add"]:
            text = f"not installed; {_whole(extra['add'])} adds {extra['for']}"
        else:
            found = ", ".join(f"{package} {version}" for package, version in extra["packages"].items())
            text = f"{found}, for {extra['for']}"
        yield "extras" if row == 0 else "", name, text
    if "device" not in facts:
        return
    device = facts["device"]
    yield "device", "", f"{device['uses']}, {device['threads']} threads, {device['memory']} of memory"
    models: dict[str, list[str]] = {}
    for name, asset in facts["assets"].items():
        models.setdefault(_model(name, asset), []).append(name)
    for row, (text, names) in enumerate(models.items()):
        yield "models" if row == 0 else "", ", ".join(names), text
    yield "networks", "", "  ".join(_served(facts["networks"]))
    yield "colour", "", f"OCIO configuration {facts['colour']['OCIO']}, {facts['colour']['spaces']} spaces"
    yield "cache", "", facts["cache"]["folder"]


def _served(networks: Facts) -> Iterator[str]:
    """The file that serves each network, with the first digits of its SHA-256."""
    for name, file in networks.items():
        if name == MISSING:
            yield f"{MISSING}: {file['file']}"
        else:
            stem, digits = Path(file["file"]).stem, file["sha256"][:8]
            yield _whole(f"{name} {digits}" if stem == name else f"{name} {stem} {digits}")


def _whole(text: str) -> str:
    """Text that stays on one line, such as a command to copy."""
    return text.replace(" ", _NO_BREAK)


def _model(label: str, asset: Facts) -> str:
    """An asset's name, licences and the heads it was trained on; what they share is said once."""
    said = [str(asset[key]) for key in ("licence", "recognition", "heads") if asset.get(key)]
    name = asset.get("name", label)
    text = "; ".join(dict.fromkeys("; ".join(said).split("; ")))
    return ": ".join(filter(None, (name if name != label else "", text)))


def read_config(path: Path, group: Any) -> dict[str, Any]:
    """Read defaults by verb: `[relight]`, `[evaluate.yale-b]`, `[global]`; names as they are typed.

    Raises UsageError for a file that is no TOML, and for verbs and options that do not exist.
    """
    try:
        tables = read_toml(path, "mend it")
    except InputError as error:
        raise UsageError(f"--config {error}") from None
    of_all = tables.pop(GLOBAL, {})
    return _checked(path, GLOBAL, of_all, group) | _by_verb(path, "", tables, group)


def _by_verb(path: Path, above: str, tables: Mapping[str, Any], group: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, table in tables.items():
        command = group.commands.get(name)
        if command is None:
            known = ", ".join(sorted([*group.commands, *(() if above else (GLOBAL,))]))
            raise UsageError(f"--config {path}: [{above}{name}] is no verb; give one of {known}")
        if hasattr(command, "commands") and isinstance(table, Mapping):
            found[name] = _by_verb(path, f"{above}{name}.", table, command)
        else:
            found[name] = _checked(path, f"{above}{name}", table, command)
    return found


def _checked(path: Path, verb: str, table: Any, command: Any) -> dict[str, Any]:
    """The options of a table by the names of their parameters."""
    if not isinstance(table, Mapping):
        raise UsageError(f"--config {path}: {verb} is no table; write [{verb}]")
    names = {
        option.lstrip("-").replace("-", "_"): parameter.name
        for parameter in _options(command)
        for option in parameter.opts
        if parameter.name not in ("version", "config")
    }
    values = {}
    for key, value in table.items():
        name = key.replace("-", "_")
        if verb == "train" and name in KINDS:  # which `training/settings.py` reads
            values[name] = value
            continue
        if name not in names:
            of_verb = "" if verb == GLOBAL else f"{verb} ".replace(".", " ")
            raise UsageError(
                f"--config {path}: [{verb}] {key}: no such option; see `facerf {of_verb}--help-all`"
            )
        values[names[name]] = value
    return values


def _options(command: Any) -> Iterator[Any]:
    return (parameter for parameter in command.params if parameter.param_type_name == "option")
