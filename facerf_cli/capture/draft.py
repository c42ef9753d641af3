"""First draft of `stage.json` for a folder of images: what file names and headers say, null for the rest.

The entry "draft" lists what was found, what a person must fill in, and what to check.

Directions or positions come from a list of lights next to the images (`light_lists.py`), cameras from the XML
of Metashape.
"""

import json
import logging
import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from facerf_cli.batch.inputs import PHOTO_SUFFIXES
from facerf_cli.capture.capture import FIELDS, compile_pattern, require_pattern, unlisted_kind
from facerf_cli.capture.light_lists import DraftLights, draft_lights, match_lights
from facerf_cli.capture.metashape import read_metashape
from facerf_cli.capture.stage_json import FACING, STAGE_FILE, STAGE_FORMAT
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import is_name
from facerf_cli.files.image_metadata import Header, read_header
from facerf_cli.files.texts import read_light_list
from facerf_cli.image.colour import LINEAR, find_space
from facerf_cli.run.logs import LOGGER_NAME, counted

log = logging.getLogger(LOGGER_NAME)
_LONE_CAMERA = "C0"  # id where the pattern has no {camera}
_LONE_SUBJECT = "subject"  # id where it has no {subject}, and the folder's name cannot be one
_LEAST_LIGHTS = 3  # fewer determine no normals
_HEADERS = 12  # read per camera, spread over the capture
_FOCAL = 4  # times the longer side: the crop camera's focal length, and about what stages use
# Formats with 8 bits a value, sRGB unless a profile says else.
_DISPLAY_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".avif")
_LISTED = 3  # names of a note
_WANTED = {
    "direction": "a unit vector in world space, toward the light",
    "world_to_camera": "3 x 4 in metres, OpenCV axes",
    "K": "in pixels",
    "width": "in pixels",
    "height": "in pixels",
}
# Files.
_DEEPEST = 8  # folders below the capture that are searched
_LIST_NAME = re.compile(r".*\.lp|light.*\.(txt|json)|.*\.xml", re.IGNORECASE)

Headers = dict[str, Header | None]  # by the paths of images
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

    @property
    def expected(self) -> int:
        """Number of frames if every camera has every subject under every light."""
        return len(self.ids("subject")) * len(self.ids("camera")) * len(self.ids("light"))


