"""The packages that facerf needs and its extras, as installed; itself it needs none of them."""

import platform
import re
from typing import Any

from facerf_cli._version import __version__

MISSING = "MISSING"
# Extras of the package (pyproject.toml) for users, and the use of each.
EXTRAS = {
    "synth": "`--renderer mitsuba`",
    "face-models": "Basel's models in `face-model import`",
    "tensorboard": "the curves of `train`",
    "ray": "`--ray`, on clusters",
    "heic": "HEIC photos of phones",
    "video": "films in and out; its wheel holds GPL codecs",
    "dlib": "`--identity`, and Face dis of `evaluate`",
}
Facts = dict[str, Any]


def installation() -> Facts:
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
