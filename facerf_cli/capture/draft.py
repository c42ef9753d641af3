"""A capture's pictures sorted by subject, camera and light, and those that are none of its frames.

The files below a capture's folder, within bounds.

What a folder of pictures tells of a capture: its names, its headers, and a list of lights beside them.

What a draft of `stage.json` tells the person who has to finish it, a line each.

A first draft of `stage.json` for a folder of pictures: what they tell, and null where they do not.

Under "draft" it lists what was found, and what a person has to fill in and to check.
"""

import json
import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from facerf_cli.capture.capture import FIELDS, require_pattern
from facerf_cli.capture.checks.frames import other_end
from facerf_cli.capture.draft_lights import (
    LIST_NAMES,
    LIST_SUFFIX,
    Sight,
    by_light,
    describe_camera,
    direction_in_name,
    look_at,
    read_lamps,
)
from facerf_cli.capture.draft_names import Naming, find_naming
from facerf_cli.capture.stage_json import STAGE_FORMAT
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.documents import Node, is_name
from facerf_cli.logs import counted

Key = tuple[str, str, str]  # subject, camera and light, empty where the pattern does not name them


@dataclass(frozen=True)
class Frames:
    """The frames by what is in them, in the order of people, not of machines: 2 before 10."""

    paths: dict[Key, str]
    ambient: Counter[str]  # what stands in a light's place in pictures without lamps, and how many there are
    full: Counter[str]  # the same of pictures with all lamps on
    strays: list[str]  # pictures that do not fit
    unnameable: list[str]  # ids that no file of ours could bear

    def ids(self, field: str) -> list[str]:
        """The ids of all subjects, cameras or lights, each once."""
        return sorted({key[FIELDS.index(field)] for key in self.paths}, key=natural_order)

    def of_camera(self, camera: str) -> list[str]:
        """The paths of a camera's frames."""
        return [path for key, path in self.paths.items() if key[1] == camera]


def sort_frames(paths: Iterable[str], naming: Naming) -> Frames:
    """Which of the paths are frames, and of what."""
    frames = Frames({}, Counter(), Counter(), [], [])
    for path in sorted(paths):
        match, loose = naming.strict.fullmatch(path), naming.loose.fullmatch(path)
        if loose and (end := other_end(loose["light"])):
            (frames.full if end == "full" else frames.ambient)[loose["light"]] += 1
        elif match is None:
            frames.strays.append(path)
        else:
            named = match.groupdict()
            bad = [name for name in named.values() if not is_name(name)]
            frames.unnameable.extend(bad)
            if not bad:
                frames.paths[named.get("subject", ""), named.get("camera", ""), named["light"]] = path
    return frames


def alike(names: Iterable[str]) -> Iterator[list[str]]:
    """Names that are one but for zeros before their numbers or for case, as `cam3` and `cam03`."""
    groups: dict[object, list[str]] = {}
    for name in names:
        groups.setdefault(natural_key(name.casefold()), []).append(name)
    return (group for group in groups.values() if len(group) > 1)


def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """What to sort by so that numbers are in the order of their values."""
    return tuple(
        (0, int(piece), "") if piece.isascii() and piece.isdigit() and len(piece) < 19 else (1, 0, piece)
        for piece in re.split("([0-9]+)", text)
    )


def natural_order(text: str) -> tuple[object, str]:
    """The same, with an order also of names that are alike in it."""
    return natural_key(text), text


_MOST_ENTRIES, _DEEPEST = 500_000, 8  # the paper's stage: 350 subjects, 8 cameras, 150 lights


@dataclass
class Scan:
    """Paths below the folder, / between names."""

    images: list[str] = field(default_factory=list)
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
                scan.images.append(path)
            elif (suffix == LIST_SUFFIX or entry.name.lower() in LIST_NAMES) and entry.is_file():
                scan.lists.append(path)
    return sorted(folders)


_LEAST_LIGHTS = 3  # fewer tell no normals


