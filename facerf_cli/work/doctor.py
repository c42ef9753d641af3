"""The facts that `facerf doctor` prints: packages, extras, device, networks with licences, colour, cache."""

import os
import platform
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

from facerf_cli._version import __version__
from facerf_cli.batch.settings import Settings, torch_device
from facerf_cli.errors import FacerfError
from facerf_cli.run.logs import json_line
from facerf_cli.run.machine import memory_bytes

MISSING = "MISSING"
# Extras of the package (pyproject.toml) for users, and the use of each.
EXTRAS = {
    "face-models": "Basel's models in `face-model import`",
    "tensorboard": "the curves of `train`",
    "ray": "`--ray`, on clusters",
    "heic": "HEIC photos of phones",
    "video": "films in and out; its wheel holds GPL codecs",
    "dlib": "`--identity`, and Face dis of `evaluate`",
}
Facts = dict[str, dict[str, Any]]


def examine(settings: Settings) -> Facts:
    """List the facts by section and name; MISSING is in what facerf needs and does not find.

    If a package is missing, there are only the sections that need none.
    """
    system = f"{platform.system()} {platform.machine()}"
    facts = {"facerf": {"version": __version__, "python": platform.python_version(), "system": system}}
    facts |= _packages()
    return facts if MISSING in json_line(facts) else facts | _machine(settings)


def _packages() -> Facts:
    """The versions of packages and extras, or the command that installs them."""
    from importlib import metadata  # slow to load, and --help does without it

    try:
        requirements = metadata.requires("facerf") or []
    except metadata.PackageNotFoundError:
        return {"packages": {"facerf": f"{MISSING}; pip install ."}, "extras": {}}
    packages: dict[str, str] = {}
    extras: dict[str, str] = {}
    for requirement in requirements:
        wanted, _, marker = (part.strip() for part in requirement.partition(";"))
        package = re.split(r"[^\w.-]", wanted, maxsplit=1)[0]
        extra = re.search(r"extra == .([\w-]+)", marker)
        name = extra[1] if extra else ""
        try:
            version = metadata.version(package)
        except metadata.PackageNotFoundError:
            version = ""
        if not extra:
            packages[package] = version or f"{MISSING}; pip install '{wanted}'"
        elif name in EXTRAS and not version:
            extras[name] = f"not installed; pip install 'facerf[{name}]' adds {EXTRAS[name]}"
        elif name in EXTRAS:  # others are developers' tools
            extras.setdefault(name, f"{package} {version}, for {EXTRAS[name]}")
    return {"packages": packages, "extras": extras}


def _machine(settings: Settings) -> Facts:
    """The sections that need packages."""
    import OpenImageIO as oiio
    import platformdirs
    import torch

    device = torch_device(settings)
    built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built without CUDA"
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"this torch is {built}"
    configuration = oiio.ColorConfig()
    if trouble := configuration.geterror():
        raise FacerfError(f"$OCIO is {os.environ.get('OCIO', '')!r}: {trouble}")
    return {
        "device": {
            "name": f"{device} ({name})",
            "threads": torch.get_num_threads(),
            "memory": f"{memory_bytes() / 2**30:.0f} GiB",
        },
        "networks": _networks(settings),
        "colour": {"OCIO configuration": configuration.configname()},
        "cache": {"folder": platformdirs.user_cache_dir("facerf")},
    }


def _networks(settings: Settings) -> Facts:
    """File, SHA-256 and licence of each network, and of the face model."""
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
        networks[MISSING] = {"reason": str(error)}
    with suppress(FacerfError):  # an extra
        networks["dlib"] = facts_of(descriptor.descriptor_path(), descriptor.LICENCE)
    return networks
