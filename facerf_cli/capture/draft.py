"""First draft of `stage.json` for a folder of images: what file names and headers say, null for the rest.

The entry "draft" lists what was found, what a person must fill in, and what to check. Directions come from a
list of lights beside the images (`.lp`, `light*.txt`, `light*.json`), if there is one.
"""

import json
import logging
import math
import os
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from facerf_cli.batch.inputs import PHOTO_SUFFIXES
from facerf_cli.capture.capture import FIELDS, compile_pattern, require_pattern, unlisted_kind
from facerf_cli.capture.stage_json import FACING, STAGE_FILE, STAGE_FORMAT
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import is_name
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.texts import ListedLight, Vector, read_light_list
from facerf_cli.run.logs import LOGGER_NAME, counted

log = logging.getLogger(LOGGER_NAME)
_LONE_CAMERA = "C0"  # id where the pattern has no {camera}
_LONE_SUBJECT = "subject"  # id where it has no {subject}, and the folder's name cannot be one
_LEAST_LIGHTS = 3  # fewer determine no normals
_LISTED = 3  # names of a note
_DIGITS = 6
_DEEPEST = 8  # folders below the capture that are searched
_LIST_NAME = re.compile(r".*\.lp|light.*\.(txt|json)", re.IGNORECASE)
_WANTED = {
    "direction": "a unit vector in world space, toward the light",
    "world_to_camera": "3 x 4 in metres, OpenCV axes",
    "K": "in pixels",
    "width": "in pixels",
    "height": "in pixels",
}

Key = tuple[str, str, str]  # subject, camera and light; empty where the pattern does not name them


@dataclass(frozen=True)
class Frames:
    """Images sorted by a pattern."""

    paths: dict[Key, str]
    ambient: Counter[str]  # names in the light's place of images without lights
    strays: list[str]  # images that do not match the pattern, or whose ids cannot be parts of file names

    def ids(self, field: str) -> list[str]:
        """Ids of all subjects, cameras or lights, numbers in their natural order: 2 before 10."""
        return sorted({key[FIELDS.index(field)] for key in self.paths}, key=_natural_order)


def describe_capture(folder: Path, pattern: str, output: Path | None, dry_run: bool) -> None:
    """Write a draft of stage.json to `output` or into the folder, and print its path and notes.

    UsageError where the file exists. A dry run prints the notes only.
    """
    path = folder / STAGE_FILE if output is None else output
    if path.is_dir() and not dry_run:
        raise UsageError(f"-o {path}: is a folder; give the draft's name, such as {path / STAGE_FILE}")
    if not dry_run and (path.exists() or path.is_symlink()):
        raise UsageError(f"{path}: already exists; a draft never overwrites, so move it or give another -o")
    stage = draft_stage(folder, PHOTO_SUFFIXES, pattern)
    for note in stage["draft"]:
        log.info("%s", note)
    if dry_run:
        print(f"{folder} -> {path}")
        return
    with atomic_path(path) as temporary:
        temporary.write_text(as_text(stage), encoding="utf-8", errors="backslashreplace")
    print(path)


