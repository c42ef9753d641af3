"""`facerf doctor`: the installation and its licences, on one screen."""

import platform
import re
import textwrap
from typing import Annotated, Any

import typer

from facerf_cli import __version__
from facerf_cli.cli.options import settings_of
from facerf_cli.logs import json_line

MISSING = "MISSING"
_WIDTH = 100


def doctor(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Show packages, device, assets with their licences, and the colour configuration.

    The exit code is 1 if a part that facerf needs is missing.
    """
    facts = _installation()
    if MISSING not in facts["packages"].values():  # the rest needs all packages
        from facerf_cli.cli.items.doctor_facts import examine

        facts |= examine(settings_of(context))
    print(json_line(facts) if as_json else as_screen(facts))
    raise typer.Exit(1 if MISSING in json_line(facts) else 0)


def _installation() -> dict[str, dict[str, Any]]:
    """The sections that need no package."""
    return {
        "facerf": {
            "version": __version__,
            "python": platform.python_version(),
            "system": platform.platform(),
        },
        "packages": _packages(),
    }


def _packages() -> dict[str, str]:
    """Versions of the required packages and of the installed extras, without the developers' tools."""
    from importlib import metadata  # slow to load, and --help does without it

    try:
        requirements = metadata.requires("facerf") or []
    except metadata.PackageNotFoundError:
        return {"facerf": f"{MISSING} (run from its source; install it with pip)"}
    versions = {}
    for requirement in requirements:
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        if re.search(r"extra == .dev", requirement):
            continue
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            if "extra ==" not in requirement:
                versions[name] = MISSING
    return versions


def as_screen(facts: dict[str, dict[str, Any]]) -> str:
    """The facts as aligned text; a checkpoint's nested provenance is left to --json."""
    lines = []
    for section, entries in facts.items():
        if section == "packages":
            text = "  ".join(f"{name} {version}" for name, version in entries.items())
            lines += textwrap.wrap(text, _WIDTH, initial_indent=f"{section:<12}", subsequent_indent=" " * 12)
            continue
        for row, (name, value) in enumerate(entries.items()):
            values = value.values() if isinstance(value, dict) else [value]
            shown = (part for part in values if part not in ("", None) and not isinstance(part, dict))
            head = f"{section if row == 0 else '':<12}{name:<12}"
            text = ", ".join(str(part) for part in shown)
            lines += textwrap.wrap(text, _WIDTH, initial_indent=head, subsequent_indent=" " * 24)
    return "\n".join(lines)
