"""The background behind a relit person, and the layers of its image, as the options name them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from facerf_cli.cli.values import numbers
from facerf_cli.errors import UsageError

Kind = Literal["photo", "envmap", "none", "file", "colour"]
_LAYERS = (
    "albedo",
    "normal",
    "position",
    "depth",
    "shadow",
    "specular",
    "classes",
    "face",
    "uv",
)
_FORMS = "photo, envmap, none, an image file, #RRGGBB or R,G,B"


@dataclass(frozen=True)
class BackgroundChoice:
    """A choice of background; `colour` is scene-linear Rec.709."""

    kind: Kind
    path: Path | None = None
    colour: tuple[float, float, float] | None = None


def parse_background(text: str) -> BackgroundChoice:
    """Parse `--background`; raises UsageError where it names none."""
    if text in ("photo", "envmap", "none"):
        return BackgroundChoice(text)  # type: ignore[arg-type]
    if text.startswith("#"):
        return BackgroundChoice("colour", colour=_hex(text))
    if Path(text).is_file():
        return BackgroundChoice("file", Path(text))
    if "," in text:
        red, green, blue = numbers(text, ("R,G,B",), "--background")
        if min(red, green, blue) < 0:
            raise UsageError(f"--background {text!r}: the colour is negative; give values from 0")
        return BackgroundChoice("colour", colour=(red, green, blue))
    raise UsageError(f"--background {text!r}: no such file; give {_FORMS}")


def parse_aov(text: str) -> tuple[str, ...]:
    """Parse `--aov`, names with commas; the matte may be named, too."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if unknown := [name for name in names if name not in (*_LAYERS, "matte")]:
        raise UsageError(f"--aov {unknown[0]!r}: no such layer; give some of matte, {', '.join(_LAYERS)}")
    return tuple(name for name in names if name != "matte")


def _hex(text: str) -> tuple[float, float, float]:
    digits = text.removeprefix("#")
    if len(digits) != 6 or any(digit not in "0123456789abcdefABCDEF" for digit in digits):
        raise UsageError(f"--background {text!r}: not a colour; give #RRGGBB, as in #202830")
    red, green, blue = (_linear(int(digits[k : k + 2], 16) / 255) for k in (0, 2, 4))
    return red, green, blue


def _linear(encoded: float) -> float:
    """Decode sRGB; without numpy, which --help does without."""
    return encoded / 12.92 if encoded <= 0.04045 else ((encoded + 0.055) / 1.055) ** 2.4
