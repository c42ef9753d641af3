"""`facerf doctor`: what is installed, what is missing, and the command that adds it."""

from typing import Annotated

import typer

from facerf_cli.cli.options import settings_of
from facerf_cli.run.logs import json_line


def doctor(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Show what is installed, with licences, what is missing, and the command that adds it.

    The exit code is 1 if a part that facerf needs is missing. The extras are optional.
    """
    from facerf_cli.work.doctor import MISSING, examine

    facts = examine(settings_of(context))
    text = json_line(facts)
    if as_json:
        print(text)
    else:
        for section, entries in facts.items():
            print(section)
            for name, entry in entries.items():
                values = entry.values() if isinstance(entry, dict) else [entry]
                print(f"  {name}: {', '.join(map(str, values))}")
    raise typer.Exit(1 if MISSING in text else 0)
