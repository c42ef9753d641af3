"""The inputs of a command line as a sorted list of items, each with its place in the output folder."""

import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from facerf_cli.batch.naming import NamePattern, fields_of
from facerf_cli.errors import UsageError

PHOTO_SUFFIXES = frozenset(
    {".exr", ".hdr", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".jxl", ".heic", ".heif", ".jp2"}
    | {".psd", ".tga", ".dpx", ".cin", ".pgm", ".ppm"}
)
FILM_SUFFIXES = frozenset({".mp4", ".mov", ".webm"})
_STACK, _SHEET = "_olat.exr", "_olat.png"  # the contact sheet of a stack is not a photo


_FRAMES = re.compile(r"(.*?)(\d+)-(\d+)(\.\w+)", re.DOTALL)  # plate.1001-1050.exr
_NUMBERED = re.compile(r"(.*)%0?\d*d(.*)", re.DOTALL)  # plate.%04d.exr
_MOST_FRAMES = 100_000
_LONGEST_PATH = 4096  # characters


@dataclass(frozen=True, order=True)
class Item:
    """One input, and its place in the output folder."""

    input_path: Path
    output_base: Path  # output folder / name: the outputs' common beginning
    name: str  # path in the output folder, without suffix; the item's identity there
    mirrored: PurePosixPath | None = None  # of a file: path in its input folder, or name alone
    stale: frozenset[Path] = field(default=frozenset(), compare=False)  # outputs to be made; empty: all
    frame: int | None = field(default=None, compare=False)  # of a film, from 0

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
    suffixes: frozenset[str],
    pattern: NamePattern | None = None,
    null_separated: bool = False,
) -> list[Item]:
    """List the files of the inputs, sorted, each once; UsageError if there are none.

    Folders are walked recursively for `suffixes`, and a file keeps the path that it has in its folder; a file
    that is named alone has its name only. So an item's place depends on no other input, and two that meet in
    one place are refused. `-` reads paths from stdin. Hidden files and folders are left out, and so is an
    output folder inside an input folder.
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
    for _, (path, mirrored) in sorted(found.items()):
        own = mirrored.with_suffix("").as_posix()
        name = pattern.filled(fields_of(path, mirrored)) if pattern else own
        items.append(Item(path, output_folder / name, name, mirrored=mirrored))
    _refuse_meeting(items, pattern)
    return items


def _refuse_meeting(items: Sequence[Item], pattern: NamePattern | None) -> None:
    """Raise UsageError for two items with one name; case counts only where one folder holds both."""
    by_name: dict[str, Item] = {}
    for item in items:
        other = by_name.setdefault(item.name.casefold(), item)
        apart = other.name != item.name and other.input_path.parent == item.input_path.parent
        if other is not item and not apart:
            alike = "--name names them alike; give it more fields, such as {stem} and {ext}"
            by_path = (
                f"would both be written as {item.name}; rename one, name the folder that holds both, or give "
                "--name, such as '{dir}/{stem}_{ext}'"
            )
            raise UsageError(f"{other.input_path} and {item.input_path}: {alike if pattern else by_path}")


def expand_inputs(inputs: Sequence[str], null_separated: bool = False) -> Iterator[str]:
    """Yield the inputs, with the names on standard input in place of `-`, and files in place of frames."""
    for entry in inputs:
        if entry == "-":
            yield from filter(None, _stdin_names(null_separated))
        elif os.path.exists(entry) or len(entry) > _LONGEST_PATH:
            yield entry
        elif frames := _FRAMES.fullmatch(entry):
            yield from _range(entry, *frames.groups())
        elif numbered := _NUMBERED.fullmatch(entry):
            yield from _numbered(entry, *numbered.groups())
        else:
            yield entry


def _stdin_names(null_separated: bool) -> list[str]:
    if null_separated:
        return sys.stdin.read().split("\0")
    return [line.rstrip("\r\n") for line in sys.stdin]


def _range(entry: str, before: str, first: str, last: str, after: str) -> list[str]:
    """The frames of `plate.1001-1050.exr`."""
    if not int(first) <= int(last) < int(first) + _MOST_FRAMES:
        raise UsageError(f"{entry}: not a range of frames; give FIRST-LAST, at most {_MOST_FRAMES}")
    return [f"{before}{number:0{len(first)}}{after}" for number in range(int(first), int(last) + 1)]


def _numbered(entry: str, before: str, after: str) -> list[str]:
    """The files of `plate.%04d.exr`, by number."""
    folder, begin = os.path.split(before)
    form = re.compile(re.escape(begin) + r"(\d+)" + re.escape(after))
    matches = (
        form.fullmatch(name) for name in (os.listdir(folder or ".") if os.path.isdir(folder or ".") else ())
    )
    found = sorted((int(match[1]), os.path.join(folder, match[0])) for match in matches if match)
    if not found:
        raise UsageError(f"{entry}: no such files; check the pattern")
    return [path for _, path in found]


def _walk(folder: Path, output_real: str, suffixes: frozenset[str]) -> Iterator[Path]:
    for here, folders, files in os.walk(folder):
        folders[:] = [
            name
            for name in folders
            if name[0] != "." and os.path.realpath(os.path.join(here, name)) != output_real
        ]
        for name in files:
            sheet = name.endswith(_SHEET) and name.removesuffix(_SHEET) + _STACK in files
            if name[0] != "." and Path(name).suffix.lower() in suffixes and not sheet:
                yield Path(here) / name
