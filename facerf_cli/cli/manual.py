"""Man pages from the app: `python -m facerf_cli.cli.manual DIR` writes facerf.1 and a page for each verb."""

import sys
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import typer.main

from facerf_cli._version import __version__
from facerf_cli.cli.examples import examples_of
from facerf_cli.cli.options import EPILOG
from facerf_cli.errors import UsageError
from facerf_cli.main import app

_EXIT_CODES = (
    ("", "0", "All is done."),
    ("", "1", "Some input failed; each is named in a line on standard error."),
    ("", "2", "The command line is wrong, or there is nothing to work on."),
    ("", "130", "Interrupted."),
)


def pages() -> dict[str, str]:
    """File name to troff source, for facerf and every verb."""
    root = typer.main.get_command(app)
    context = typer.Context(root, info_name="facerf")
    walk = _walk(context, root, ("facerf",))
    return {f"{'-'.join(path)}.1": "\n".join(_lines(path, command)) + "\n" for path, command in walk}


def _walk(context: Any, command: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield path, command
    for name in sorted(getattr(command, "commands", {})):
        yield from _walk(context, command.commands[name], (*path, name))


def _lines(path: tuple[str, ...], command: Any) -> Iterator[str]:
    """The lines of a page."""
    name, typed, verbs = "-".join(path), " ".join(path), getattr(command, "commands", {})
    context = typer.Context(command, info_name=typed)
    summary, *paragraphs = (command.help or "").replace("\\[", "[").replace("\b", "").strip().split("\n\n")
    yield f'.TH "{name.upper()}" "1" "" "facerf {__version__}" "facerf manual"'
    yield from (".SH NAME", f"{_text(name)} \\- {_text(summary.rstrip('.'))}")
    yield from (".SH SYNOPSIS", f".B {_text(typed)}", _text(" ".join(command.collect_usage_pieces(context))))
    yield from (".SH DESCRIPTION", _text(summary))
    for paragraph in paragraphs:
        yield from (".PP", _text(" ".join(paragraph.split())))
    options = ((one, one.get_help_record(context)) for one in command.get_params(context))
    yield from _section("OPTIONS", ((_panel_of(one), *record) for one, record in options if record))
    listed = ((_panel_of(verb), name, verb.get_short_help_str(200)) for name, verb in verbs.items())
    yield from _section("VERBS", listed)
    if not verbs:
        yield from (".PP", _text(EPILOG), ".SH EXAMPLES", ".nf")
        yield from map(_text, examples_of(" ".join(path[1:])))
        yield ".fi"
    yield from _section("EXIT STATUS", _EXIT_CODES)
    nearby = [f"{name}-{verb}" for verb in sorted(verbs)] or ["-".join(path[:-1])]
    yield from (".SH SEE ALSO", ", ".join(f"\\fB{_text(one)}\\fR(1)" for one in nearby))


def _panel_of(part: Any) -> str:
    """The panel of an option or a verb in the help; empty for the first one."""
    return getattr(part, "rich_help_panel", None) or ""


def _section(title: str, entries: Iterable[tuple[str, str, str]]) -> Iterator[str]:
    """A section of panels, terms and meanings, with a subsection for each panel; nothing without entries."""
    found = list(entries)
    panels = ["", *dict.fromkeys(panel for panel, _, _ in found)]
    found.sort(key=lambda entry: panels.index(entry[0]))
    for number, (panel, held) in enumerate(groupby(found, lambda entry: entry[0])):
        yield from [f".SH {title}"] if number == 0 else []
        yield from [f".SS {_text(panel)}"] if panel else []
        for _, term, meaning in held:
            yield from (".TP", f"\\fB{_text(term)}\\fR", _text(" ".join(meaning.split())))


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
