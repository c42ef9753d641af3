"""Relight the people in a photo: the Python API of facerf (docs/python.md).

    import facerf_cli as facerf

The API is imported on first use, so that the command line starts without torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from facerf_cli._version import __version__ as __version__

if TYPE_CHECKING:  # type checkers cannot evaluate API
    from facerf_cli.api import read_image as read_image
    from facerf_cli.api import write_image as write_image
    from facerf_cli.light.light import Light as Light
    from facerf_cli.light.light import rig as rig
    from facerf_cli.person import Group as Group
    from facerf_cli.person import Person as Person
    from facerf_cli.person import PhotoCamera as PhotoCamera
    from facerf_cli.person import find_faces as find_faces
    from facerf_cli.person import fit as fit
    from facerf_cli.relighting.models import load_models as load_models

API = {
    "read_image": "api",
    "write_image": "api",
    "load_models": "relighting.models",
    "find_faces": "person",
    "fit": "person",
    "Person": "person",
    "Group": "person",
    "PhotoCamera": "person",
    "Light": "light.light",
    "rig": "light.light",
}  # public names and the modules that define them


def __getattr__(name: str) -> Any:
    if name not in API:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{API[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *API})
