"""Inputs of a command line as a sorted list of items, each with its path in the output folder.

Names of outputs may be patterns such as `{dir}/{stem}_{light}`, whose fields are filled from an input.
"""

import atexit
import glob
import logging
import math
import os
import re
import shutil
import sys
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path, PurePosixPath
from string import Formatter
from typing import Any

from facerf_cli.errors import InputError, UsageError
from facerf_cli.option import flag
from facerf_cli.run.logs import LOGGER_NAME, printable_line
from facerf_cli.run.stopping import clean_by

OF_FILES = ("dir", "parent", "stem", "ext", "frame")
OF_IMAGES = (*OF_FILES, "light")
_SEPARATORS = "._-"  # an empty field removes one of these in front of it
_WIDTH = re.compile(r"0?[1-9]?")
_FRAME = re.compile(r"(.+?)((?:\.\d+)*)", re.DOTALL)  # a name, and the frame numbers that it ends in
PHOTO_SUFFIXES = frozenset(
    {".exr", ".hdr", ".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".tif", ".tiff", ".webp", ".jxl", ".heic"}
    | {".heif", ".avif", ".jp2", ".psd", ".tga", ".bmp", ".gif", ".dpx", ".cin", ".pgm", ".ppm"}
)
MAP_SUFFIXES = frozenset({".exr", ".hdr"})
_SUFFIXES_OF = {"--landmarks": (".json", ".pts"), "--normals-from": (".npy", ".exr", ".png")}
COMPANION = "FILE|DIR|PATTERN"  # placeholder of options that name a file for each input
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".webm", ".mkv", ".m4v", ".avi", ".mxf", ".mts", ".m2ts"})
_STACK, _SHEET = "_olat.exr", "_olat.png"  # a stack's contact sheet is not a photo
_FRAMES = re.compile(r"(.*?)(\d+)-(\d+)(\.\w+)", re.DOTALL)  # plate.1001-1050.exr
_NUMBERED = re.compile(r"(.*?)(?:%0?(\d*)d|(#{2,}))([^/\\]*)", re.DOTALL)  # plate.%04d.exr, plate.####.exr
DOTTED = re.compile(r"(.+)\.(\d+)", re.DOTALL)  # a frame's name and number
_DIGITS = re.compile(r"(\d+)")
_MOST_FRAMES = 100_000
_MOST_NAMED = 8  # suffixes or folders in a log line
_LONGEST_PATH = 4096  # characters
_START_BYTES, _QUOTED_BYTES = 4096, 40  # of standard input: searched for names, and quoted in a message
_LEAST_EXISTING = 0.1  # fraction of a list's names; other data may contain the folders . and /
_MOST_LIST_BYTES = 64 << 20  # on standard input
_MOST_IMAGE_BYTES = 1 << 30  # on standard input: the most pixels that are read, of four floats
_IMAGE = re.compile(rb"P[1-7Ff]\s|.*?[\x01-\x08\x0b\x0c\x0e-\x1f]", re.DOTALL)  # or other binary data
_EXR = b"\x76\x2f\x31\x01"

log = logging.getLogger(LOGGER_NAME)


def split_frame(name: str) -> tuple[str, str]:
    """Split 'sky.0001' into 'sky' and '.0001'."""
    match = _FRAME.fullmatch(name)
    return (match[1], match[2]) if match else (name, "")


@dataclass(frozen=True)
class NamePattern:
    """A pattern of output paths without suffix; fields in braces, `{frame:04}` with leading zeros."""

    parts: tuple[tuple[str, str | None, str], ...]  # text, the field that follows it, and its width

    @staticmethod
    def parse(text: str, option: str, fields: tuple[str, ...] = OF_IMAGES) -> "NamePattern":
        """Parse a pattern; raises UsageError for unknown fields, and for paths out of the folder."""
        try:
            pieces = Formatter().parse(text)
            parts = [(literal, name, (spec or "") + (turn or "")) for literal, name, spec, turn in pieces]
        except ValueError as error:
            raise UsageError(f"{option} {text!r}: {error}; write fields as in {{stem}}") from None
        for _, name, spec in parts:
            fits = not spec or (name == "frame" and _WIDTH.fullmatch(spec))
            if name is not None and (name not in fields or not fits):
                known = ", ".join(f"{{{field}}}" for field in fields)
                raise UsageError(f"{option} {text!r}: unknown field {{{name}}}; use fields of {known}")
        if text.startswith("/") or ".." in PurePosixPath(text).parts or not text.strip():
            raise UsageError(f"{option} {text!r}: not inside the output folder; use a relative path")
        return NamePattern(tuple(parts))

    @staticmethod
    def literal(name: str) -> "NamePattern":
        """Make a pattern of one name, without fields."""
        return NamePattern(((name, None, ""),))

    def filled(self, values: dict[str, str]) -> str:
        """Fill in the fields; an empty field also removes the separator in front of it."""
        result = ""
        for literal, name, width in self.parts:
            result += literal
            value = values.get(name, "") if name else ""
            if name and not value and result[-1:] and result[-1] in _SEPARATORS:
                result = result[:-1]
            result += value.zfill(int(width)) if width and value else value
        return PurePosixPath(result.lstrip("/")).as_posix()


