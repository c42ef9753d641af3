"""Options of written images: formats, colours, compression; and one image on standard output."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.errors import UsageError
from facerf_cli.light.entries import numbers
from facerf_cli.option import IMAGE, option

Format = Literal["exr", "png", "png16", "tiff", "jpg"]
Compression = Literal["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab"]
SUFFIXES: dict[Format, str] = {"exr": ".exr", "png": ".png", "png16": ".png", "tiff": ".tif", "jpg": ".jpg"}
_ALIASES = {"jpeg": "jpg", "tif": "tiff"}
_FILES: dict[str, Format] = {".exr": "exr", ".png": "png", ".tif": "tiff", ".tiff": "tiff", ".jpg": "jpg"}
_FILES |= {".jpeg": "jpg"}
_MOST_EV = 20.0
Exposure = float | Literal["auto", "face"]  # EV, or the rule that chooses it
STDOUT = Path("-")
_DISPLAYED: tuple[Format, ...] = ("png", "png16", "jpg")
# Options that do nothing without some of these formats.
NEEDS: dict[str, tuple[Format, ...]] = {
    "aov": ("exr",),
    "compression": ("exr",),
    "exr": ("exr",),
    "quality": ("jpg",),
    "output_colourspace": ("exr", "tiff"),
    "view": _DISPLAYED,
    "display": _DISPLAYED,
}


def format_of_file(output: Path) -> Format | None:
    """The format of the one image that `-o` names; None for a folder, or for another file."""
    return None if output.is_dir() else _FILES.get(output.suffix.lower())


def parse_formats(text: str) -> tuple[Format, ...]:
    """Parse `--format`; raises UsageError for an unknown format, or two with the same file name."""
    given = filter(None, map(str.strip, text.split(",")))
    names = dict.fromkeys(_ALIASES.get(name, name) for name in given)
    formats = tuple(name for name in SUFFIXES if name in names)
    if unknown := [name for name in names if name not in SUFFIXES]:
        raise UsageError(f"--format {unknown[0]!r}: no such format; give some of {', '.join(SUFFIXES)}")
    if not formats:
        raise UsageError(f"--format: names no format; give some of {', '.join(SUFFIXES)}")
    if "png" in formats and "png16" in formats:
        raise UsageError("--format: png and png16 would both be NAME.png; give one of them")
    return formats


def config_of(path: Path) -> str:
    """The configuration of `--ocio` as OpenImageIO takes it; raises UsageError for a file that is none."""
    if not path.is_file():
        raise UsageError(f"--ocio {path}: no such file; give an OpenColorIO configuration")
    from facerf_cli.image import display as ocio

    ocio.check(str(path))
    return str(path)


@dataclass(frozen=True)
class OutputOptions:
    """Formats and colours of written images, which can be sent to other processes.

    Attributes:
        formats: Write each image as exr (half floats, layers), tiff (floats), png, png16 or jpg.
        output_colourspace: Write EXR and TIFF in this space: ACEScg, lin_rec2020, any name of OCIO.
        compression: Compress EXR files: zip, zips, piz, rle (lossless), none, pxr24, b44, b44a, dwaa, dwab.
        exr: Write layers as parts of the EXR, or as channels of a single part, which more programs read.
        quality: Compress JPEG files by this quality, 1 to 100.
        view: Show PNG and JPEG by sRGB with a soft shoulder, clipped (none), by aces, or a view of OCIO.
        display: Take --view, or the default view, from this display of OCIO.
        config: Use this OpenColorIO configuration.
    """

    formats: tuple[Format, ...] = option(
        ("exr", "png"),
        metavar="NAME,...",
        in_recipe=False,
        flags=("--format",),
        shown_default="exr,png; with -o - png",
        parse=parse_formats,
        panel=IMAGE,
        everyday=True,
    )
    output_colourspace: str | None = option(None, metavar="NAME", shown_default="linear Rec.709", panel=IMAGE)
    compression: Compression = option("zip", metavar="NAME", panel=IMAGE)
    exr: Literal["parts", "single"] = option("parts", panel=IMAGE)
    quality: int = option(95, metavar="N", least=1, most=100, panel=IMAGE)
    view: str = option("soft", metavar="NAME", panel=IMAGE)
    display: str = option("", metavar="NAME", shown_default="the configuration's", panel=IMAGE)
    config: str = option(
        "",
        metavar="FILE",
        flags=("--ocio",),
        shown_default="$OCIO, or the built-in one",
        typed=Path | None,
        parse=config_of,
        panel=IMAGE,
    )

    file_suffix: str = field(default="", metadata=NOT_IN_RECIPE)  # of the one file that -o names

    def suffix_of(self, name: Format) -> str:
        return self.file_suffix or SUFFIXES[name]

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Suffixes of the files of each image."""
        return tuple(map(self.suffix_of, self.formats))

    @property
    def shown_suffix(self) -> str | None:
        """The suffix of the first format that is exposed for a display."""
        return next((self.suffix_of(name) for name in self.formats if name in _DISPLAYED), None)


def parse_exposure(text: str) -> Exposure:
    """Parse `--exposure`: EV, or the rule that chooses it."""
    if text == "auto":
        return "auto"
    if text == "face":
        return "face"
    (ev,) = numbers(text, ("auto or face or EV",), "--exposure")
    if abs(ev) > _MOST_EV:
        raise UsageError(f"--exposure {text!r}: out of range; give {-_MOST_EV:g} to {_MOST_EV:g} EV")
    return ev


def check_stdout(images: int, formats: tuple[Format, ...]) -> None:
    """Raise UsageError unless exactly one file goes to standard output, and not to a terminal."""
    if images != 1:
        raise UsageError(f"-o -: there would be {images} images; give one photo, one face and one light")
    if len(formats) != 1:
        raise UsageError("-o -: takes one image; give one format, such as --format exr")
    if sys.stdout.isatty():
        raise UsageError("-o -: standard output is a terminal; redirect it to a file or a program")