@dataclass(frozen=True)
class Rig:
    """Where lamps stand, by light, and which list says so."""

    directions: Mapping[str, list[float]]
    source: str = ""  # the list's path; empty where the directions are in the lights' names
    lengths: tuple[float, float] = (1.0, 1.0)  # least and greatest of the list's vectors
    unused: str = ""  # why a list that is there was not taken


@dataclass(frozen=True)
class Evidence:
    """All that a folder tells of its capture."""

    scan: Scan
    naming: Naming
    frames: Frames
    rig: Rig
    sights: Mapping[str, Sight]  # by camera; one of no name where the pattern has none

    @property
    def colour_space(self) -> str | None:
        """The one that all headers name; None where they differ, or do not tell."""
        spaces = {space for sight in self.sights.values() for space in sight.spaces}
        return spaces.pop() if len(spaces) == 1 else None


def look_into(folder: Path, suffixes: Collection[str]) -> Evidence:
    """What the pictures below a folder tell; a UsageError where they are no capture."""
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder")
    scan = scan_folder(folder, suffixes)
    if not scan.images:
        raise UsageError(f"{folder}: no pictures found (looked for {' '.join(sorted(suffixes))})")
    try:
        naming = find_naming(scan.images)
        require_pattern(Node("their pattern", naming.pattern), ["light"])
        frames = sort_frames(scan.images, naming)
        _require_lights(frames)
        sights = {
            camera: look_at([folder / path for path in frames.of_camera(camera)])
            for camera in frames.ids("camera")
        }
        _require_sizes(sights)
    except (UsageError, InputError) as error:
        raise UsageError(f"{folder}: {len(scan.images)} pictures, and no capture: {error}") from None
    return Evidence(scan, naming, frames, _find_rig(folder, scan, frames), sights)


def _require_lights(frames: Frames) -> None:
    lights = frames.ids("light")
    if len(lights) < _LEAST_LIGHTS:
        names = f" ({', '.join(lights)})" if lights else ""
        raise UsageError(
            f"by their names they are under {len(lights)} lights{names}, and {_LEAST_LIGHTS} are the least"
        )


def _require_sizes(sights: Mapping[str, Sight]) -> None:
    """A UsageError where no picture can be read, or a camera has no usual size."""
    if not any(sight.sizes for sight in sights.values()):
        raise UsageError(f"none of {sum(sight.unread for sight in sights.values())} looked at can be read")
    for camera, sight in sights.items():
        if sight.sizes and sight.sizes.most_common(1)[0][1] <= sight.sizes.total() / 2:
            of_camera = f" of camera {camera}" if camera else ""
            raise UsageError(
                f"{len(sight.sizes)} sizes among {sight.sizes.total()} of them{of_camera}; a camera has one"
            )


def _find_rig(folder: Path, scan: Scan, frames: Frames) -> Rig:
    """Directions from a list of lights, else from the lights' names."""
    lights, unused = frames.ids("light"), ""
    if scan.lists:
        name = scan.lists[0]
        stems = {PurePosixPath(path).stem: light for (_, _, light), path in frames.paths.items()}
        try:
            lamps = read_lamps(folder / name)
        except InputError as error:
            unused = str(error)
        else:
            if found := by_light(lamps, lights, stems):
                lengths = [lamp.length for lamp in lamps]
                return Rig(found, name, (min(lengths), max(lengths)))
            unused = f"{folder / name}: its {len(lamps)} lines name none of the {len(lights)} lights"
    named = {light: direction for light in lights if (direction := direction_in_name(light))}
    return Rig(named, unused=unused)


_SHOWN = 3
_UNIT_OFF = 0.01
_WANTED = {
    "direction": "a unit vector of the world, toward the lamp",
    "world_to_camera": "3 x 4 in metres, OpenCV's axes",
    "K": "in pixels",
    "width": "in pixels",
    "height": "in pixels",
}


