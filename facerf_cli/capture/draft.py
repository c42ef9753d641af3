"""First draft of `stage.json` for a folder of images; null for everything that a person must fill in.

Lights and cameras come from the file names, sizes from the headers. Directions come from a list of lights
in the folder (`.lp`, `light*.txt`, `light*.json`), if there is one. The entry "draft" contains the
inventory and the points to check.
"""

import glob
import json
import logging
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from facerf_cli.capture.capture import FIELDS, compile_pattern, require_pattern
from facerf_cli.capture.stage_json import FACING, STAGE_FILE, STAGE_FORMAT
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import is_name
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.texts import ListedLight, Vector, read_light_list
from facerf_cli.run.logs import LOGGER_NAME, counted

log = logging.getLogger(LOGGER_NAME)
_LONE_CAMERA = "C0"  # id if the pattern has no {camera}
_LONE_SUBJECT = "subject"  # id if it has no {subject}, and the folder's name cannot be one
_LEAST_LIGHTS = 3  # fewer determine no normals
_LISTED = 3  # names of a note
_DIGITS = 6
_LIST_NAME = re.compile(r".*\.lp|light.*\.(txt|json)", re.IGNORECASE)
_TO_FILL_IN = {
    "colour_space": "'linear' for values in proportion to light with Rec.709 primaries, 'sRGB' for images "
    "with a display curve",
    "direction": "unit vector in world space, toward the light",
    "world_to_camera": "3 x 4 in metres, OpenCV axes",
    "K": "3 x 3 in pixels",
    "width": "pixels",
    "height": "pixels",
}

Key = tuple[str, str, str]  # subject, camera and light; empty if the pattern does not name them


@dataclass(frozen=True)
class Frames:
    """Images sorted by a pattern."""

    paths: dict[Key, str]
    odd: list[str]  # images whose ids cannot be parts of file names

    def ids(self, field: str) -> list[str]:
        """Return the ids of all subjects, cameras or lights, numbers in their natural order: 2 before 10."""
        return sorted({key[FIELDS.index(field)] for key in self.paths}, key=_natural_order)


def describe_capture(folder: Path, pattern: str, output: Path | None, dry_run: bool) -> None:
    """Write a draft of stage.json to `output` or into the folder, and print its path and notes.

    Raises UsageError if the file exists. A dry run prints only the notes.
    """
    path = folder / STAGE_FILE if output is None else output
    if path.is_dir() and not dry_run:
        raise UsageError(f"-o {path}: is a folder; use the draft's name, such as {path / STAGE_FILE}")
    if not dry_run and (path.exists() or path.is_symlink()):
        raise UsageError(f"{path}: already exists; a draft never overwrites, so move it or use another -o")
    stage = draft_stage(folder, pattern)
    for note in stage["draft"]:
        log.info("%s", note)
    if dry_run:
        print(f"{folder} -> {path}")
        return
    with atomic_path(path) as temporary:
        temporary.write_text(as_text(stage), encoding="utf-8", errors="backslashreplace")
    print(path)


