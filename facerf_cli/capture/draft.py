"""First draft of `stage.json` for a folder of images: what file names and headers say, null for the rest.

The entry "draft" lists what was found, what a person must fill in, and what to check.
"""

import json
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from facerf_cli.capture.draft_files import Frames, Scan, frames_by_depth, frames_by_pattern, scan_folder
from facerf_cli.capture.draft_lights import match_lights, read_light_list
from facerf_cli.capture.pattern import FIELDS
from facerf_cli.capture.stage_json import STAGE_FORMAT
from facerf_cli.colour import LINEAR, find_space
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.documents import is_name
from facerf_cli.files.image_metadata import Header, read_header
from facerf_cli.logs import counted

_LONE_CAMERA = "C0"  # id where the pattern has no {camera}
_LONE_SUBJECT = "subject"  # id where it has no {subject}, and the folder's name cannot be one
_LEAST_LIGHTS = 3  # fewer determine no normals
_HEADERS = 12  # read per camera, spread over the capture
_FOCAL = 4  # times the longer side: the crop camera's focal length, and about what stages use
_DISPLAY_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")  # with 8 bits a value, sRGB unless a profile says else
# A world that equals the camera's space (y up, z toward the camera), in OpenCV's axes (y down, z forward).
_FACING = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
_LISTED = 3  # names of a note
_WANTED = {
    "direction": "a unit vector in world space, toward the light",
    "world_to_camera": "3 x 4 in metres, OpenCV axes",
    "K": "in pixels",
    "width": "in pixels",
    "height": "in pixels",
}


@dataclass(frozen=True)
class CameraHeaders:
    """Counts of what the headers of a camera's images say."""

    sizes: Counter[tuple[int, int]]  # width and height
    spaces: Counter[str | None]  # None where the header does not name the colour space
    unread: int


