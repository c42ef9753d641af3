"""Protocols, metrics and reports of `facerf evaluate`."""

import os
from pathlib import Path


def folder_name(folder: Path) -> str:
    """The folder's own name as its method's; '.' has the name of the folder that it stands for."""
    return Path(os.path.abspath(folder)).name