def draft_stage(folder: Path, pattern: str) -> dict[str, Any]:
    """Draft the content of `stage.json`, with notes under "draft".

    Raises UsageError for a folder without a capture.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; use the folder of a capture")
    if not pattern:
        raise UsageError(
            "--pattern: missing; name the parts of a path, such as '{subject}/{camera}/{light}.exr'"
        )
    matching = folder.glob(re.sub(f"{{({'|'.join(FIELDS)})}}", "*", glob.escape(pattern)))
    images = (path.relative_to(folder).as_posix() for path in matching if path.is_file())
    frames = frames_by_pattern(images, pattern)
    lights, cameras = frames.ids("light"), frames.ids("camera")
    if len(lights) < _LEAST_LIGHTS:
        names = f"{counted(len(lights), 'light')} ({', '.join(lights)})"
        advice = f"a capture has {_LEAST_LIGHTS} or more; use its folder, or correct --pattern"
        raise UsageError(f"{folder}: {names}, but {advice}")
    counts = [len(frames.ids(field)) for field in FIELDS]
    inventory = ", ".join(counted(count, field) for count, field in zip(counts, FIELDS, strict=True))
    expected, missing = math.prod(counts), math.prod(counts) - len(frames.paths)
    exist = f"{missing} of {expected} frames are missing" if missing else f"all {expected} frames exist"
    notes = [f"{pattern}: {inventory}; {exist}"]
    directions = _read_directions(folder, frames, notes)
    notes.append("check: lights: the intensity 1 1 1 is assumed of each; black_level: 0 is assumed")
    if odd := frames.odd:
        fault = "have ids with other characters than letters, digits, - and _"
        notes.append(f"left out: {counted(len(odd), 'image')} that {fault} ({_list(odd)})")
    name = folder.resolve().name
    stage: dict[str, Any] = {
        "format": STAGE_FORMAT,
        "draft": notes,
        "colour_space": None,
        "black_level": 0.0,
        "axes": "opencv",
        "unit": "m",
        "pattern": pattern,
        "lights": [
            {"id": light, "direction": directions.get(light), "intensity": [1.0, 1.0, 1.0]}
            for light in lights
        ],
        "cameras": [_camera(folder, camera, frames, is_alone=len(cameras) == 1) for camera in cameras],
        **({} if "{subject}" in pattern else {"subjects": {name if is_name(name) else _LONE_SUBJECT: {}}}),
    }
    entries = [stage, *stage["lights"], *stage["cameras"]]
    nulls = {key for entry in entries for key, value in entry.items() if value is None}
    to_fill_in = ", ".join(f"{key} ({meaning})" for key, meaning in _TO_FILL_IN.items() if key in nulls)
    notes.insert(1, f"fill in each null: {to_fill_in}; remove lights that are several lights, or none")
    return stage


def as_text(stage: Mapping[str, Any]) -> str:
    """Return JSON with a line per light, camera and note, which people can fill in."""
    lines = []
    for key, value in stage.items():
        if isinstance(value, list):
            entries = ",\n".join(f"  {json.dumps(entry, ensure_ascii=False)}" for entry in value)
            lines.append(f" {json.dumps(key)}: [\n{entries}\n ]")
        else:
            lines.append(f" {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _camera(folder: Path, camera: str, frames: Frames, is_alone: bool) -> dict[str, Any]:
    """Return the entry of a camera, with the size of its first image; a single camera defines the world."""
    header = read_header(folder / next(path for key, path in frames.paths.items() if key[1] == camera))
    width, height = (header.width_px, header.height_px) if header else (None, None)
    pose = FACING if is_alone else None
    entry = {"id": camera or _LONE_CAMERA, "width": width, "height": height}
    return {**entry, "K": None, "world_to_camera": pose}


def _read_directions(folder: Path, frames: Frames, notes: list[str]) -> dict[str, Vector]:
    """Return directions of lights from the first list of lights, and add a note about it."""
    lists = [path for path in sorted(folder.iterdir()) if _LIST_NAME.fullmatch(path.name) and path.is_file()]
    if not lists:
        return {}
    stems = {PurePosixPath(path).stem: light for (_, _, light), path in frames.paths.items()}
    light_ids = frames.ids("light")
    try:
        listed = read_light_list(lists[0])
    except InputError as error:
        notes.append(f"left out: a list of lights: {error}")
        return {}
    vectors = match_lights(listed, light_ids, stems)
    if vectors:
        axes = "x right, y up, z toward the camera, as world space"
        notes.append(f"check: lights: directions from {_list([lists[0].name])}, {axes}")
    else:
        has_names, given = any(name for name, _ in listed), counted(len(listed), "direction")
        lights = f"{len(light_ids)} lights"
        fault = f"names none of the {lights}" if has_names else f"{given} for {lights}"
        notes.append(f"left out: a list of lights: {lists[0]}: {fault}")
    units = {light: np.array(vector) / np.linalg.norm(vector) for light, vector in vectors.items()}
    return {light: (unit.round(_DIGITS) + 0.0).tolist() for light, unit in units.items()}  # no -0.0


def match_lights(
    listed: Sequence[ListedLight], light_ids: Sequence[str], light_of_stem: Mapping[str, str]
) -> dict[str, Vector]:
    """Assign listed vectors to lights by name; a list without names uses the order of the lights.

    `light_of_stem` maps the stem of an image's file name to its light.
    """
    if not any(name for name, _ in listed):
        pairs = zip(light_ids, listed, strict=True) if len(listed) == len(light_ids) else ()
        return {light: vector for light, (_, vector) in pairs}
    known = {**light_of_stem, **{light: light for light in light_ids}}
    vectors = {}
    for path, vector in listed:
        name = path.replace("\\", "/").split("/")[-1]
        light = known.get(name) or known.get(name.rpartition(".")[0])
        if light is not None:
            vectors[light] = vector
    return vectors


def _list(names: Sequence[str]) -> str:
    """Return the first names, escaped if a terminal cannot print them."""
    words = [name if name.isprintable() else ascii(name) for name in names[:_LISTED]]
    return ", ".join([*words, "..."] if len(names) > _LISTED else words)


def frames_by_pattern(paths: Iterable[str], pattern: str) -> Frames:
    """Sort paths of images by a pattern.

    Raises UsageError for a wrong pattern, or one that no image fits.
    """
    try:
        expression = compile_pattern(require_pattern(pattern, "--pattern", ["light"]))
    except InputError as error:
        raise UsageError(str(error)) from None
    frames = Frames({}, [])
    for path, match in [(path, expression.fullmatch(path)) for path in sorted(paths)]:
        named = match.groupdict() if match else {}
        if not named or not all(map(is_name, named.values())):
            frames.odd.append(path)
        else:
            frames.paths[named.get("subject", ""), named.get("camera", ""), named["light"]] = path
    if not frames.paths:
        raise UsageError(f"--pattern {pattern}: matches no image; correct the pattern")
    return frames


def _natural_order(text: str) -> list[str | int]:
    pieces = re.split("([0-9]+)", text)  # every second piece is a number
    return [int(piece) if place % 2 else piece for place, piece in enumerate(pieces)] + [text]
