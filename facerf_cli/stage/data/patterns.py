"""Where a capture's pictures are: a path with {subject}, {camera} and {light} in it."""

import re
from collections.abc import Collection, Iterator
from pathlib import Path

from facerf_cli.stage.data.documents import Node

FIELDS = ("subject", "camera", "light")
_ODD = r"{}\:*?"  # what stands for other things in patterns, or in no file's name


def require_pattern(node: Node, needed: Collection[str], fields: tuple[str, ...] = FIELDS) -> str:
    """A relative path that names the needed of `fields`, and leads nowhere else; an InputError otherwise."""
    pattern = node.text()
    parts = pattern.split("/")
    plain = re.sub(rf"\{{({'|'.join(fields)})\}}", "", pattern)
    words = [f"{{{field}}}" for field in fields if field in needed]
    odd = sorted({letter for letter in plain if letter in _ODD or not letter.isprintable()})
    if (
        odd
        or any(word not in pattern for word in words)
        or any(part in ("", ".", "..") for part in parts)
        or len(pattern) > 500
    ):
        named = " that names " * bool(words) + " and ".join(words)
        free = f", without {' '.join(map(ascii, odd))} elsewhere," * bool(odd)
        raise node.wrong(f"a path below the capture{named}{free}")
    return pattern


def filled(pattern: str, **names: str) -> str:
    """A pattern with names in the fields' places."""
    for word, name in names.items():
        pattern = pattern.replace(f"{{{word}}}", name)
    return pattern


def found_subjects(folder: Path, pattern: str, cameras: list[str], lights: list[str]) -> Iterator[str]:
    """Whoever has a picture, in order: the files or folders at the pattern's part that names the subject."""
    parts = pattern.split("/")
    depth = next(index for index, part in enumerate(parts) if "{subject}" in part)
    expression = re.escape("/".join(parts[: depth + 1]))
    for word in FIELDS:
        first, *rest = expression.split(re.escape(f"{{{word}}}"))
        named = [f"(?P<{word}>[^/]+)", *[f"(?P={word})"] * (len(rest) - 1)] if rest else []
        expression = first + "".join(name + part for name, part in zip(named, rest, strict=True))
    above = filled("/".join([*parts[:depth], "*"]), camera="*", light="*")
    relatives = (path.relative_to(folder).as_posix() for path in folder.glob(above) if path.name[0] != ".")
    matches = (re.fullmatch(expression, relative) for relative in relatives)
    for name in sorted({match["subject"] for match in matches if match}):
        paths = (folder / filled(pattern, subject=name, camera=c, light=i) for c in cameras for i in lights)
        if any(path.exists() for path in paths):
            yield Node(f"{folder}: a subject", name).name()