def fields_of(path: Path, mirrored: PurePosixPath) -> dict[str, str]:
    """Return the fields of an input: its folder in the output tree, its own folder, name and suffix."""
    stem, frame = split_frame(mirrored.with_suffix("").name)
    return {
        "dir": "" if mirrored.parent == PurePosixPath() else mirrored.parent.as_posix(),
        "parent": path.absolute().parent.name,
        "stem": stem,
        "ext": path.suffix[1:].lower(),
        "frame": frame.rpartition(".")[2],
    }


@dataclass(frozen=True, order=True)
class Item:
    """One input, and its path in the output folder.

    Attributes:
        input_path: Path of the input.
        output_base: Output folder / name, the common beginning of its outputs.
        name: Path in the output folder, without suffix, which identifies the item there.
        mirrored: Path of a file in its input folder, or its name only; None if the item is no file.
        stale: Outputs that must be made; if empty, all.
        kept: Outputs that stay as they are.
        key: Key of the single file of `-o`, for its metadata.
    """

    input_path: Path
    output_base: Path
    name: str
    mirrored: PurePosixPath | None = None
    stale: frozenset[Path] = field(default=frozenset(), compare=False)
    kept: frozenset[Path] = field(default=frozenset(), compare=False)
    key: str = field(default="", compare=False)

    @property
    def is_file(self) -> bool:
        """True for a file that the user named, or that is in a folder that they named."""
        return self.mirrored is not None

    @property
    def is_drawn(self) -> bool:
        """True for an item that is made from no file, such as a synthetic person."""
        return self.input_path == self.output_base

    def output(self, ending: str) -> Path:
        """Return an output: `item.output("_relit.exr")`, or `item.output("/mesh.glb")` in a folder."""
        return Path(f"{self.output_base}{ending}")

    def filled(self, pattern: NamePattern, tag: str = "", **more: str) -> Path:
        """Return the item's path by a pattern, in the output folder; see `pattern_text`."""
        folder = self.output_base.parents[len(PurePosixPath(self.name).parts) - 1]
        return folder / self.pattern_text(pattern, tag, **more)

    def pattern_text(self, pattern: NamePattern, tag: str = "", **more: str) -> str:
        """Fill a pattern with the item's fields; `tag` is added to the stem, `more` replaces fields."""
        values = fields_of(self.input_path, self.mirrored or PurePosixPath(self.input_path.name))
        values["stem"] += tag
        return pattern.filled(values | {name: value for name, value in more.items() if value})