def notes_on(evidence: Evidence, content: Mapping[str, Any]) -> list[str]:
    """What was found, what is to be filled in, what was assumed, and what was left out."""
    return [
        *_found(evidence),
        *(f"fill in: {note}" for note in _gaps(content)),
        *(f"check: {note}" for note in _assumed(evidence)),
        *(f"left out: {note}" for note in _left_out(evidence)),
    ]


def _found(evidence: Evidence) -> Iterator[str]:
    frames = evidence.frames
    counts = {field: len(frames.ids(field)) for field in FIELDS}
    words = ", ".join(counted(count, field) for field, count in counts.items())
    promised = counts["subject"] * counts["camera"] * counts["light"]
    missing = promised - len(frames.paths)
    there = f"{missing} of {promised} frames are not there" if missing else f"all {promised} frames are there"
    yield f"{evidence.naming.pattern}: {words}; {there}"


def _gaps(content: Mapping[str, Any]) -> Iterator[str]:
    """What is null: for lights and cameras how many."""
    for key, value in content.items():
        entries = value if isinstance(value, list) else ()
        for name in entries[0] if entries else ():
            if empty := [entry["id"] for entry in entries if entry[name] is None]:
                yield f"{name} of {len(empty)} of {counted(len(entries), key[:-1])} ({_WANTED[name]})"
    if content["colour_space"] is None:
        yield (
            "colour_space: the headers do not settle it; 'linear' where values are in proportion to light "
            "and of Rec.709's primaries, 'sRGB' where pictures were made to be looked at"
        )


def _assumed(evidence: Evidence) -> Iterator[str]:
    yield from _assumed_of_names(evidence)
    yield from _assumed_of_lights(evidence)
    for camera, sight in evidence.sights.items():
        if len(sight.sizes) > 1:
            sizes = ", ".join(f"{width} x {height}" for (width, height), _ in sight.sizes.most_common())
            yield f"cameras: pictures{f' of {camera}' * bool(camera)} have several sizes: {sizes}"
    if unread := sum(sight.unread for sight in evidence.sights.values()):
        seen = unread + sum(sight.sizes.total() for sight in evidence.sights.values())
        yield f"cameras: {unread} of {counted(seen, 'picture')} looked at cannot be read"
    yield "cameras: K is a guess, with a focal length of 4 times the longer side; calibrate them"
    if len(evidence.sights) == 1:
        yield "cameras: the one camera is the world: x to the picture's right, y up, z toward the camera"
    if nameless := sum(sight.nameless for sight in evidence.sights.values()):
        read = sum(sight.sizes.total() for sight in evidence.sights.values())
        yield (
            f"colour_space: {nameless} of {counted(read, 'header')} have primaries that no space known here "
            "has, so no name is right; write these pictures anew as linear Rec.709"
        )
    if evidence.colour_space:
        yield f"colour_space: {evidence.colour_space}, by the headers of some pictures"
    yield "black_level: 0 is assumed"
    if evidence.frames.ambient:
        yield f"ambient: {_some(evidence.frames.ambient)}; --subtract-ambient takes such pictures away"


def _assumed_of_names(evidence: Evidence) -> Iterator[str]:
    pattern, told = evidence.naming.pattern, evidence.naming.by_place
    possible = [f"{{{field}}}" for field in FIELDS if field in told or f"{{{field}}}" not in pattern]
    if told and len(possible) > 1:
        fields = " and ".join(f"{{{field}}}" for field in told)
        yield f"pattern: {fields} by place alone; it may be another of {', '.join(possible)}"
    for name in FIELDS:
        for group in alike(evidence.frames.ids(name)):
            yield f"{name}s: {' and '.join(group)} are two; rename the pictures where they are one"


