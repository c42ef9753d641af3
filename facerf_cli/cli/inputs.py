"""The inputs of a command line as a sorted list of items, each with its place in the output folder."""

import os
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from facerf_cli.errors import UsageError

PHOTO_SUFFIXES = frozenset(
    {".exr", ".hdr", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".jxl", ".heic", ".heif", ".jp2"}
    | {".psd", ".tga", ".dpx", ".cin", ".pgm", ".ppm"}
)
_STACK, _SHEET = "_olat.exr", "_olat.png"  # the contact sheet of a stack is not a photo


@dataclass(frozen=True, order=True)
class Item:
    """One input, and its place in the mirrored output tree."""

    input_path: Path
    output_base: Path  # output folder / mirrored path, without suffix: the outputs' common beginning
    name: str  # the mirrored path as text; the item's identity within the output folder

    def output(self, ending: str) -> Path:
        """An output of the item: `item.output("_relit.exr")`, or `item.output("/mesh.glb")` in a folder."""
        return Path(f"{self.output_base}{ending}")


def collect_items(inputs: Sequence[str], output_folder: Path, suffixes: frozenset[str]) -> list[Item]:
    """List the files of the inputs, sorted, each once; UsageError if there are none.

    Files are taken as named, folders are walked recursively for `suffixes`, and `-` reads paths from stdin.
    The output tree mirrors the input from the deepest folder that all inputs share. Hidden files and folders
    are left out, and so is an output folder inside an input folder.
    """
    output_real = output_folder.resolve()
    found: dict[Path, Path] = {}  # absolute -> as the user would write it
    roots: set[Path] = set()
    for path in map(Path, expand_stdin(inputs)):
        absolute = Path(os.path.abspath(path))
        if path.is_dir():
            if path.resolve() == output_real:
                raise UsageError(f"{path}: the output folder is an input folder; give another one with -o")
            roots.add(absolute)
            found.update((Path(os.path.abspath(file)), file) for file in _walk(path, output_real, suffixes))
        else:
            roots.add(absolute.parent)
            found[absolute] = path
    if not found:
        kinds = " ".join(sorted(suffixes))
        raise UsageError(f"{' '.join(inputs) or 'standard input'}: no inputs found (looked for {kinds})")
    common = Path(os.path.commonpath(roots))
    names = _unique_names([absolute.relative_to(common) for absolute in sorted(found)])
    return [
        Item(found[absolute], output_folder / name, name)
        for absolute, name in zip(sorted(found), names, strict=True)
    ]


def expand_stdin(inputs: Sequence[str]) -> Iterator[str]:
    """Yield the inputs, with the lines of standard input in place of `-`."""
    for entry in inputs:
        if entry == "-":
            yield from filter(None, (line.rstrip("\r\n") for line in sys.stdin))
        else:
            yield entry


def _walk(folder: Path, output_real: Path, suffixes: frozenset[str]) -> Iterator[Path]:
    for here, folders, files in os.walk(folder):
        folders[:] = [
            name for name in folders if name[0] != "." and (Path(here) / name).resolve() != output_real
        ]
        for name in files:
            sheet = name.endswith(_SHEET) and name.removesuffix(_SHEET) + _STACK in files
            if name[0] != "." and Path(name).suffix.lower() in suffixes and not sheet:
                yield Path(here) / name


def _unique_names(relatives: Sequence[Path]) -> list[str]:
    """Mirrored paths without suffix, or with it where two would share a name, ignoring case."""
    full = [path.as_posix() for path in relatives]
    names = [path.with_suffix("").as_posix() for path in relatives]
    while clashing := _repeated(name.casefold() for name in names):
        longer = [
            whole if name.casefold() in clashing else name for whole, name in zip(full, names, strict=True)
        ]
        if longer == names:
            break  # only case tells them apart; the file system that holds the inputs can hold the outputs
        names = longer
    return names


def _repeated(keys: Iterable[str]) -> set[str]:
    return {key for key, count in Counter(keys).items() if count > 1}
