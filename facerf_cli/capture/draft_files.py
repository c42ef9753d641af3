"""Files of a capture that has no stage.json: its images, their path pattern, and the frames among them."""

import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from facerf_cli.capture.draft_lights import LIST_NAMES, LIST_SUFFIX
from facerf_cli.capture.pattern import FIELDS, compile_pattern, require_pattern, unlisted_kind
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.documents import is_name

EXAMPLE = "{subject}/{camera}/{light}.exr"
_LAYOUTS = ("{light}", "{subject}/{light}", "{subject}/{camera}/{light}")  # by the number of folders
_DEEPEST = 8  # folders below the capture that are searched
_LEAST_SHARE = 0.5  # of the expected frames: with fewer, the layout is another one

Key = tuple[str, str, str]  # subject, camera and light; empty where the pattern does not name them


@dataclass
class Scan:
    """Files below a folder, as paths with / between names."""

    images: list[str] = field(default_factory=list)
    lists: list[str] = field(default_factory=list)  # lists of lights, the uppermost first
    unreadable: list[str] = field(default_factory=list)  # folders


def scan_folder(folder: Path, suffixes: Collection[str]) -> Scan:
    """Find images with these suffixes, and lists of lights; hidden files and folders are skipped.

    Links to folders are followed, but each folder is entered once.
    """
    scan, entered = Scan(), set[tuple[int, int]]()

    def note_unreadable(error: OSError) -> None:
        scan.unreadable.append(os.path.relpath(error.filename, folder))

    for here, folders, files in os.walk(folder, onerror=note_unreadable, followlinks=True):
        status, below = os.stat(here), Path(here).relative_to(folder)
        folders[:] = sorted(name for name in folders if name[0] != "." and len(below.parts) < _DEEPEST)
        if (status.st_dev, status.st_ino) in entered:
            folders.clear()
            continue
        entered.add((status.st_dev, status.st_ino))
        for name in sorted(name for name in files if name[0] != "."):
            suffix, path = os.path.splitext(name)[1].lower(), (below / name).as_posix()
            if suffix in suffixes:
                scan.images.append(path)
            elif (suffix == LIST_SUFFIX or name.lower() in LIST_NAMES) and (folder / path).is_file():
                scan.lists.append(path)
    scan.lists.sort(key=lambda path: (path.count("/"), path))
    return scan


@dataclass(frozen=True)
class Frames:
    """Images sorted by a pattern."""

    paths: dict[Key, str]
    ambient: Counter[str]  # names in the light's place of images without lights
    strays: list[str]  # images that do not match the pattern
    unnameable: list[str]  # ids that cannot be parts of file names

    def ids(self, field: str) -> list[str]:
        """Ids of all subjects, cameras or lights, numbers in their natural order: 2 before 10."""
        return sorted({key[FIELDS.index(field)] for key in self.paths}, key=_natural_order)

    def of_camera(self, camera: str) -> list[str]:
        """Paths of a camera's frames."""
        return [path for key, path in self.paths.items() if key[1] == camera]

    @property
    def expected(self) -> int:
        """Number of frames if every camera has every subject under every light."""
        return len(self.ids("subject")) * len(self.ids("camera")) * len(self.ids("light"))


def sort_frames(paths: Iterable[str], pattern: str) -> Frames:
    """Sort images into frames, ambient images and strays; images with all lights on are skipped."""
    frames, expression = Frames({}, Counter(), [], []), compile_pattern(pattern)
    for path in sorted(paths):
        match = expression.fullmatch(path)
        if match is None:
            frames.strays.append(path)
            continue
        named = match.groupdict()
        bad = [name for name in named.values() if not is_name(name)]
        if kind := unlisted_kind(named["light"]):
            frames.ambient.update([named["light"]] if kind == "ambient" else [])
        elif bad:
            frames.unnameable.extend(bad)
        else:
            frames.paths[named.get("subject", ""), named.get("camera", ""), named["light"]] = path
    return frames


def _natural_order(text: str) -> tuple[object, str]:
    pieces = re.split("([0-9]+)", text)
    is_number = [piece.isascii() and piece.isdigit() and len(piece) < 19 for piece in pieces]
    key = [(0, int(p), "") if number else (1, 0, p) for p, number in zip(pieces, is_number, strict=True)]
    return key, text


def frames_by_pattern(images: Sequence[str], pattern: str) -> Frames:
    """Sort images by the pattern of --pattern; UsageError for a wrong one, or one that no image matches."""
    try:
        require_pattern(pattern, "--pattern", ["light"])
    except InputError as error:
        raise UsageError(str(error)) from None
    frames = sort_frames(images, pattern)
    if not frames.paths:
        raise UsageError(f"--pattern {pattern}: no image matches, not even {images[0]}; correct the pattern")
    return frames


def frames_by_depth(images: Sequence[str]) -> tuple[Frames, str]:
    """Sort images by the layout for their folder depth; return its pattern too.

    UsageError where the images do not share a depth and a suffix, or lack most of the frames of that layout.
    """
    depths = sorted({path.count("/") for path in images})
    suffixes = sorted({PurePosixPath(path).suffix for path in images})
    if len(depths) > 1 or depths[0] >= len(_LAYOUTS):
        raise _unknown_layout(f"images lie in {' and '.join(map(str, depths))} folders")
    if len(suffixes) > 1:
        raise _unknown_layout(f"images end in {' and '.join(suffixes)}")
    pattern = _LAYOUTS[depths[0]] + suffixes[0]
    frames = sort_frames(images, pattern)
    if len(frames.paths) < max(_LEAST_SHARE * frames.expected, 1):
        raise _unknown_layout(f"by {pattern}, {len(frames.paths)} of {frames.expected} frames exist")
    return frames, pattern


def _unknown_layout(reason: str) -> UsageError:
    return UsageError(f"the layout of the images is unknown ({reason}); give --pattern, such as '{EXAMPLE}'")
