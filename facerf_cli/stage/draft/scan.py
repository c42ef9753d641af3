"""The files below a capture's folder, within bounds."""

import os
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from facerf_cli.stage.draft.lamps import LIST_NAMES, LIST_SUFFIX

_MOST_ENTRIES, _DEEPEST = 500_000, 8  # the paper's stage: 350 subjects, 8 cameras, 150 lights


@dataclass
class Scan:
    """Paths below the folder, / between names."""

    pictures: list[str] = field(default_factory=list)
    lists: list[str] = field(default_factory=list)  # of lights, the uppermost first
    shut: list[str] = field(default_factory=list)  # folders that cannot be read
    entries: int = 0

    @property
    def cut_short(self) -> bool:
        """Whether there is more than was looked at."""
        return self.entries >= _MOST_ENTRIES


def scan_folder(folder: Path, suffixes: Collection[str]) -> Scan:
    """Pictures with these suffixes and lists of lights, folder by folder in order; hidden ones are left out.

    Links to folders are followed, each folder once.
    """
    scan, ahead, known = Scan(), [""], set[tuple[int, int]]()
    while ahead and not scan.cut_short:
        below = ahead.pop()
        try:
            place = os.stat(folder / below)
            if (place.st_dev, place.st_ino) in known:
                continue
            known.add((place.st_dev, place.st_ino))
            ahead += reversed(_look_into(scan, folder, below, suffixes))
        except OSError:
            scan.shut.append(below)
    scan.lists.sort(key=lambda path: (path.count("/"), path))
    return scan


def _look_into(scan: Scan, folder: Path, below: str, suffixes: Collection[str]) -> list[str]:
    """Note a folder's files; give the folders in it, in order."""
    folders = []
    with os.scandir(folder / below) as entries:
        for entry in entries:
            scan.entries += 1
            if scan.cut_short:
                break
            path = f"{below}/{entry.name}" if below else entry.name
            suffix = os.path.splitext(entry.name)[1].lower()
            if entry.name[0] == ".":
                continue
            if (
                os.path.isdir(entry.path) if entry.is_symlink() else entry.is_dir()
            ):  # the latter fails on loops
                folders += [path] if path.count("/") < _DEEPEST else []
            elif suffix in suffixes:
                scan.pictures.append(path)
            elif (suffix == LIST_SUFFIX or entry.name.lower() in LIST_NAMES) and entry.is_file():
                scan.lists.append(path)
    return sorted(folders)
