"""facerf: one photo of a face to its reflectance field. The Python API; `docs/python.md` shows its use.

    import facerf_cli as facerf

Names are loaded from `facerf_cli.api` at their first use, so that the command line starts without torch.
"""

from typing import TYPE_CHECKING, Any

from facerf_cli._version import __version__ as __version__

if TYPE_CHECKING:
    from facerf_cli.api import (
        Group,
        Light,
        Person,
        PhotoCamera,
        find_faces,
        fit,
        load_models,
        read_image,
        rig,
        write_image,
    )

__all__ = [
    "Group",
    "Light",
    "Person",
    "PhotoCamera",
    "find_faces",
    "fit",
    "load_models",
    "read_image",
    "rig",
    "write_image",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from facerf_cli import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