def collect_items(
    inputs: Sequence[str],
    output_folder: Path,
    suffixes: frozenset[str] = PHOTO_SUFFIXES,
    pattern: NamePattern | None = None,
    null_separated: bool = False,
    sequence: bool = False,
) -> list[Item]:
    """List the files of the inputs, sorted, without duplicates; UsageError if there are none.

    Folders are searched recursively for `suffixes`, and a file keeps its path within its folder; a file that
    is named itself keeps only its name. So an item's path depends on no other input, and two items with the
    same path are rejected. `-` reads standard input. Hidden files and folders are ignored, and so is an
    output folder inside an input folder. In a `sequence` images are named as frames: `shot_0001.png` as
    `shot.0001.png`.
    """
    output_real = os.path.realpath(output_folder)  # resolve() fails for links in a circle
    by_path: dict[Path, tuple[Path, PurePosixPath]] = {}  # absolute -> as the user would write it, mirrored
    for path in map(Path, expand_inputs(inputs, null_separated)):
        if not os.path.isdir(path):
            by_path.setdefault(Path(os.path.abspath(path)), (path, PurePosixPath(path.name)))
            continue
        if os.path.realpath(path) == output_real:
            raise UsageError(f"{path}: the output folder is an input folder; use another one with -o")
        for file in _walk(path, output_real, suffixes):
            absolute, mirrored = Path(os.path.abspath(file)), PurePosixPath(file.relative_to(path))
            if absolute not in by_path or len(mirrored.parts) > len(by_path[absolute][1].parts):
                by_path[absolute] = file, mirrored
    if not by_path:
        kinds = " ".join(sorted(suffixes))
        raise UsageError(f"{' '.join(inputs) or 'standard input'}: no inputs found (looked for {kinds})")
    files = [by_path[absolute] for absolute in sorted(by_path)]
    by_name: dict[str, Item] = {}
    for path, mirrored in _as_frames(files) if sequence else files:
        plain = mirrored.with_suffix("").as_posix()
        name = pattern.filled(fields_of(path, mirrored)) if pattern else plain
        item = Item(path, output_folder / name, name, mirrored=mirrored)
        # Two forms of Unicode are one name in some file systems, and to the eye.
        if (other := by_name.setdefault(unicodedata.normalize("NFC", name), item)) is not item:
            advice = (
                "--name names them alike; use more fields, such as {stem} and {ext}"
                if pattern
                else f"would both be written as {name}; rename one, pass the folder that contains both, or "
                "use --name if the command has it, such as '{dir}/{stem}_{ext}'"
            )
            raise UsageError(f"{other.input_path} and {path}: {advice}")
    return list(by_name.values())


def _as_frames(files: Sequence[tuple[Path, PurePosixPath]]) -> Iterator[tuple[Path, PurePosixPath]]:
    """Yield images with names of frames: a name, a dot and the number.

    The number follows the last dot, or is the last number that differs between files whose names differ only
    in numbers: `plate_v2_0001_beauty.exr` becomes `plate_v2_beauty.0001.exr`. A name that is only a number
    takes the name of its folder.
    """
    alike: dict[tuple[object, ...], list[tuple[Path, PurePosixPath, list[str]]]] = {}
    for path, mirrored in files:
        parts = _DIGITS.split(mirrored.stem)
        alike.setdefault((mirrored.parent, *parts[::2]), []).append((path, mirrored, parts))
    for group in alike.values():
        columns = list(zip(*(parts[1::2] for *_, parts in group), strict=True))
        differ = [number for number, column in enumerate(columns) if len(set(column)) > 1]
        at = 2 * (differ or [len(columns) - 1])[-1] + 1
        for path, mirrored, parts in group:
            is_video = mirrored.suffix.lower() in VIDEO_SUFFIXES
            if not columns or is_video or DOTTED.fullmatch(mirrored.stem):
                yield path, mirrored
                continue
            before, after = "".join(parts[:at]), "".join(parts[at + 1 :])
            stem = (before.rstrip(_SEPARATORS + " ") + after).strip(_SEPARATORS + " ")
            stem = stem or path.absolute().parent.name
            yield path, mirrored.with_name(f"{stem}.{parts[at]}{mirrored.suffix}")


def check_case(outputs: Iterable[Path]) -> None:
    """Raise UsageError for outputs that are one file where the file system ignores case."""
    by_name: dict[str, Path] = {}
    for path in outputs:
        if (other := by_name.setdefault(str(path).casefold(), path)) != path:
            raise UsageError(
                f"{other} and {path}: would be one file, since the file system ignores case; rename one "
                "input, or pass --name"
            )


def only_item(items: Sequence[Item], output: Path, several: bool) -> Item:
    """Return the item whose only output is the file that `-o` names; UsageError for several outputs."""
    item = items[0]
    if several or len(items) > 1 or item.input_path.suffix.lower() in VIDEO_SUFFIXES:
        raise UsageError(f"-o {output}: is a single file, but several images would be written; use a folder")
    return replace(item, output_base=output.with_suffix(""), name=output.stem)


def refuse_read(outputs: Iterable[Path], read: Iterable[Path]) -> None:
    """Raise UsageError for an output that is a file to be read, by any link or spelling of its name."""
    planned = {_inode(path): path for path in outputs}
    planned.pop(None, None)
    for path in read if planned else ():
        if (output := planned.get(_inode(path))) is not None:
            raise UsageError(f"-o {output}: is the input {path}; use another name or folder")


def _inode(path: Path) -> tuple[int, int] | None:
    """Return what all names of a file share: its device and inode; None if it does not exist."""
    try:
        state = os.stat(path)
    except (OSError, ValueError):  # ValueError: a name that no file can have
        return None
    return state.st_dev, state.st_ino


