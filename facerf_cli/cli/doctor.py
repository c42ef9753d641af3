"""`facerf doctor`: the installation and its licences, on one screen."""

import platform
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from facerf_cli._version import __version__
from facerf_cli.cli.options import settings_of
from facerf_cli.run.logs import json_line

MISSING = "MISSING"
_NO_BREAK = "\N{NO-BREAK SPACE}"
# Extras of the package (pyproject.toml) for users, and the use of each.
EXTRAS = {
    "synth": "`--renderer mitsuba`",
    "face-models": "Basel's models in `face-model import`",
    "tensorboard": "the curves of `train`",
    "ray": "`--ray`, on clusters",
    "heic": "HEIC photos of phones",
    "video": "films in and out; its wheel holds GPL codecs",
    "dlib": "`--landmarks-from dlib`, not for commercial use",
}
_WIDTH, _HEAD = 100, 13  # columns of the screen, and of a section's or part's name
Facts = dict[str, Any]


def doctor(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Show what is installed, with licences, what is missing, and the command that adds it.

    The exit code is 1 if a part that facerf needs is missing. The extras are optional.
    """
    facts = _installation()
    if MISSING not in facts["packages"].values():  # the rest needs all packages
        from facerf_cli.work.doctor_facts import examine

        facts |= examine(settings_of(context))
    print(json_line(facts) if as_json else as_screen(facts))
    raise typer.Exit(1 if MISSING in json_line(facts) else 0)


def _installation() -> Facts:
    """The sections that need no package."""
    return {
        "facerf": {
            "version": __version__,
            "python": platform.python_version(),
            "system": f"{platform.system()} {platform.machine()}",
        },
        **_packages(),
    }


def _packages() -> Facts:
    """Versions of the packages that are needed, commands for those missing, and the extras."""
    from importlib import metadata  # slow to load, and --help does without it

    try:
        requirements = metadata.requires("facerf") or []
    except metadata.PackageNotFoundError:
        return {"packages": {"facerf": MISSING}, "add": ["pip install ."], "extras": {}}
    versions: dict[str, str] = {}
    extras: dict[str, Any] = {}
    add = []
    for requirement in requirements:
        wanted, _, marker = (part.strip() for part in requirement.partition(";"))
        package = re.split(r"[^\w.-]", wanted, maxsplit=1)[0]
        extra = re.search(r"extra == .([\w-]+)", marker)
        if extra and extra[1] not in EXTRAS:
            continue  # developers' tools
        try:
            version = metadata.version(package)
        except metadata.PackageNotFoundError:
            version = "not installed" if extra else MISSING
        if extra:
            name = extra[1]
            entry = extras.setdefault(name, {"for": EXTRAS[name], "packages": {}, "add": None})
            entry["packages"][package] = version
            if version == "not installed":
                entry["add"] = f"pip install 'facerf[{name}]'"
        else:
            versions[package] = version
            add += [f"pip install '{wanted}'"] if version == MISSING else []
    return {"packages": versions, "add": add, "extras": extras}


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
    own = facts["facerf"]
    yield "facerf", "", f"{own['version']}, Python {own['python']}, {own['system']}"
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