def draft_stage(folder: Path, suffixes: Collection[str], pattern: str = "") -> dict[str, Any]:
    """Draft the content of `stage.json`, with notes under "draft".

    An empty `pattern` means the layout for the images' folder depth. UsageError for a folder without a
    capture.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; give the folder of a capture")
    scan, chosen = scan_folder(folder, suffixes), pattern
    if not scan.images:
        raise UsageError(f"{folder}: no images found (looked for {' '.join(sorted(suffixes))})")
    try:
        if pattern:
            frames = frames_by_pattern(scan.images, pattern)
        else:
            frames, chosen = frames_by_depth(scan.images)
        headers = {camera: _read_headers(folder, frames, camera) for camera in frames.ids("camera")}
        _require_capture(frames, headers)
    except UsageError as error:
        raise UsageError(f"{folder}: {error}") from None
    directions, about_list = _read_directions(folder, scan, frames)
    content = _content(folder, chosen, frames, headers, directions)
    notes = [
        _summary(chosen, frames),
        *(f"fill in: {note}" for note in _gaps(content)),
        *(["check: pattern: chosen by folder depth; --pattern gives another one"] if not pattern else []),
        *([about_list] if about_list else []),
        *(f"check: {note}" for note in _assumptions(headers, content)),
        *(f"left out: {note}" for note in _left_out(scan, frames)),
    ]
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


def _read_headers(folder: Path, frames: Frames, camera: str) -> CameraHeaders:
    paths = [folder / path for path in frames.of_camera(camera)]
    step = max(len(paths) // _HEADERS, 1)
    headers = [(path, read_header(path)) for path in paths[::step][:_HEADERS]]
    read = [(path, header) for path, header in headers if header is not None]
    return CameraHeaders(
        Counter((header.width_px, header.height_px) for _, header in read),
        Counter(_space_name(path, header) for path, header in read),
        len(headers) - len(read),
    )


def _space_name(path: Path, header: Header) -> str | None:
    """Colour space of a header as `stage.json` names it; None where it has no name or would be a guess."""
    if not header.is_floating and (header.bits > 8 or path.suffix.lower() not in _DISPLAY_SUFFIXES):
        return None
    if header.space == LINEAR:
        return "lin_rec709"
    return header.space.name if find_space(header.space.name) == header.space else None


def _require_capture(frames: Frames, headers: Mapping[str, CameraHeaders]) -> None:
    lights = frames.ids("light")
    if len(lights) < _LEAST_LIGHTS:
        names = f"{counted(len(lights), 'light')} ({', '.join(lights)})"
        raise UsageError(f"{names}, but a capture has {_LEAST_LIGHTS} or more; give its folder or --pattern")
    if not any(header.sizes for header in headers.values()):
        raise UsageError("the images cannot be read; check the files")


def _read_directions(folder: Path, scan: Scan, frames: Frames) -> tuple[dict[str, list[float]], str]:
    """Directions by light from the uppermost list of lights, and a note about the list."""
    if not scan.lists:
        return {}, ""
    lights, name = frames.ids("light"), scan.lists[0]
    stems = {PurePosixPath(path).stem: light for (_, _, light), path in frames.paths.items()}
    try:
        listed = read_light_list(folder / name)
    except InputError as error:
        return {}, f"left out: a list of lights: {error}"
    if found := match_lights(listed, lights, stems):
        axes = "x right, y up, z toward the camera, as world space"
        return found, f"check: lights: directions from {_list([name])}, {axes}"
    problem = f"its {len(listed)} lines name none of the {len(lights)} lights"
    return {}, f"left out: a list of lights: {folder / name}: {problem}"


def _content(
    folder: Path,
    pattern: str,
    frames: Frames,
    headers: Mapping[str, CameraHeaders],
    directions: Mapping[str, list[float]],
) -> dict[str, Any]:
    spaces = {space for header in headers.values() for space in header.spaces}
    ambient = frames.ambient.most_common(1)
    subject = name if is_name(name := folder.resolve().name) else _LONE_SUBJECT
    return {
        "colour_space": spaces.pop() if len(spaces) == 1 else None,
        "black_level": 0.0,
        "axes": "opencv",
        "unit": "m",
        "pattern": pattern,
        **({"ambient": pattern.replace("{light}", ambient[0][0])} if ambient else {}),
        "lights": [
            {"id": light, "direction": directions.get(light), "intensity": [1.0, 1.0, 1.0]}
            for light in frames.ids("light")
        ],
        "cameras": [_camera(name, header, len(headers) == 1) for name, header in headers.items()],
        **({} if "{subject}" in pattern else {"subjects": {subject: {}}}),
    }


def _camera(name: str, headers: CameraHeaders, alone: bool) -> dict[str, object]:
    """Entry of a camera with a guessed K; the space of a camera `alone` is the world."""
    width, height = headers.sizes.most_common(1)[0][0] if headers.sizes else (None, None)
    k = None
    if width and height:
        focal = float(_FOCAL * max(width, height))
        k = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
    pose = _FACING if alone else None
    return {"id": name or _LONE_CAMERA, "width": width, "height": height, "K": k, "world_to_camera": pose}


def _summary(pattern: str, frames: Frames) -> str:
    words = ", ".join(counted(len(frames.ids(field)), field) for field in FIELDS)
    missing, expected = frames.expected - len(frames.paths), frames.expected
    exist = f"{missing} of {expected} frames are missing" if missing else f"all {expected} frames exist"
    return f"{pattern}: {words}; {exist}"


def _gaps(content: Mapping[str, Any]) -> Iterator[str]:
    """Describe the null entries, counted by light and camera."""
    for key, value in content.items():
        entries = value if isinstance(value, list) else ()
        for name in entries[0] if entries else ():
            if empty := [entry["id"] for entry in entries if entry[name] is None]:
                yield f"{name} of {len(empty)} of {counted(len(entries), key[:-1])} ({_WANTED[name]})"
    if content["colour_space"] is None:
        yield (
            "colour_space: the headers do not name one; 'linear' for values in proportion to light with "
            "Rec.709 primaries, 'sRGB' for images with a display curve"
        )


def _assumptions(headers: Mapping[str, CameraHeaders], content: Mapping[str, Any]) -> Iterator[str]:
    yield "lights: the intensity 1 1 1 is assumed of each"
    for camera, header in headers.items():
        if len(header.sizes) > 1:
            sizes = ", ".join(f"{width} x {height}" for (width, height), _ in header.sizes.most_common())
            yield f"cameras: images{f' of {camera}' * bool(camera)} have several sizes: {sizes}"
    if unread := sum(header.unread for header in headers.values()):
        sampled = unread + sum(header.sizes.total() for header in headers.values())
        yield f"cameras: {unread} of {counted(sampled, 'image')} sampled cannot be read"
    yield "cameras: K is a guess, with a focal length of 4 times the longer side; calibrate them"
    if len(headers) == 1:
        yield "cameras: the space of the one camera is the world: x right, y up, z toward the camera"
    if space := content["colour_space"]:
        yield f"colour_space: {space}, from the headers of some images"
    yield "black_level: 0 is assumed"
    if "ambient" in content:
        yield f"ambient: {_list([content['ambient']])}; --subtract-ambient subtracts such images"


def _left_out(scan: Scan, frames: Frames) -> Iterator[str]:
    if frames.strays:
        yield f"{counted(len(frames.strays), 'image')} that do not match the pattern ({_list(frames.strays)})"
    if frames.unnameable:
        names = sorted(set(frames.unnameable))
        yield f"images with ids not of letters, digits, - and _ alone; rename them ({_list(names)})"
    if scan.unreadable:
        yield f"{counted(len(scan.unreadable), 'folder')} that cannot be read ({_list(scan.unreadable)})"


def _list(names: Sequence[str]) -> str:
    """The first names, escaped where a terminal cannot print them."""
    shown = [name if name.isprintable() else ascii(name) for name in names[:_LISTED]]
    return ", ".join([*shown, "..."] if len(names) > _LISTED else shown)