def describe_capture(folder: Path, pattern: str, output: Path | None, dry_run: bool) -> None:
    """Write a draft of stage.json to `output` or into the folder, and print its path and notes.

    UsageError where the file exists. A dry run prints the notes only.
    """
    path = folder / STAGE_FILE if output is None else output
    if path.is_dir() and not dry_run:
        raise UsageError(f"-o {path}: is a folder; give the draft's name, such as {path / STAGE_FILE}")
    if not dry_run and (path.exists() or path.is_symlink()):
        raise UsageError(
            f"{path}: is there already, and a draft replaces nothing; move it, or give -o another name"
        )
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
    calibrations = [path for path in lists if path.lower().endswith(".xml")]
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
        headers = {camera: _read_headers(folder, frames, camera) for camera in frames.ids("camera")}
        if not any(any(of_camera.values()) for of_camera in headers.values()):
            raise UsageError("the images cannot be read; check the files")
    except UsageError as error:
        raise UsageError(f"{folder}: {error}") from None
    lights, about_lights = _read_lights(folder, [one for one in lists if one not in calibrations], frames)
    cameras, about_cameras = _read_cameras(folder, calibrations, frames, lights.unit_m or 1.0)
    content = _content(folder, pattern, frames, headers, lights, cameras)
    words = ", ".join(counted(len(frames.ids(field)), field) for field in FIELDS)
    missing, expected = frames.expected - len(frames.paths), frames.expected
    exist = f"{missing} of {expected} frames are missing" if missing else f"all {expected} frames exist"
    notes = [
        f"{pattern}: {words}; {exist}",
        *(f"fill in: {note}" for note in _gaps(content)),
        *filter(None, (about_lights, about_cameras)),
        *(f"check: {note}" for note in _assumptions(headers, content, cameras)),
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


def _read_headers(folder: Path, frames: Frames, camera: str) -> Headers:
    """Headers of some of a camera's images, by their paths; None for what cannot be read."""
    paths = [path for (_, of_camera, _), path in frames.paths.items() if of_camera == camera]
    step = max(len(paths) // _HEADERS, 1)
    return {path: read_header(folder / path) for path in paths[::step][:_HEADERS]}


def _sizes(headers: Headers) -> list[tuple[int, int]]:
    """Widths and heights in headers, the most frequent one first."""
    sizes = Counter((header.width_px, header.height_px) for header in headers.values() if header)
    return [size for size, _ in sizes.most_common()]


def _space_name(path: str, header: Header) -> str | None:
    """Colour space of a header as `stage.json` names it; None where it has no name or would be a guess."""
    if not header.is_floating and (
        header.bits > 8 or PurePosixPath(path).suffix.lower() not in _DISPLAY_SUFFIXES
    ):
        return None
    if header.space == LINEAR:
        return "lin_rec709"
    return header.space.name if find_space(header.space.name) == header.space else None


def _read_lights(folder: Path, lists: Sequence[str], frames: Frames) -> tuple[DraftLights, str]:
    """Lights from the first list of lights, and a note about it."""
    if not lists:
        return DraftLights(), ""
    names, name = frames.ids("light"), lists[0]
    stems = {PurePosixPath(path).stem: light for (_, _, light), path in frames.paths.items()}
    try:
        listed = read_light_list(folder / name)
    except InputError as error:
        return DraftLights(), f"left out: a list of lights: {error}"
    if found := match_lights(listed, names, stems):
        lights = draft_lights(found, [vector for _, vector in listed])
        return lights, f"check: lights: {lights.kind} from {_list([name])}, {lights.assumed}"
    problem = f"its {len(listed)} lines name none of the {len(names)} lights"
    return DraftLights(), f"left out: a list of lights: {folder / name}: {problem}"


def _read_cameras(
    folder: Path, calibrations: Sequence[str], frames: Frames, unit_m: float
) -> tuple[dict[str, dict[str, Any]], str]:
    """Cameras of the images from Metashape's XML, and a note about it."""
    if not calibrations:
        return {}, ""
    try:
        known = read_metashape(folder / calibrations[0], unit_m)
    except InputError as error:
        return {}, f"left out: a calibration: {error}"
    found = {name: known[name] for name in frames.ids("camera") if name in known}
    if not found:
        return {}, f"left out: a calibration: {folder / calibrations[0]}: has no camera of the images' names"
    unit = "a metre" if unit_m == 1 else "that of the lights"
    return found, f"check: cameras: from {_list(calibrations[:1])}, whose unit is taken as {unit}"


def _content(
    folder: Path,
    pattern: str,
    frames: Frames,
    headers: Mapping[str, Headers],
    lights: DraftLights,
    cameras: Mapping[str, dict[str, Any]],
) -> dict[str, Any]:
    """The entries of stage.json."""
    read = ((path, header) for of_camera in headers.values() for path, header in of_camera.items() if header)
    spaces = {_space_name(path, header) for path, header in read}
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
            {"id": light, **lights.entries.get(light, {"direction": None}), "intensity": [1.0, 1.0, 1.0]}
            for light in frames.ids("light")
        ],
        **({} if lights.centre_m is None else {"centre": lights.centre_m}),
        "cameras": [
            cameras.get(name) or _camera(name, _sizes(of), len(headers) == 1) for name, of in headers.items()
        ],
        **({} if "{subject}" in pattern else {"subjects": {subject: {}}}),
    }


def _camera(name: str, sizes: list[tuple[int, int]], alone: bool) -> dict[str, object]:
    """Entry of a camera with a guessed K; the space of a camera `alone` is the world."""
    entry: dict[str, object] = {"id": name or _LONE_CAMERA, "width": None, "height": None, "K": None}
    if sizes:
        width, height = sizes[0]
        focal = float(_FOCAL * max(width, height))
        k = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
        entry |= {"width": width, "height": height, "K": k}
    return entry | {"world_to_camera": FACING if alone else None}


