"""Names of outputs: patterns such as `{dir}/{stem}_{light}`, and the fields of an input that fill them."""

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from string import Formatter

from facerf_cli.errors import UsageError

OF_PHOTOS = ("dir", "parent", "stem", "ext")
OF_FILES = (*OF_PHOTOS, "frame")
OF_IMAGES = (*OF_PHOTOS, "light", "frame")
_SEPARATORS = "._-"  # one of these before an empty field goes with it
_WIDTH = re.compile(r"0?[1-9]?")
_FRAME = re.compile(r"(.+?)((?:\.\d+)*)", re.DOTALL)  # a name, and the frame numbers that it ends in


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


def file_pattern(text: str | None) -> NamePattern | None:
    """Parse the --name of a verb that writes files a photo, where it is given."""
    return NamePattern.parse(text, "--name", OF_FILES) if text else None


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