def draft_stage(folder: Path, suffixes: Collection[str], pattern: str) -> dict[str, Any]:
    """Draft the content of `stage.json`, with notes under "draft"; UsageError for a folder without a capture.

    Without a `pattern` the UsageError has one that may fit.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; give the folder of a capture")
    images, lists = scan_folder(folder, suffixes)
    if not images:
        raise UsageError(f"{folder}: no images found (looked for {' '.join(sorted(suffixes))})")
    try:
        if not pattern:
            examples = [example_pattern(path) for path in images]
            likely = Counter(examples).most_common(1)[0][0]
            example = f"'{likely}' for {_list([images[examples.index(likely)]])}"
            raise UsageError(f"--pattern is needed; say what the parts of a path are, such as {example}")
        frames = frames_by_pattern(images, pattern)
        if len(found := frames.ids("light")) < _LEAST_LIGHTS:
            names = f"{counted(len(found), 'light')} ({', '.join(found)})"
            raise UsageError(
                f"{names}, but a capture has {_LEAST_LIGHTS} or more; give its folder, or correct --pattern"
            )
    except UsageError as error:
        raise UsageError(f"{folder}: {error}") from None
    directions, about_lights = _read_directions(folder, lists, frames)
    ambient, name = frames.ambient.most_common(1), folder.resolve().name
    content: dict[str, Any] = {
        "colour_space": None,
        "black_level": 0.0,
        "axes": "opencv",
        "unit": "m",
        "pattern": pattern,
        **({"ambient": pattern.replace("{light}", ambient[0][0])} if ambient else {}),
        "lights": [
            {"id": light, "direction": directions.get(light), "intensity": [1.0, 1.0, 1.0]}
            for light in frames.ids("light")
        ],
        "cameras": list(_cameras(folder, frames)),
        **({} if "{subject}" in pattern else {"subjects": {name if is_name(name) else _LONE_SUBJECT: {}}}),
    }
    notes = [
        f"{pattern}: {_counts(frames)}",
        *(f"fill in: {note}" for note in _gaps(content)),
        *filter(None, [about_lights]),
        "check: lights: the intensity 1 1 1 is assumed of each; black_level: 0 is assumed",
    ]
    if strays := frames.strays:
        wrong = "do not match the pattern, or have ids not of letters, digits, - and _ alone"
        notes.append(f"left out: {counted(len(strays), 'image')} that {wrong} ({_list(strays)})")
    return {"format": STAGE_FORMAT, "draft": notes, **content}


def as_text(stage: Mapping[str, Any]) -> str:
    """Write JSON with a line per light, camera and note, for people to fill in."""
    lines = []
    for key, value in stage.items():
        if isinstance(value, list):
            entries = ",\n".join(f"  {json.dumps(entry, ensure_ascii=False)}" for entry in value)
            lines.append(f" {json.dumps(key)}: [\n{entries}\n ]")
        else:
            lines.append(f" {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _counts(frames: Frames) -> str:
    """How many subjects, cameras and lights there are, and how many of their frames."""
    numbers = [len(frames.ids(field)) for field in FIELDS]
    words = ", ".join(counted(number, field) for number, field in zip(numbers, FIELDS, strict=True))
    expected = math.prod(numbers)
    missing = expected - len(frames.paths)
    exist = f"{missing} of {expected} frames are missing" if missing else f"all {expected} frames exist"
    return f"{words}; {exist}"


def _cameras(folder: Path, frames: Frames) -> Iterator[dict[str, Any]]:
    """Entries of the cameras, with the sizes of their first images; the space of a lone one is the world."""
    names = frames.ids("camera")
    for name in names:
        path = next(path for (_, camera, _), path in frames.paths.items() if camera == name)
        header = read_header(folder / path)
        width, height = (header.width_px, header.height_px) if header else (None, None)
        entry = {"id": name or _LONE_CAMERA, "width": width, "height": height, "K": None}
        yield entry | {"world_to_camera": FACING if len(names) == 1 else None}


def _read_directions(folder: Path, lists: Sequence[str], frames: Frames) -> tuple[dict[str, Vector], str]:
    """Directions of lights from the first list of lights, and a note about it."""
    if not lists:
        return {}, ""
    stems = {PurePosixPath(path).stem: light for (_, _, light), path in frames.paths.items()}
    try:
        listed = read_light_list(folder / lists[0])
    except InputError as error:
        return {}, f"left out: a list of lights: {error}"
    found = match_lights(listed, frames.ids("light"), stems)
    if not found:
        problem = f"its {len(listed)} lines name none of the {len(frames.ids('light'))} lights"
        return {}, f"left out: a list of lights: {folder / lists[0]}: {problem}"
    axes = "x right, y up, z toward the camera, as world space"
    directions = {light: _unit(vector) for light, vector in found.items()}
    return directions, f"check: lights: directions from {_list(lists[:1])}, {axes}"


def _unit(vector: Vector) -> Vector:
    unit: Vector = ((np.array(vector) / np.linalg.norm(vector)).round(_DIGITS) + 0.0).tolist()  # no -0.0
    return unit


def match_lights(
    listed: Sequence[ListedLight], light_ids: Sequence[str], light_of_stem: Mapping[str, str]
) -> dict[str, Vector]:
    """Assign listed vectors to lights by name; a list without names goes by the order of the lights.

    `light_of_stem` maps the stem of an image's file name to its light.
    """
    if not any(name for name, _ in listed):
        pairs = zip(light_ids, listed, strict=True) if len(listed) == len(light_ids) else ()
        return {light: vector for light, (_, vector) in pairs}
    known = {**light_of_stem, **{light: light for light in light_ids}}
    found = {}
    for path, vector in listed:
        name = path.replace("\\", "/").split("/")[-1]
        light = known.get(name) or known.get(name.rpartition(".")[0])
        if light is not None:
            found[light] = vector
    return found


def _gaps(content: Mapping[str, Any]) -> Iterator[str]:
    """Describe the null entries, counted by light and camera."""
    for key, value in content.items():
        entries = value if isinstance(value, list) else ()
        for name in dict.fromkeys(name for entry in entries if isinstance(entry, dict) for name in entry):
            if empty := [entry["id"] for entry in entries if entry.get(name, 0) is None]:
                yield f"{name} of {len(empty)} of {counted(len(entries), key[:-1])} ({_WANTED[name]})"
    yield (
        "colour_space: 'linear' for values in proportion to light with Rec.709 primaries, 'sRGB' for images "
        "with a display curve"
    )


def _list(names: Sequence[str]) -> str:
    """The first names, escaped where a terminal cannot print them."""
    words = [name if name.isprintable() else ascii(name) for name in names[:_LISTED]]
    return ", ".join([*words, "..."] if len(names) > _LISTED else words)


def scan_folder(folder: Path, suffixes: Collection[str]) -> tuple[list[str], list[str]]:
    """Find images with these suffixes, and lists of lights, the uppermost first.

    Paths are relative to the folder, with / between names. Hidden files and folders are skipped. Links to
    folders are followed, but each folder is entered once.
    """
    images: list[str] = []
    lists: list[str] = []
    entered: set[tuple[int, int]] = set()
    for here, folders, files in os.walk(folder, followlinks=True):
        status, below = os.stat(here), Path(here).relative_to(folder)
        folders[:] = sorted(name for name in folders if name[0] != "." and len(below.parts) < _DEEPEST)
        if (status.st_dev, status.st_ino) in entered:
            folders.clear()
            continue
        entered.add((status.st_dev, status.st_ino))
        for name in sorted(name for name in files if name[0] != "."):
            suffix, path = os.path.splitext(name)[1].lower(), (below / name).as_posix()
            if suffix in suffixes:
                images.append(path)
            elif _LIST_NAME.fullmatch(name) and (folder / path).is_file():
                lists.append(path)
    return images, sorted(lists, key=lambda path: (path.count("/"), path))


def frames_by_pattern(images: Sequence[str], pattern: str) -> Frames:
    """Sort images into frames, ambient images and strays; images with all lights on are skipped.

    UsageError for a wrong pattern, or one that no image matches.
    """
    try:
        expression = compile_pattern(require_pattern(pattern, "--pattern", ["light"]))
    except InputError as error:
        raise UsageError(str(error)) from None
    frames = Frames({}, Counter(), [])
    for path in sorted(images):
        match = expression.fullmatch(path)
        named = match.groupdict() if match else {}
        if named and (kind := unlisted_kind(named["light"])):
            frames.ambient.update([named["light"]] if kind == "ambient" else [])
        elif not named or not all(map(is_name, named.values())):
            frames.strays.append(path)
        else:
            frames.paths[named.get("subject", ""), named.get("camera", ""), named["light"]] = path
    if not frames.paths:
        raise UsageError(f"--pattern {pattern}: no image matches, not even {images[0]}; correct the pattern")
    return frames


def _natural_order(text: str) -> list[str | int]:
    pieces = re.split("([0-9]+)", text)  # every second one is a number
    return [int(piece) if place % 2 else piece for place, piece in enumerate(pieces)] + [text]


def example_pattern(path: str) -> str:
    """Guess what the parts of an image's path are: its name the light, its folders subject and camera."""
    *folders, _ = path.split("/")
    fields = ["{subject}", "{camera}"][: len(folders)]
    above = folders[: len(folders) - len(fields)]
    return "/".join([*above, *fields, "{light}" + PurePosixPath(path).suffix])
