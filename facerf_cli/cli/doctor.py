"""`facerf doctor`: installed and missing packages, the device, and networks with licences."""

import platform
import re
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from facerf_cli._version import __version__
from facerf_cli.batch.settings import Settings, torch_device
from facerf_cli.cli.options import settings_of
from facerf_cli.errors import FacerfError
from facerf_cli.run.logs import json_line

_MISSING = "MISSING"
EXTRAS = {  # of the package (pyproject.toml), and their uses; others are developers' tools
    "face-models": "Basel's models in `face-model import`",
    "tensorboard": "the curves of `train`",
    "ray": "`--ray`, on clusters",
    "heic": "HEIC photos of phones",
    "video": "videos in and out; its wheel contains GPL codecs",
    "dlib": "`--identity`, and Face dis of `evaluate`",
}
Facts = dict[str, dict[str, Any]]


def doctor(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Show installed packages and networks with their licences, and how to install missing packages.

    The exit code is 1 if a required part is missing. The extras are optional.
    """
    system = f"{platform.system()} {platform.machine()}"
    facts = {"facerf": {"version": __version__, "python": platform.python_version(), "system": system}}
    facts |= _packages()
    if _MISSING not in json_line(facts):
        facts |= _machine(settings_of(context))
    text = json_line(facts)
    if as_json:
        print(text)
    else:
        for section, entries in facts.items():
            print(section)
            for name, entry in entries.items():
                values = entry.values() if isinstance(entry, dict) else [entry]
                print(f"  {name}: {', '.join(map(str, values))}")
    raise typer.Exit(1 if _MISSING in text else 0)


def _packages() -> Facts:
    """Return the versions of packages and extras, or the commands that install them."""
    from importlib import metadata  # slow to load, and --help does without it

    def version_of(package: str) -> str:
        with suppress(metadata.PackageNotFoundError):
            return metadata.version(package)
        return ""

    try:
        requirements = metadata.requires("facerf") or []
    except metadata.PackageNotFoundError:
        return {"packages": {"facerf": f"{_MISSING}; pip install ."}, "extras": {}}
    packages: dict[str, str] = {}
    extras: dict[str, str] = {}
    for requirement in requirements:
        specifier, _, marker = (part.strip() for part in requirement.partition(";"))
        package = re.split(r"[^\w.-]", specifier, maxsplit=1)[0]
        version, extra = version_of(package), re.search(r"extra == .([\w-]+)", marker)
        if not extra:
            packages[package] = version or f"{_MISSING}; pip install '{specifier}'"
        elif (name := extra[1]) in EXTRAS and not version:
            extras[name] = f"not installed; pip install 'facerf[{name}]' adds {EXTRAS[name]}"
        elif name in EXTRAS:
            extras.setdefault(name, f"{package} {version}, for {EXTRAS[name]}")
    return {"packages": packages, "extras": extras}


def _machine(settings: Settings) -> Facts:
    """Return the sections that need packages."""
    import platformdirs
    import torch

    device = torch_device(settings)
    built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built without CUDA"
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"this torch is {built}"
    return {
        "device": {"name": f"{device} ({name})"},
        "networks": _networks(settings),
        "cache": {"folder": platformdirs.user_cache_dir("facerf")},
    }


def _networks(settings: Settings) -> Facts:
    """Return file, SHA-256 and licence of each network, and of the face model."""
    from facerf_cli.face import descriptor
    from facerf_cli.face.morphable import BUILTIN_PATH, load_face_model
    from facerf_cli.network import stored_graph
    from facerf_cli.network.files import read_metadata, serving_files
    from facerf_cli.relighting.models import described_file

    def facts_of(path: Path, licence: str) -> dict[str, str]:
        return {**described_file(path), "licence": licence}

    networks: Facts = {}
    try:
        for name, path in serving_files(settings.checkpoints, user="facerf").items():
            networks[name] = facts_of(path, str(read_metadata(path).get("licence")))
        networks["mediapipe"] = facts_of(stored_graph.ASSET, stored_graph.LICENCE)
        networks["face model"] = facts_of(BUILTIN_PATH, load_face_model().licence)
    except (FacerfError, OSError) as error:
        networks[_MISSING] = {"reason": str(error)}
    with suppress(FacerfError):  # an extra
        networks["dlib"] = facts_of(descriptor.descriptor_path(), descriptor.LICENCE)
    return networks