def _gaps(content: Mapping[str, Any]) -> Iterator[str]:
    """Describe the null entries, counted by light and camera."""
    for key, value in content.items():
        entries = value if isinstance(value, list) else ()
        for name in dict.fromkeys(name for entry in entries if isinstance(entry, dict) for name in entry):
            if empty := [entry["id"] for entry in entries if entry.get(name, 0) is None]:
                yield f"{name} of {len(empty)} of {counted(len(entries), key[:-1])} ({_WANTED[name]})"
    if content["colour_space"] is None:
        yield (
            "colour_space: the headers do not name one; 'linear' for values in proportion to light with "
            "Rec.709 primaries, 'sRGB' for images with a display curve"
        )


def _assumptions(
    headers: Mapping[str, Headers], content: Mapping[str, Any], calibrated: Collection[str]
) -> Iterator[str]:
    yield "lights: the intensity 1 1 1 is assumed of each"
    for camera, of_camera in headers.items():
        if len(sizes := _sizes(of_camera)) > 1:
            words = ", ".join(f"{width} x {height}" for width, height in sizes)
            yield f"cameras: images{f' of {camera}' * bool(camera)} have several sizes: {words}"
    sampled = [header for of_camera in headers.values() for header in of_camera.values()]
    if unread := sampled.count(None):
        yield f"cameras: {unread} of {counted(len(sampled), 'image')} sampled cannot be read"
    if len(calibrated) < len(headers):
        yield "cameras: K is a guess, with a focal length of 4 times the longer side; calibrate them"
    if len(headers) == 1 and not calibrated:
        yield "cameras: the space of the one camera is the world: x right, y up, z toward the camera"
    if space := content["colour_space"]:
        yield f"colour_space: {space}, from the headers of some images"
    yield "black_level: 0 is assumed"
    if "ambient" in content:
        yield f"ambient: {_list([content['ambient']])}; --subtract-ambient subtracts such images"


def _list(names: Sequence[str]) -> str:
    """The first names, escaped where a terminal cannot print them."""
    words = [name if name.isprintable() else ascii(name) for name in names[:_LISTED]]
    return ", ".join([*words, "..."] if len(names) > _LISTED else words)


def scan_folder(folder: Path, suffixes: Collection[str]) -> tuple[list[str], list[str]]:
    """Find images with these suffixes, and lists of lights and calibrations, the uppermost first.

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


def sort_frames(paths: Iterable[str], pattern: str) -> Frames:
    """Sort images into frames, ambient images and strays; images with all lights on are skipped."""
    frames, expression = Frames({}, Counter(), []), compile_pattern(pattern)
    for path in sorted(paths):
        match = expression.fullmatch(path)
        named = match.groupdict() if match else {}
        if named and (kind := unlisted_kind(named["light"])):
            frames.ambient.update([named["light"]] if kind == "ambient" else [])
        elif not named or not all(map(is_name, named.values())):
            frames.strays.append(path)
        else:
            frames.paths[named.get("subject", ""), named.get("camera", ""), named["light"]] = path
    return frames


def _natural_order(text: str) -> list[str | int]:
    pieces = re.split("([0-9]+)", text)  # every second one is a number
    return [int(piece) if place % 2 else piece for place, piece in enumerate(pieces)] + [text]


def frames_by_pattern(images: Sequence[str], pattern: str) -> Frames:
    """Sort images by the pattern of --pattern; UsageError for a wrong one, or one that no image matches."""
    try:
        frames = sort_frames(images, require_pattern(pattern, "--pattern", ["light"]))
    except InputError as error:
        raise UsageError(str(error)) from None
    if not frames.paths:
        raise UsageError(f"--pattern {pattern}: no image matches, not even {images[0]}; correct the pattern")
    return frames


def example_pattern(path: str) -> str:
    """Guess what the parts of an image's path are: its name the light, its folders subject and camera."""
    *folders, _ = path.split("/")
    fields = ["{subject}", "{camera}"][: len(folders)]
    above = folders[: len(folders) - len(fields)]
    return "/".join([*above, *fields, "{light}" + PurePosixPath(path).suffix])
