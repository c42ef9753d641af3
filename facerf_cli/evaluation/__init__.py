"""Protocols, metrics and reports of `facerf evaluate`."""

import os
from pathlib import Path


def folder_name(folder: Path) -> str:
    """The name of a folder of predictions, and of its method; '.' is resolved, a link is not."""
    return Path(os.path.abspath(folder)).name
