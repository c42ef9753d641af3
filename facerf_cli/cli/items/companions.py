"""Files that go with a photo, such as its matte: one file, a folder with a file each, or a pattern."""

from collections.abc import Iterable
from pathlib import Path

from facerf_cli.cli.inputs import Item
from facerf_cli.cli.naming import OF_PHOTOS, NamePattern
from facerf_cli.errors import InputError


def companion(item: Item, given: Path, suffixes: Iterable[str], option: str) -> Path:
    """The file of an option that goes with a photo.

    A folder mirrors the photos', or holds all files in one place; a pattern has fields, as in
    `mattes/{dir}/{stem}.png`. Raises InputError for a photo without a file.
    """
    if "{" in str(given) and not given.exists():
        text = given.as_posix()
        pattern = NamePattern.parse(text.lstrip("/"), option, OF_PHOTOS)
        found = Path("/" if text.startswith("/") else "") / item.pattern_text(pattern)
        candidates = [found]
    elif given.is_dir():
        names = dict.fromkeys((item.name, item.input_path.stem))
        candidates = [given / f"{name}{suffix}" for name in names for suffix in suffixes]
    else:
        return given
    for path in candidates:
        if path.is_file():
            return path
    raise InputError(f"{item.input_path}: {option} has no {candidates[0]}; add it there")
