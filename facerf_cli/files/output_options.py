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
_ALIASES: dict[str, Format] = {"jpeg": "jpg", "tif": "tiff"}
_FILES: dict[str, Format] = {".exr": "exr", ".png": "png", ".tif": "tiff", ".tiff": "tiff", ".jpg": "jpg"}
_FILES |= {".jpeg": "jpg"}
_MOST_EV = 20.0
Exposure = float | Literal["auto", "face"]  # EV, or the rule that chooses it
STDOUT = Path("-")


def format_of_file(output: Path) -> Format | None:
    """Return the format of the image that `-o` names; None for a folder, or for another file."""
    return None if output.is_dir() else _FILES.get(output.suffix.lower())


def parse_formats(text: str) -> tuple[Format, ...]:
    """Parse `--format`; raise UsageError for an unknown format, or two formats with the same file name."""
    words = filter(None, map(str.strip, text.split(",")))
    names = dict.fromkeys(_ALIASES.get(word, word) for word in words)
    formats = tuple(name for name in SUFFIXES if name in names)
    if not formats or len(formats) < len(names):
        unknown = next((name for name in names if name not in SUFFIXES), text)
        raise UsageError(f"--format {unknown!r}: no such format; use some of {', '.join(SUFFIXES)}")
    if "png" in formats and "png16" in formats:
        raise UsageError("--format: png and png16 would both be NAME.png; use one of them")
    return formats


def config_of(path: Path) -> str:
    """Return the configuration of `--ocio` as OpenImageIO takes it; raise UsageError if it is not one."""
    if not path.is_file():
        raise UsageError(f"--ocio {path}: no such file; pass an OpenColorIO configuration")
    from facerf_cli.image import display as ocio

    ocio.check(str(path))
    return str(path)


@dataclass(frozen=True)
class OutputOptions:
    """Formats and colours of written images; picklable.

    Attributes:
        formats: Formats of each image: exr (half floats, layers), tiff (floats), png, png16, jpg.
        output_colourspace: Colour space of EXR and TIFF: ACEScg, lin_rec2020, or a name of the OCIO
            configuration.
        compression: Compression of EXR: zip, zips, piz, rle (lossless), none, pxr24, b44, b44a, dwaa, dwab.
        exr: Layers as parts of the EXR, or as channels of a single part, which more programs read.
        quality: JPEG quality, 1 to 100.
        view: View of PNG and JPEG: soft (sRGB with a soft shoulder), none (clipped), aces, or a view of OCIO.
        display: OCIO display of --view.
        config: OpenColorIO configuration.
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

    file_suffix: str = field(default="", metadata=NOT_IN_RECIPE)  # of the single file that -o names

    def suffix_of(self, name: Format) -> str:
        return self.file_suffix or SUFFIXES[name]

    @property
    def suffixes(self) -> tuple[str, ...]:
        return tuple(map(self.suffix_of, self.formats))


def parse_exposure(text: str) -> Exposure:
    """Parse `--exposure`: EV, or the rule that chooses it."""
    if text == "auto":
        return "auto"
    if text == "face":
        return "face"
    (ev,) = numbers(text, ("auto or face or EV",), "--exposure")
    if abs(ev) > _MOST_EV:
        raise UsageError(f"--exposure {text!r}: out of range; use {-_MOST_EV:g} to {_MOST_EV:g} EV")
    return ev


def check_stdout(images: int, formats: tuple[Format, ...]) -> None:
    """Raise UsageError unless exactly one file goes to standard output, and not to a terminal."""
    if images != 1:
        raise UsageError(f"-o -: there would be {images} images; use one photo, one face and one light")
    if len(formats) != 1:
        raise UsageError("-o -: writes one image; use one format, such as --format exr")
    if sys.stdout.isatty():
        raise UsageError("-o -: standard output is a terminal; redirect it to a file or a program")