def files_read(value: Any, items: Sequence[Item]) -> Iterator[Path]:
    """Yield the files of items, and those that settings name; of a folder of companions the items' files."""
    if isinstance(value, Item):
        yield from [] if value.is_drawn else [value.input_path]
    elif isinstance(value, (list, tuple)):
        for entry in value:
            yield from files_read(entry, items)
    elif is_dataclass(value) and not isinstance(value, type):
        for part in fields(value):
            entry, about = getattr(value, part.name), part.metadata.get("option")
            if about and about.metavar == COMPANION and entry is not None:
                for item in items:
                    yield from filter(os.path.isfile, companions(item, entry, flag(part.name)))
            else:
                yield from files_read(entry, items)
    elif isinstance(value, (str, Path)) and os.path.isfile(value):
        yield Path(value)


def companions(item: Item, value: Path, option: str) -> list[Path]:
    """Return the paths where an item's file of an option may be.

    A folder mirrors the items' folder, or has all files at its top; a pattern has fields, as in
    `mattes/{dir}/{stem}.png`. A name in Unicode's form NFC also matches the name in NFD.
    """
    if value.is_dir():
        suffixes = _SUFFIXES_OF.get(option, sorted(PHOTO_SUFFIXES))
        stem = item.input_path.stem  # frames of a sequence have items of other names
        beside = PurePosixPath(item.name).with_name(stem).as_posix()
        names = dict.fromkeys(form for name in (item.name, beside, stem) for form in _forms(name))
        return [value / f"{name}{suffix}" for name in names for suffix in suffixes]
    text = value.as_posix()
    if "{" not in text or value.exists():
        return [value]
    pattern = NamePattern.parse(text.lstrip("/"), option, OF_FILES)
    root = Path("/" if text.startswith("/") else "")
    return [root / form for form in _forms(item.pattern_text(pattern))]


def _forms(name: str) -> list[str]:
    """Return a name, and its other forms in Unicode that a disk may have."""
    return list(dict.fromkeys((name, *(unicodedata.normalize(form, name) for form in ("NFC", "NFD")))))


def expand_inputs(inputs: Sequence[str], null_separated: bool = False) -> Iterator[str]:
    """Yield the inputs, with the names on standard input for `-`, and the files of patterns of frames."""
    for entry in inputs:
        if entry == "-":
            yield from _from_stdin(null_separated)
        elif os.path.exists(entry) or len(entry) > _LONGEST_PATH:
            yield entry
        elif frames := _FRAMES.fullmatch(entry):
            yield from _range(entry, *frames.groups())
        elif numbered := _NUMBERED.fullmatch(entry):
            before, digits, marks, after = numbered.groups()
            yield from _numbered(entry, before, int(digits or len(marks or "")), after)
        else:
            yield from sorted(glob.glob(entry)) or [entry]


def is_pattern(text: str) -> bool:
    """Tell whether a text names several files: `plate.%04d.exr`, `plate.####.exr`, `plate.*`."""
    return any(form.fullmatch(text) for form in (_FRAMES, _NUMBERED)) or glob.has_magic(text)


def numbered_images(text: str, output: Path) -> tuple[Path, ...]:
    """List the images of a folder or pattern by the numbers in their names; UsageError if one is missing."""
    paths = [item.input_path for item in collect_items([text], output)]
    if missing := [path for path in paths if not path.is_file()]:
        raise UsageError(f"{missing[0]}: no such file; check {text}")
    return tuple(sorted(paths, key=lambda path: _DIGITS.sub(lambda digits: digits[0].zfill(20), str(path))))


