"""Man pages from the app: `python -m facerf_cli.cli.manual DIR` writes facerf.1 and a page for each verb."""

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import typer.main

from facerf_cli._version import __version__
from facerf_cli.cli.examples import examples_of
from facerf_cli.cli.options import EPILOG
from facerf_cli.errors import UsageError
from facerf_cli.main import app

_EXIT_CODES = (
    ("0", "All is done."),
    ("1", "Some input failed; each is named in a line on standard error."),
    ("2", "The command line is wrong, or there is nothing to work on."),
    ("130", "Interrupted."),
)


def pages() -> dict[str, str]:
    """File name to troff source, for facerf and every verb."""
    root = typer.main.get_command(app)
    context = typer.Context(root, info_name="facerf")
    return {
        f"{'-'.join(path)}.1": _page(path, command) for path, command in _walk(context, root, ("facerf",))
    }


def _walk(context: Any, command: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield path, command
    for name in sorted(getattr(command, "commands", {})):
        yield from _walk(context, command.commands[name], (*path, name))


def _page(path: tuple[str, ...], command: Any) -> str:
    context = typer.Context(command, info_name=" ".join(path))
    summary, _, rest = (command.help or "").replace("\\[", "[").strip().partition("\n")
    lines = [f'.TH "{"-".join(path).upper()}" "1" "" "facerf {__version__}" "facerf manual"']
    lines += [".SH NAME", f"{_text('-'.join(path))} \\- {_text(summary.rstrip('.'))}"]
    lines += [
        ".SH SYNOPSIS",
        f".B {_text(' '.join(path))}",
        _text(" ".join(command.collect_usage_pieces(context))),
    ]
    lines += [".SH DESCRIPTION", _text(summary)]
    for paragraph in filter(None, rest.replace("\b", "").split("\n\n")):
        lines += [".PP", _text(" ".join(paragraph.split()))]
    options = [
        (_panel_of(parameter), record)
        for parameter in command.get_params(context)
        if (record := parameter.get_help_record(context))
    ]
    lines += _section("OPTIONS", options)
    verbs = getattr(command, "commands", {})
    listed = [(_panel_of(verb), (name, verb.get_short_help_str(200))) for name, verb in verbs.items()]
    lines += _section("VERBS", listed)
    if not verbs:
        lines += [
            ".PP",
            _text(EPILOG),
            ".SH EXAMPLES",
            ".nf",
            *map(_text, examples_of(" ".join(path[1:]))),
            ".fi",
        ]
    lines += [".SH EXIT STATUS", *_definitions(_EXIT_CODES)]
    pages_nearby = ["-".join((*path, name)) for name in sorted(verbs)] or ["-".join(path[:-1])]
    lines += [".SH SEE ALSO", ", ".join(f"\\fB{_text(name)}\\fR(1)" for name in pages_nearby)]
    return "\n".join(lines) + "\n"


def _panel_of(part: Any) -> str:
    """The panel of an option or a verb in the help; empty for the first one."""
    return getattr(part, "rich_help_panel", None) or ""


def _section(title: str, entries: Iterable[tuple[str, tuple[str, str]]]) -> list[str]:
    """A section of terms and meanings, with a subsection for each panel of the help, in its order."""
    panels: dict[str, list[tuple[str, str]]] = {"": []}
    for panel, entry in entries:
        panels.setdefault(panel, []).append(entry)
    lines = []
    for panel, held in panels.items():
        if held:
            lines += [*([f".SS {_text(panel)}"] if panel else []), *_definitions(held)]
    return [f".SH {title}", *lines] if lines else []


def _definitions(entries: Iterable[tuple[str, str]]) -> list[str]:
    lines = []
    for term, meaning in entries:
        lines += [".TP", f"\\fB{_text(term)}\\fR", _text(" ".join(meaning.split()))]
    return lines


def _text(text: str) -> str:
    """Text as troff prints it literally: backslashes, hyphens that are typed, and dots that begin a line."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{text}" if text.startswith((".", "'")) else text


def main(arguments: list[str]) -> None:
    """Write all pages into the folder named, and remove pages of verbs that are gone."""
    if len(arguments) != 1:
        raise UsageError("usage: python -m facerf_cli.cli.manual DIR")
    folder, written = Path(arguments[0]), pages()
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("facerf*.1"):
        if old.name not in written:
            old.unlink()
    for name, source in written.items():
        (folder / name).write_text(source, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
