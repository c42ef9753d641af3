"""What a draft of `stage.json` tells the person who has to finish it, a line each."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from facerf_cli.records import counted
from facerf_cli.stage.data.patterns import FIELDS
from facerf_cli.stage.draft.evidence import Evidence
from facerf_cli.stage.draft.frames import alike

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
    for field in FIELDS:
        for group in alike(evidence.frames.ids(field)):
            yield f"{field}s: {' and '.join(group)} are two; rename the pictures where they are one"


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
