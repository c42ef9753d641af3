"""What a folder of pictures is called: a method's name in tables, from whatever path the user gave."""

import os
from pathlib import Path


def folder_name(folder: Path) -> str:
    """The folder's own name; a link's is the link's, and '.' has that of the folder it stands for."""
    return Path(os.path.abspath(folder)).name
