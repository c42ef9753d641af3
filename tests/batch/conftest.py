"""A folder of files for verbs that walk folders."""

from pathlib import Path

import pytest


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    for name in ("b.jpg", "a.png", "x/a.jpg", "x/c.png", "x/note.txt", ".hidden/c.jpg", "x/.d.jpg", "Z.EXR"):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return folder