def _from_stdin(null_separated: bool) -> list[str]:
    """List the names on standard input, if some of the first exist; or copy an image to a temporary file.

    Readers recognise the image by its content. Raises UsageError for other text.
    """
    import tempfile  # --help does without it

    def names_in(data: bytes) -> list[str]:
        text = os.fsdecode(data).removeprefix("\ufeff")
        names = text.split("\0") if null_separated else [line.rstrip("\r") for line in text.split("\n")]
        return list(filter(None, names))

    stream = sys.stdin.buffer
    content = stream.read(_MOST_LIST_BYTES + 1)
    first = names_in(content[:_START_BYTES])
    is_utf16 = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    is_list = not is_utf16 and sum(map(os.path.lexists, first)) >= _LEAST_EXISTING * len(first)
    if is_list and len(content) <= _MOST_LIST_BYTES:
        return names_in(content)
    if is_list or not _IMAGE.match(content):
        raise UsageError(
            "-: standard input is neither an image nor a list of existing files in UTF-8 (it begins with "
            f"{content[:_QUOTED_BYTES]!r}); pass videos by name, and names that end in NUL with -0"
        )
    folder = tempfile.mkdtemp(prefix="facerf-stdin-")
    remove = partial(shutil.rmtree, folder, ignore_errors=True)
    atexit.register(remove)
    clean_by(remove)
    # The fields {parent} and {stem} are stdin. OLAT stacks are recognised by their suffix.
    path = Path(folder, "stdin", "stdin.exr" if content.startswith(_EXR) else "stdin")
    path.parent.mkdir()
    with path.open("wb") as file:
        while content:
            file.write(content)
            if file.tell() > _MOST_IMAGE_BYTES:
                raise UsageError("-: an image of more than 1 GiB; pass the file by its name")
            content = stream.read(_MOST_LIST_BYTES)
    return [str(path)]


def _range(entry: str, before: str, first: str, last: str, after: str) -> list[str]:
    """List the frames of `plate.1001-1050.exr`; raise InputError if a file does not exist."""
    if not int(first) <= int(last) < int(first) + _MOST_FRAMES:
        raise UsageError(f"{entry}: not a range of frames; use FIRST-LAST, at most {_MOST_FRAMES} frames")
    paths = [f"{before}{number:0{len(first)}}{after}" for number in range(int(first), int(last) + 1)]
    if missing := [path for path in paths if not os.path.exists(path)]:
        raise InputError(f"{missing[0]}: no such file; add it, or choose another range than {entry}")
    return paths


def _numbered(entry: str, before: str, digits: int, after: str) -> list[str]:
    """List the files of `plate.%04d.exr` by number; longer numbers do not begin with 0."""
    folder, begin = os.path.split(before)
    number = rf"(\d{{{digits}}}|[1-9]\d{{{digits},}})" if digits > 1 else r"(\d+)"
    form = re.compile(re.escape(begin) + number + re.escape(after))
    names = os.listdir(folder or ".") if os.path.isdir(folder or ".") else []
    frames = {Path(folder, match[0]): match[1] for match in map(form.fullmatch, names) if match}
    if not frames:
        raise UsageError(f"{entry}: no such files; check the pattern")
    return list(map(str, in_order(frames)))


def in_order(numbers: Mapping[Path, str]) -> list[Path]:
    """Sort frames by their numbers; raise InputError unless these have a constant step."""
    paths = sorted(numbers, key=lambda path: (int(numbers[path]), path))
    steps = [int(numbers[after]) - int(numbers[before]) for before, after in pairwise(paths)]
    for (before, after), step in zip(pairwise(paths), steps, strict=True):
        if step == 0:
            raise InputError(f"{before} and {after}: have the same frame number; remove one of them")
        if step > math.gcd(*steps):
            missing = f"{int(numbers[before]) + math.gcd(*steps):0{len(numbers[before])}}"
            raise InputError(
                f"{before}: the next frame, {missing}, is missing; add it, or choose frames of one step"
            )
    return paths


def _walk(folder: Path, output_real: str, suffixes: frozenset[str]) -> Iterator[Path]:
    """Yield the files to read; then log which files and linked folders were not read."""
    unread, links = Counter[str](), list[str]()
    for here, folders, files in os.walk(folder):
        folders[:] = [
            name
            for name in folders
            if name[0] != "." and os.path.realpath(os.path.join(here, name)) != output_real
        ]
        links += filter(os.path.islink, (os.path.join(here, name) for name in folders))
        for name in files:
            is_sheet = name.endswith(_SHEET) and name.removesuffix(_SHEET) + _STACK in files
            suffix = Path(name).suffix.lower()
            if name[0] == "." or is_sheet:
                continue
            if suffix in suffixes:
                yield Path(here) / name
            else:
                unread[suffix or "without suffix"] += 1
    kinds = ", ".join(f"{count} {suffix}" for suffix, count in unread.most_common(_MOST_NAMED))
    parts = [f"{unread.total()} files ({kinds})"] if unread else []
    parts += [f"linked folder {path}" for path in sorted(links)[:_MOST_NAMED]]
    if len(links) > _MOST_NAMED:
        parts.append(f"{len(links) - _MOST_NAMED} more linked folders")
    if parts:
        log.info("%s: not read: %s; name a file itself to read it", folder, printable_line(", ".join(parts)))
