"""The inputs of a command line as a sorted list of items, each with its place in the output folder.

Names of outputs may be patterns such as `{dir}/{stem}_{light}`, whose fields an input fills.
"""

import atexit
import glob
import logging
import math
import os
import re
import shutil
import sys
import tempfile
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
from facerf_cli.files.texts import LIMIT_BYTES
from facerf_cli.option import flag
from facerf_cli.run.logs import LOGGER_NAME, printable_line
from facerf_cli.run.stopping import clean_by

OF_PHOTOS = ("dir", "parent", "stem", "ext")
OF_FILES = (*OF_PHOTOS, "frame")
OF_IMAGES = (*OF_PHOTOS, "light", "frame")
_SEPARATORS = "._-"  # one of these before an empty field goes with it
_WIDTH = re.compile(r"0?[1-9]?")
_FRAME = re.compile(r"(.+?)((?:\.\d+)*)", re.DOTALL)  # a name, and the frame numbers that it ends in
PHOTO_SUFFIXES = frozenset(
    {".exr", ".hdr", ".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".tif", ".tiff", ".webp", ".jxl", ".heic"}
    | {".heif", ".avif", ".jp2", ".psd", ".tga", ".bmp", ".gif", ".dpx", ".cin", ".pgm", ".ppm"}
)
MAP_SUFFIXES = frozenset({".exr", ".hdr"})
_SUFFIXES_OF = {"--landmarks": (".json", ".pts"), "--normals-from": (".npy", ".exr", ".png")}
COMPANION = "FILE|DIR|PATTERN"  # the placeholder of options that name a file for each input
FILM_SUFFIXES = frozenset({".mp4", ".mov", ".webm", ".mkv", ".m4v", ".avi", ".mxf", ".mts", ".m2ts"})
_STACK, _SHEET = "_olat.exr", "_olat.png"  # the contact sheet of a stack is not a photo
_FRAMES = re.compile(r"(.*?)(\d+)-(\d+)(\.\w+)", re.DOTALL)  # plate.1001-1050.exr
_NUMBERED = re.compile(r"(.*?)(?:%0?(\d*)d|(#{2,}))([^/\\]*)", re.DOTALL)  # plate.%04d.exr, plate.####.exr
DOTTED = re.compile(r"(.+)\.(\d+)", re.DOTALL)  # a frame's name and number
_DIGITS = re.compile(r"(\d+)")
_MOST_FRAMES = 100_000
_MOST_NAMED = 8  # kinds of files, or folders, that a line names
_LONGEST_PATH = 4096  # characters
_START_BYTES, _SHOWN_BYTES = 4096, 40  # of standard input: what tells images, what a message shows
_LEAST_FOUND = 0.1  # share of a list's names; data that is no list may name the folders . and /
_MOST_IMAGE_BYTES = 1 << 30  # on standard input: the most pixels that are read, of four floats
_STARTS = {  # the first bytes of images, by suffix
    ".exr": rb"\x76\x2f\x31\x01",
    ".hdr": rb"#\?(RADIANCE|RGBE)",
    ".png": rb"\x89PNG",
    ".jpg": rb"\xff\xd8\xff",
    ".tif": rb"II[*+]\0|MM\0[*+]",
    ".webp": rb"RIFF.{4}WEBP",
    ".jxl": rb"\xff\x0a|\0\0\0\x0cJXL ",
    ".heic": rb".{4}ftyp(hei[cmsx]|hevc|mif1|msf1)",
    ".avif": rb".{4}ftypavi[fs]",
    ".jp2": rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51",
    ".psd": rb"8BPS\0",
    ".bmp": rb"BM.{4}\0{4}",
    ".gif": rb"GIF8[79]a",
    ".dpx": rb"SDPX\0\0|XPDS..\0\0",
    ".cin": rb"\x80\x2a\x5f\xd7|\xd7\x5f\x2a\x80",
    ".ppm": rb"P[2356Ff](\s+(#[^\n]*\n\s*)*-?[\d.]+){3}\s",
}

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
            found = [(literal, name, (spec or "") + (turn or "")) for literal, name, spec, turn in pieces]
        except ValueError as error:
            raise UsageError(f"{option} {text!r}: {error}; write fields as in {{stem}}") from None
        for _, name, spec in found:
            if name is not None and (name not in fields or not _fits(name, spec)):
                known = ", ".join(f"{{{field}}}" for field in fields)
                raise UsageError(f"{option} {text!r}: {{{name}}} is no field; give some of {known}")
        if text.startswith("/") or ".." in PurePosixPath(text).parts or not text.strip():
            raise UsageError(f"{option} {text!r}: give a path inside the output folder")
        return NamePattern(tuple(found))

    @staticmethod
    def literal(name: str) -> "NamePattern":
        """A pattern of one name, without fields."""
        return NamePattern(((name, None, ""),))

    def filled(self, values: dict[str, str]) -> str:
        """Fill the fields in; an empty one takes the separator before it along."""
        result = ""
        for literal, name, width in self.parts:
            result += literal
            value = values.get(name, "") if name else ""
            if name and not value and result[-1:] and result[-1] in _SEPARATORS:
                result = result[:-1]
            result += value.zfill(int(width)) if width and value else value
        return PurePosixPath(result.lstrip("/")).as_posix()


def file_pattern(text: str) -> NamePattern:
    """Parse the --name of a verb that writes files a photo."""
    return NamePattern.parse(text, "--name", OF_FILES)


def _fits(name: str, spec: str) -> bool:
    return not spec or (name == "frame" and _WIDTH.fullmatch(spec) is not None)


def fields_of(path: Path, mirrored: PurePosixPath) -> dict[str, str]:
    """The fields of an input: its folder in the output tree, its own folder, its name and its suffix."""
    stem, frame = split_frame(mirrored.with_suffix("").name)
    folder = "" if mirrored.parent == PurePosixPath() else mirrored.parent.as_posix()
    return {
        "dir": folder,
        "parent": path.absolute().parent.name,
        "stem": stem,
        "ext": path.suffix[1:].lower(),
        "frame": frame.rpartition(".")[2],
    }


@dataclass(frozen=True, order=True)
class Item:
    """One input, and its place in the output folder."""

    input_path: Path
    output_base: Path  # output folder / name: the outputs' common beginning
    name: str  # path in the output folder, without suffix; the item's identity there
    mirrored: PurePosixPath | None = None  # of a file: path in its input folder, or name alone
    stale: frozenset[Path] = field(default=frozenset(), compare=False)  # outputs to be made; empty: all
    kept: frozenset[Path] = field(default=frozenset(), compare=False)  # outputs that stay as they are
    key: str = field(default="", compare=False)  # of the one file of -o, for its metadata

    @property
    def is_file(self) -> bool:
        """True for a file that the user named or that was found in a folder of theirs."""
        return self.mirrored is not None

    @property
    def is_drawn(self) -> bool:
        """True for an item that is made from no file, such as a synthetic person."""
        return self.input_path == self.output_base

    def output(self, ending: str) -> Path:
        """An output of the item: `item.output("_relit.exr")`, or `item.output("/mesh.glb")` in a folder."""
        return Path(f"{self.output_base}{ending}")

    def filled(self, pattern: NamePattern, tag: str = "", **more: str) -> Path:
        """The path that a pattern gives to the item, in the output folder; `more` fields override its own.

        `tag` goes to the stem's end.
        """
        folder = self.output_base.parents[len(PurePosixPath(self.name).parts) - 1]
        return folder / self.pattern_text(pattern, tag, **more)

    def pattern_text(self, pattern: NamePattern, tag: str = "", **more: str) -> str:
        """A pattern filled with the item's fields; see `filled`."""
        own = fields_of(self.input_path, self.mirrored or PurePosixPath(self.input_path.name))
        own["stem"] += tag
        given = {name: value for name, value in more.items() if value}
        return pattern.filled(own | given)


def collect_items(
    inputs: Sequence[str],
    output_folder: Path,
    suffixes: frozenset[str] = PHOTO_SUFFIXES,
    pattern: NamePattern | None = None,
    null_separated: bool = False,
    sequence: bool = False,
) -> list[Item]:
    """List the files of the inputs, sorted, each once; UsageError if there are none.

    Folders are walked recursively for `suffixes`, and a file keeps the path that it has in its folder; a file
    that is named alone has its name only. So an item's place depends on no other input, and two that meet in
    one place are refused. `-` reads standard input. Hidden files and folders are left out, and so is an
    output folder inside an input folder. In a `sequence` images are named as frames: `shot_0001.png` as
    `shot.0001.png`.
    """
    output_real = os.path.realpath(output_folder)  # resolve() fails for links in a circle
    found: dict[Path, tuple[Path, PurePosixPath]] = {}  # absolute -> as the user would write it, mirrored
    for path in map(Path, expand_inputs(inputs, null_separated)):
        if not os.path.isdir(path):
            found.setdefault(Path(os.path.abspath(path)), (path, PurePosixPath(path.name)))
            continue
        if os.path.realpath(path) == output_real:
            raise UsageError(f"{path}: the output folder is an input folder; give another one with -o")
        for file in _walk(path, output_real, suffixes):
            absolute, mirrored = Path(os.path.abspath(file)), PurePosixPath(file.relative_to(path))
            if absolute not in found or len(mirrored.parts) > len(found[absolute][1].parts):
                found[absolute] = file, mirrored
    if not found:
        kinds = " ".join(sorted(suffixes))
        raise UsageError(f"{' '.join(inputs) or 'standard input'}: no inputs found (looked for {kinds})")
    items = []
    files = [found[absolute] for absolute in sorted(found)]
    for path, mirrored in _as_frames(files) if sequence else files:
        own = mirrored.with_suffix("").as_posix()
        name = pattern.filled(fields_of(path, mirrored)) if pattern else own
        items.append(Item(path, output_folder / name, name, mirrored=mirrored))
    _refuse_meeting(items, pattern)
    return items


def _as_frames(found: Sequence[tuple[Path, PurePosixPath]]) -> Iterator[tuple[Path, PurePosixPath]]:
    """Images with the names of frames: a name, a dot, and the number.

    That is what stands after the last dot, or the last number in which files differ whose names are alike
    but for numbers: `plate_v2_0001_beauty.exr` is `plate_v2_beauty.0001.exr`. A number alone is named by its
    folder.
    """
    alike: dict[tuple[object, ...], list[tuple[Path, PurePosixPath, list[str]]]] = {}
    for path, mirrored in found:
        parts = _DIGITS.split(mirrored.stem)
        alike.setdefault((mirrored.parent, *parts[::2]), []).append((path, mirrored, parts))
    for files in alike.values():
        columns = list(zip(*(parts[1::2] for *_, parts in files), strict=True))
        differ = [number for number, column in enumerate(columns) if len(set(column)) > 1]
        at = 2 * (differ or [len(columns) - 1])[-1] + 1
        for path, mirrored, parts in files:
            is_film = mirrored.suffix.lower() in FILM_SUFFIXES
            if not columns or is_film or DOTTED.fullmatch(mirrored.stem):
                yield path, mirrored
                continue
            before, after = "".join(parts[:at]), "".join(parts[at + 1 :])
            stem = (before.rstrip(_SEPARATORS + " ") + after).strip(_SEPARATORS + " ")
            stem = stem or path.absolute().parent.name
            yield path, mirrored.with_name(f"{stem}.{parts[at]}{mirrored.suffix}")


def _refuse_meeting(items: Sequence[Item], pattern: NamePattern | None) -> None:
    """Raise UsageError for two items with one name."""
    by_name: dict[str, Item] = {}
    for item in items:
        # Two forms of Unicode are one name in some file systems, and to the eye.
        other = by_name.setdefault(unicodedata.normalize("NFC", item.name), item)
        if other is not item:
            alike = "--name names them alike; give it more fields, such as {stem} and {ext}"
            by_path = (
                f"would both be written as {item.name}; rename one, name the folder that holds both, or "
                "give --name where the verb has it, such as '{dir}/{stem}_{ext}'"
            )
            raise UsageError(f"{other.input_path} and {item.input_path}: {alike if pattern else by_path}")


def check_case(outputs: Sequence[Path], folder: Path) -> None:
    """Raise UsageError for outputs that are one file where the file system ignores case; warn elsewhere."""
    by_name: dict[str, Path] = {}
    alike = [
        (other, path)
        for path in outputs
        if (other := by_name.setdefault(unicodedata.normalize("NFC", str(path)).casefold(), path)) != path
    ]
    if not alike:
        return
    first, second = alike[0]
    if _ignores_case(folder):
        raise UsageError(
            f"{first} and {second}: would be one file, since the file system ignores case; rename one input, "
            "or pass --name"
        )
    log.warning("%s and %s: differ only in case; on macOS and Windows they would be one file", first, second)


def _ignores_case(folder: Path) -> bool:
    """Tell whether the file system of a folder ignores case, by a name in it or in the next folder above."""
    above = folder.absolute()
    here = next(path for path in (above, *above.parents) if path.is_dir())
    for name in os.listdir(here):
        if (other := name.swapcase()) != name:
            return os.path.exists(here / other) and os.path.samefile(here / name, here / other)
    return False


def only_item(items: Sequence[Item], output: Path, several: bool) -> Item:
    """The one item whose output is the file that `-o` names; UsageError for several, or outputs of one."""
    item = items[0]
    if several or len(items) > 1 or item.input_path.suffix.lower() in FILM_SUFFIXES:
        raise UsageError(f"-o {output}: is one file; give one photo, face and light, or a folder")
    return replace(item, output_base=output.with_suffix(""), name=output.stem)


def refuse_read(outputs: Iterable[Path], read: Iterable[Path]) -> None:
    """Raise UsageError for an output that is a file to be read, by whatever link or spelling of its name."""
    planned = {_place(path): path for path in outputs}
    planned.pop(None, None)
    for path in read if planned else ():
        if (output := planned.get(_place(path))) is not None:
            raise UsageError(f"-o {output}: is the input {path}; give another name or folder")


def _place(path: Path) -> tuple[int, int] | None:
    """The place of a file on its disk, one for all of its names; None where there is no file."""
    try:
        state = os.stat(path)
    except (OSError, ValueError):  # ValueError: a name that no file can have
        return None
    return state.st_dev, state.st_ino


def files_read(given: Any, items: Sequence[Item]) -> Iterator[Path]:
    """Yield the items' files, and those that settings name; of a folder of companions those of the items."""
    if isinstance(given, Item):
        yield from [] if given.is_drawn else [given.input_path]
    elif isinstance(given, (list, tuple)):
        for one in given:
            yield from files_read(one, items)
    elif is_dataclass(given) and not isinstance(given, type):
        for part in fields(given):
            value, about = getattr(given, part.name), part.metadata.get("option")
            if about and about.metavar == COMPANION and value is not None:
                for item in items:
                    yield from filter(os.path.isfile, companions(item, value, flag(part.name)))
            else:
                yield from files_read(value, items)
    elif isinstance(given, (str, Path)) and os.path.isfile(given):
        yield Path(given)


def companions(item: Item, given: Path, option: str) -> list[Path]:
    """The places of the file of an option that goes with an item; it may be in any of several.

    A folder mirrors the items', or holds all files in one place; a pattern has fields, as in
    `mattes/{dir}/{stem}.png`. A name in Unicode's form NFC is the same in NFD.
    """
    if given.is_dir():
        suffixes = _SUFFIXES_OF.get(option, sorted(PHOTO_SUFFIXES))
        stem = item.input_path.stem  # of frames of a sequence, whose items have other names
        beside = PurePosixPath(item.name).with_name(stem).as_posix()
        names = [form for name in (item.name, beside, stem) for form in _forms(name)]
        return [given / f"{name}{suffix}" for name in dict.fromkeys(names) for suffix in suffixes]
    text = given.as_posix()
    if "{" not in text or given.exists():
        return [given]
    pattern = NamePattern.parse(text.lstrip("/"), option, OF_FILES)
    root = Path("/" if text.startswith("/") else "")
    return [root / form for form in _forms(item.pattern_text(pattern))]


def _forms(name: str) -> list[str]:
    """A name, and the other forms of Unicode in which a disk may hold it."""
    return list(dict.fromkeys((name, *(unicodedata.normalize(form, name) for form in ("NFC", "NFD")))))


def expand_inputs(inputs: Sequence[str], null_separated: bool = False) -> Iterator[str]:
    """Yield the inputs, with what standard input holds in place of `-`, and files in place of frames."""
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
    """True for the names of several files: `plate.%04d.exr`, `plate.####.exr`, `plate.1-9.exr`, `plate.*`."""
    return any(form.fullmatch(text) for form in (_FRAMES, _NUMBERED)) or glob.has_magic(text)


def numbered_images(text: str, output: Path) -> tuple[Path, ...]:
    """List the images of a folder or pattern by the numbers in their names; UsageError if one is missing."""
    found = [item.input_path for item in collect_items([text], output)]
    if missing := [path for path in found if not path.is_file()]:
        raise UsageError(f"{missing[0]}: no such file; check {text}")
    return tuple(sorted(found, key=lambda path: _DIGITS.sub(lambda digits: digits[0].zfill(20), str(path))))


def _from_stdin(null_separated: bool) -> list[str]:
    """List the names on standard input; or copy an image from there to a file, which goes with the process.

    The first bytes decide. Raises UsageError for other data, such as a video.
    """
    stream = sys.stdin.buffer
    content = stream.read(LIMIT_BYTES + 1)
    for suffix, start in _STARTS.items():
        if re.match(start, content[:_START_BYTES], re.DOTALL):
            folder = tempfile.mkdtemp(prefix="facerf-stdin-")
            remove = partial(shutil.rmtree, folder, ignore_errors=True)
            atexit.register(remove)
            clean_by(remove)
            path = Path(folder, "stdin", f"stdin{suffix}")  # {parent} is stdin
            path.parent.mkdir()
            with path.open("wb") as file:
                while content:
                    file.write(content)
                    if file.tell() > _MOST_IMAGE_BYTES:
                        raise UsageError("-: an image of more than 1 GiB; pass the file by its name")
                    content = stream.read(LIMIT_BYTES)
            return [str(path)]
    is_utf16 = re.match(rb"\xff\xfe.\0|\xfe\xff\0.", content, re.DOTALL)
    is_text = len(content) <= LIMIT_BYTES and not is_utf16 and (null_separated or b"\0" not in content)
    text = os.fsdecode(content).removeprefix("\ufeff") if is_text else "\0"
    names = text.split("\0") if null_separated else [one.rstrip("\r") for one in text.split("\n")]
    names = list(filter(None, names))
    if not is_text or sum(map(os.path.lexists, names)) < _LEAST_FOUND * len(names):
        raise UsageError(
            "-: standard input is neither an image nor a list of existing files in UTF-8 (it begins with "
            f"{content[:_SHOWN_BYTES]!r}); pass videos by name, and names that end in NUL with -0"
        )
    return names


def _range(entry: str, before: str, first: str, last: str, after: str) -> list[str]:
    """List the frames of `plate.1001-1050.exr`; raise InputError if a file does not exist."""
    if not int(first) <= int(last) < int(first) + _MOST_FRAMES:
        raise UsageError(f"{entry}: not a range of frames; give FIRST-LAST, at most {_MOST_FRAMES}")
    paths = [f"{before}{number:0{len(first)}}{after}" for number in range(int(first), int(last) + 1)]
    if missing := [path for path in paths if not os.path.exists(path)]:
        raise InputError(f"{missing[0]}: no such file; add it, or choose another range than {entry}")
    return paths


def _numbered(entry: str, before: str, digits: int, after: str) -> list[str]:
    """List the files of `plate.%04d.exr` by number; numbers of more digits begin with none of 0."""
    folder, begin = os.path.split(before)
    number = rf"(\d{{{digits}}}|[1-9]\d{{{digits},}})" if digits > 1 else r"(\d+)"
    form = re.compile(re.escape(begin) + number + re.escape(after))
    matches = (
        form.fullmatch(name) for name in (os.listdir(folder or ".") if os.path.isdir(folder or ".") else ())
    )
    frames = {Path(folder, match[0]): match[1] for match in matches if match}
    if not frames:
        raise UsageError(f"{entry}: no such files; check the pattern")
    return list(map(str, in_order(frames)))


def in_order(numbers: Mapping[Path, str]) -> list[Path]:
    """Sort frames by their numbers; raise InputError unless these have a constant step."""
    paths = sorted(numbers, key=lambda path: (int(numbers[path]), path))
    steps = [int(numbers[after]) - int(numbers[before]) for before, after in pairwise(paths)]
    step = math.gcd(*steps)
    for (before, after), found in zip(pairwise(paths), steps, strict=True):
        if found == 0:
            raise InputError(f"{before} and {after}: have the same frame number; remove one of them")
        if found > step:
            missing = f"{int(numbers[before]) + step:0{len(numbers[before])}}"
            raise InputError(
                f"{before}: the next frame, {missing}, is missing; add it, or choose frames of one step"
            )
    return paths


def _walk(folder: Path, output_real: str, suffixes: frozenset[str]) -> Iterator[Path]:
    """Yield the files to read; then say in a line what was passed over that is not hidden."""
    passed, linked = Counter[str](), list[str]()
    for here, folders, files in os.walk(folder):
        folders[:] = [
            name
            for name in folders
            if name[0] != "." and os.path.realpath(os.path.join(here, name)) != output_real
        ]
        linked += filter(os.path.islink, (os.path.join(here, name) for name in folders))
        for name in files:
            sheet = name.endswith(_SHEET) and name.removesuffix(_SHEET) + _STACK in files
            if name[0] == "." or sheet:
                continue
            suffix = Path(name).suffix.lower()
            if suffix in suffixes:
                yield Path(here) / name
            else:
                passed[suffix or "without suffix"] += 1
    _say_passed_over(folder, passed, sorted(linked))


def _say_passed_over(folder: Path, passed: Counter[str], linked: Sequence[str]) -> None:
    """Count files by suffix, and name linked folders, of which neither is read."""
    kinds = [f"{count} {suffix}" for suffix, count in passed.most_common(_MOST_NAMED)]
    more = len(linked) - _MOST_NAMED
    folders = [f"linked folder {path}" for path in linked[:_MOST_NAMED]]
    folders += [f"{more} more linked folders"] if more > 0 else []
    if kinds or folders:
        files = [f"{passed.total()} files ({', '.join(kinds)})"] if kinds else []
        said = printable_line(", ".join([*files, *folders]))
        log.info("%s: not read: %s; name a file itself to read it", folder, said)