def _assumed_of_lights(evidence: Evidence) -> Iterator[str]:
    rig = evidence.rig
    if rig.source:
        low, high = rig.lengths
        far = f"; its vectors are {low:.3g} to {high:.3g} long, and only where they point counts"
        far *= max(abs(low - 1), abs(high - 1)) > _UNIT_OFF
        yield f"lights: directions of {_some([rig.source])}, x right, y up, z toward the camera{far}"
    elif rig.directions:
        yield (
            "lights: directions by the angles in their names, azimuth > 0 to the picture's right; some count "
            "it the other way, as Extended Yale B does (which --layout extended-yale-b reads)"
        )
    if rig.directions and len(evidence.sights) > 1:
        yield "lights: their directions are taken for the world's; calibrate the cameras in its axes"
    yield "lights: the intensity 1 1 1 is assumed of each"


def _left_out(evidence: Evidence) -> Iterator[str]:
    scan, frames = evidence.scan, evidence.frames
    if frames.strays:
        yield f"{counted(len(frames.strays), 'picture')} that do not fit the pattern ({_some(frames.strays)})"
    if frames.unnameable:
        names = sorted(set(frames.unnameable))
        yield f"pictures whose ids are not of letters, digits, - and _ alone; rename them ({_some(names)})"
    if frames.full:
        all_on = counted(frames.full.total(), "picture")
        yield f"{all_on} with all lamps on ({_some(frames.full)}), which the checks look at"
    if evidence.rig.unused:
        yield f"a list of lights: {evidence.rig.unused}"
    if len(scan.lists) > 1:
        yield f"further lists of lights ({_some(scan.lists[1:])})"
    if scan.shut:
        yield f"{counted(len(scan.shut), 'folder')} that cannot be read ({_some(scan.shut)})"
    if scan.cut_short:
        yield f"what comes after the first {scan.entries} files; some lights and cameras may be missing here"


def _some(names: Sequence[str] | Mapping[str, int]) -> str:
    """The first few names, in characters that any terminal shows."""
    shown = [name if name.isprintable() else ascii(name) for name in list(names)[:_SHOWN]]
    return ", ".join([*shown, "..."] if len(names) > _SHOWN else shown)


_LONE_CAMERA, _LONE_SUBJECT = "C0", "subject"  # where neither names nor the folder have one


def draft_stage(folder: Path, suffixes: Collection[str]) -> dict[str, Any]:
    """The content of `stage.json`, its notes under "draft"; a UsageError where the folder is no capture."""
    evidence = look_into(folder, suffixes)
    content = _content(evidence, folder.resolve().name)
    return {"format": STAGE_FORMAT, "draft": notes_on(evidence, content), **content}


def _content(evidence: Evidence, folder_name: str) -> dict[str, Any]:
    frames, pattern = evidence.frames, evidence.naming.pattern
    alone = len(evidence.sights) == 1
    dark = frames.ambient.most_common(1)
    name = folder_name if is_name(folder_name) else _LONE_SUBJECT
    return {
        "colour_space": evidence.colour_space,
        "black_level": 0.0,
        "axes": "opencv",
        "unit": "m",
        "pattern": pattern,
        **({"ambient": pattern.replace("{light}", dark[0][0])} if dark else {}),
        "lights": [
            {"id": light, "direction": evidence.rig.directions.get(light), "intensity": [1.0, 1.0, 1.0]}
            for light in frames.ids("light")
        ],
        "cameras": [
            describe_camera(camera or _LONE_CAMERA, sight, alone) for camera, sight in evidence.sights.items()
        ],
        **({} if "{subject}" in pattern else {"subjects": {name: {}}}),
    }


def as_text(stage: Mapping[str, Any]) -> str:
    """JSON with a lamp, a camera and a note a line, for people to fill in."""
    lines = []
    for key, value in stage.items():
        if isinstance(value, list):
            entries = ",\n".join(f"  {json.dumps(entry, ensure_ascii=False)}" for entry in value)
            lines.append(f" {json.dumps(key)}: [\n{entries}\n ]")
        else:
            lines.append(f" {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"
