"""Path patterns of a capture: {subject}, {camera} and {light} stand for parts of its images' paths."""

import re
from collections.abc import Collection, Iterator
from pathlib import Path

from facerf_cli.errors import InputError
from facerf_cli.files.documents import is_name

FIELDS = ("subject", "camera", "light")
FULL_NAMES = ("full", "full_on", "fullon", "all", "all_on")  # in a light's place: a frame with all lights on
_AMBIENT_WORDS = ("ambient", "dark", "black", "room", "background")  # there, too: a frame without lights
_RESERVED = r"{}\:*?"  # wildcards of patterns, and characters that file names cannot have everywhere
_LONGEST = 500


def require_pattern(
    pattern: str, where: str, needed: Collection[str], fields: tuple[str, ...] = FIELDS
) -> str:
    """Return a pattern; an InputError says `where` one stands that is no path with the needed fields alone.

    It must stay below the capture's folder, and hold no braces but those of `fields`.
    """
    parts = pattern.split("/")
    plain = re.sub(rf"\{{({'|'.join(fields)})\}}", "", pattern)
    words = [f"{{{field}}}" for field in fields if field in needed]
    odd = sorted({letter for letter in plain if letter in _RESERVED or not letter.isprintable()})
    if (
        odd
        or any(word not in pattern for word in words)
        or any(part in ("", ".", "..") for part in parts)
        or len(pattern) > _LONGEST
    ):
        named = " that names " * bool(words) + " and ".join(words)
        free = f", without {' '.join(map(ascii, odd))} elsewhere," * bool(odd)
        raise InputError(f"{where} is {pattern!r}; a path below the capture{named}{free} is needed")
    return pattern


def fill_pattern(pattern: str, **names: str) -> str:
    """Replace the fields of a pattern by names."""
    for field, name in names.items():
        pattern = pattern.replace(f"{{{field}}}", name)
    return pattern


def compile_pattern(pattern: str) -> re.Pattern[str]:
    """Make a regular expression with a group per field; a repeated field must match the same text."""
    expression = re.escape(pattern)
    for field in FIELDS:
        escaped = re.escape(f"{{{field}}}")
        expression = expression.replace(escaped, f"(?P<{field}>[^/]+)", 1).replace(escaped, f"(?P={field})")
    return re.compile(expression)


def find_subjects(folder: Path, pattern: str, cameras: list[str], lights: list[str]) -> Iterator[str]:
    """Yield the subjects that have an image, sorted: the names at the part of the pattern with {subject}."""
    parts = pattern.split("/")
    depth = next(index for index, part in enumerate(parts) if "{subject}" in part)
    expression = compile_pattern("/".join(parts[: depth + 1]))
    above = fill_pattern("/".join([*parts[:depth], "*"]), camera="*", light="*")
    relatives = (path.relative_to(folder).as_posix() for path in folder.glob(above) if path.name[0] != ".")
    matches = (expression.fullmatch(relative) for relative in relatives)
    for name in sorted({match["subject"] for match in matches if match}):
        paths = (
            folder / fill_pattern(pattern, subject=name, camera=c, light=i) for c in cameras for i in lights
        )
        if any(path.exists() for path in paths):
            if not is_name(name):
                raise InputError(f"{folder}: the subject {name!r} is no name of letters, digits, - and _")
            yield name


def unlisted_kind(name: str) -> str:
    """Kind of an image whose name in the light's place is of no single light: 'full', 'ambient', else ''."""
    plain = name.lower().strip("_- ")
    if plain in FULL_NAMES:
        return "full"
    return "ambient" if any(word in plain for word in _AMBIENT_WORDS) else ""
