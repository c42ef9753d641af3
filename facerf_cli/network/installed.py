"""Classes that the user has installed, by name: networks (`--form`) and objectives (`--objective`)."""

import importlib
import re
import sys
from pathlib import Path
from typing import Any

from facerf_cli.errors import UsageError

_NAME = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def is_installed_name(name: str) -> bool:
    """Tell a name package.module:Class from that of one of facerf's own."""
    return _NAME.fullmatch(name) is not None


def installed(name: str, flag: str) -> Any:
    """Import the class package.module:Class, never from the working directory.

    Raises UsageError, with the option's flag, for a name that is no class of an installed package.
    """
    module, _, attribute = name.partition(":")
    path = sys.path[:]
    sys.path[:] = [folder for folder in path if Path(folder).resolve() != Path.cwd()]
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"{flag} {name}: {error}; install the package that has it") from None
    finally:
        sys.path[:] = path
    if not isinstance(found, type):
        raise UsageError(f"{flag} {name}: is no class")
    return found
