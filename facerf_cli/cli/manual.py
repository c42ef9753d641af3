"""Man pages from the app: `python -m facerf_cli.cli.manual DIR` writes facerf.1 and a page per command."""

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import typer.main

from facerf_cli._version import __version__
from facerf_cli.cli.help import examples_of
from facerf_cli.cli.options import EPILOG
from facerf_cli.errors import UsageError
from facerf_cli.main import app

_EXIT_CODES = (
    ("", "0", "Everything is done."),
    ("", "1", "Some inputs failed; standard error has a line for each."),
    ("", "2", "The command line is invalid, or no input exists."),
    ("", "130", "Interrupted."),
)


def pages() -> dict[str, str]:
    """Return the troff source of each page, by file name."""
    root = typer.main.get_command(app)
    context = typer.Context(root, info_name="facerf")
    walk = _walk(context, root, ("facerf",))
    return {f"{'-'.join(path)}.1": "\n".join(_lines(path, command)) + "\n" for path, command in walk}


def _walk(context: Any, command: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield path, command
    for name in sorted(getattr(command, "commands", {})):
        yield from _walk(context, command.commands[name], (*path, name))


def _lines(path: tuple[str, ...], command: Any) -> Iterator[str]:
    """Yield the lines of a page."""
    name, typed, commands = "-".join(path), " ".join(path), getattr(command, "commands", {})
    context = typer.Context(command, info_name=typed)
    summary, *paragraphs = (command.help or "").replace("\\[", "[").replace("\b", "").strip().split("\n\n")
    yield f'.TH "{name.upper()}" "1" "" "facerf {__version__}" "facerf manual"'
    yield from (".SH NAME", f"{_text(name)} \\- {_text(summary.rstrip('.'))}")
    yield from (".SH SYNOPSIS", f".B {_text(typed)}", _text(" ".join(command.collect_usage_pieces(context))))
    yield from (".SH DESCRIPTION", _text(summary))
    for paragraph in paragraphs:
        yield from (".PP", _text(" ".join(paragraph.split())))
    options = ((option, option.get_help_record(context)) for option in command.get_params(context))
    yield from _section("OPTIONS", ((_panel_of(option), *record) for option, record in options if record))
    entries = ((_panel_of(entry), name, entry.get_short_help_str(200)) for name, entry in commands.items())
    yield from _section("COMMANDS", entries)
    if not commands:
        yield from (".PP", _text(EPILOG), ".SH EXAMPLES", ".nf")
        yield from map(_text, examples_of(" ".join(path[1:])))
        yield ".fi"
    yield from _section("EXIT STATUS", _EXIT_CODES)
    related = [f"{name}-{subcommand}" for subcommand in sorted(commands)] or ["-".join(path[:-1])]
    yield from (".SH SEE ALSO", ", ".join(f"\\fB{_text(page)}\\fR(1)" for page in related))


def _panel_of(part: Any) -> str:
    """Return the panel of an option or a command in the help; empty for the first panel."""
    return getattr(part, "rich_help_panel", None) or ""


def _section(title: str, entries: Iterable[tuple[str, str, str]]) -> Iterator[str]:
    """Yield a section of panels, terms and meanings, with a subsection per panel; empty without entries."""
    by_panel: dict[str, list[tuple[str, str]]] = {"": []}
    for panel, term, meaning in entries:
        by_panel.setdefault(panel, []).append((term, meaning))
    yield from [f".SH {title}"] if any(by_panel.values()) else []
    for panel, terms in by_panel.items():
        yield from [f".SS {_text(panel)}"] if panel else []
        for term, meaning in terms:
            yield from (".TP", f"\\fB{_text(term)}\\fR", _text(" ".join(meaning.split())))


def _text(text: str) -> str:
    """Escape what troff would interpret: backslashes, hyphens, and dots that begin a line."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{text}" if text.startswith((".", "'")) else text


def main(arguments: list[str]) -> None:
    """Write all pages into a folder, and remove pages of removed commands."""
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
