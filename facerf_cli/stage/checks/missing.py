"""Frames that the capture's pattern promises and the disk lacks, and files that no lamp accounts for."""

from collections.abc import Iterator

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.data.capture import Capture

_SHOWN = 3
FULL_NAMES = ("full", "full_on", "fullon", "all", "all_on")  # a frame with every lamp on, see `additivity.py`
_NO_LAMP = ("ambient", "dark", "black", "room", "background")  # frames that stages keep for other ends


def check_missing(capture: Capture, subject: str, camera: str) -> Iterator[Finding]:
    """Frames of a camera that are missing, one by one; a whole camera, or extra files, in one warning."""
    paths = {light: capture.frame_path(subject, camera, light) for light in capture.light_ids}
    missing = [light for light, path in paths.items() if not path.is_file()]
    if len(missing) == len(paths):
        example = next(iter(paths.values()))
        words = f"no frame of this camera is there ({example}, ...); is the pattern right?"
        yield Finding("warning", "missing", subject, words, camera)
        missing = []
    for light in missing:
        yield Finding("error", "missing", subject, f"{paths[light]}: no such file", camera, light, {}, True)
    extra = extra_names(capture, subject, camera)
    if extra:
        names = ", ".join(extra[:_SHOWN]) + (", ..." if len(extra) > _SHOWN else "")
        words = f"files of no lamp in the list: {len(extra)} ({names}); are lamps missing from it?"
        yield Finding("warning", "extra", subject, words, camera, figures={"files": len(extra)})


def extra_names(capture: Capture, subject: str, camera: str) -> list[str]:
    """Names in the light's place of files that are of no lamp, sorted; known ones for other ends left out."""
    mark = "\x01"  # in no name
    path = capture.frame_path(subject, camera, mark)
    if path.name.count(mark) != 1 or mark in str(path.parent):  # the light names a folder, or is named twice
        return []
    prefix, after = path.name.split(mark)
    known, names = set(capture.light_ids), []
    for found in path.parent.glob("*"):
        name = found.name
        if found.is_file() and name.startswith(prefix) and name.endswith(after) and name[0] != ".":
            names.append(name[len(prefix) : len(name) - len(after)])
    others = (name for name in names if name and name not in known)
    return sorted(name for name in others if not other_end(name))


def other_end(name: str) -> str:
    """What a picture in a light's place is for: 'full', 'ambient', or nothing where it may be of a lamp."""
    plain = name.lower().strip("_- ")
    if plain in FULL_NAMES:
        return "full"
    return "ambient" if any(word in plain for word in _NO_LAMP) else ""
