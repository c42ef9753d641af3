"""Options of written images: formats, colours, compression; and one image on standard output."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import typer

from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.cli.options import IMAGE, refuse_given
from facerf_cli.errors import UsageError

Format = Literal["exr", "png", "png16", "tiff", "jpg"]
Compression = Literal["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab"]
SUFFIXES: dict[Format, str] = {"exr": ".exr", "png": ".png", "png16": ".png", "tiff": ".tif", "jpg": ".jpg"}
STDOUT = Path("-")
_DISPLAYED: tuple[Format, ...] = ("png", "png16", "jpg")
# Options that do nothing without some of these formats.
_NEEDS: dict[str, tuple[Format, ...]] = {
    "aov": ("exr",),
    "compression": ("exr",),
    "output_colourspace": ("exr", "tiff"),
    "view": _DISPLAYED,
    "display": _DISPLAYED,
}

FormatOption = Annotated[
    str,
    typer.Option(
        "--format",
        metavar="NAME,...",
        help="Write each image as exr (half floats, layers), tiff (floats), png, png16 or jpg.",
        show_default="exr,png; with -o - png",
        rich_help_panel=IMAGE,
    ),
]
ColourspaceOption = Annotated[
    str | None,
    typer.Option(
        "--output-colourspace",
        metavar="NAME",
        help="Write EXR and TIFF in this space: ACEScg, lin_rec2020, any name of OCIO.",
        show_default="linear Rec.709",
        rich_help_panel=IMAGE,
    ),
]
CompressionOption = Annotated[
    Compression,
    typer.Option(
        "--compression",
        metavar="NAME",
        help="Compress EXR files: zip, zips, piz, rle (lossless), none, pxr24, b44, b44a, dwaa, dwab.",
        rich_help_panel=IMAGE,
    ),
]
ViewOption = Annotated[
    str,
    typer.Option(
        "--view",
        metavar="NAME",
        help="Show PNG and JPEG by sRGB with a soft shoulder, clipped (none), by aces, or a view of OCIO.",
        rich_help_panel=IMAGE,
    ),
]
DisplayOption = Annotated[
    str,
    typer.Option(
        "--display",
        metavar="NAME",
        help="Take --view, or the default view, from this display of OCIO.",
        show_default="the configuration's",
        rich_help_panel=IMAGE,
    ),
]
OcioOption = Annotated[
    Path | None,
    typer.Option(
        "--ocio",
        metavar="FILE",
        help="Use this OpenColorIO configuration.",
        show_default="$OCIO, or the built-in one",
        rich_help_panel=IMAGE,
    ),
]


@dataclass(frozen=True)
class OutputOptions:
    """Formats and colours of written images, which can be sent to other processes."""

    formats: tuple[Format, ...] = field(default=("exr", "png"), metadata=NOT_IN_RECIPE)  # each in its own
    output_colourspace: str | None = None  # of EXR and TIFF; None: linear Rec.709
    compression: Compression = "zip"
    view: str = "soft"
    display: str = ""  # of the configuration; '' is its default one
    config: str = ""  # OpenColorIO's; '' is $OCIO, or the built-in one

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Suffixes of the files of each image."""
        return tuple(SUFFIXES[name] for name in self.formats)

    @property
    def shown_suffix(self) -> str | None:
        """The suffix of the first format that is exposed for a display."""
        return next((SUFFIXES[name] for name in self.formats if name in _DISPLAYED), None)


def parse_formats(text: str) -> tuple[Format, ...]:
    """Parse `--format`; raises UsageError for an unknown format, or two with the same file name."""
    names = dict.fromkeys(name.strip() for name in text.split(",") if name.strip())
    formats = tuple(name for name in SUFFIXES if name in names)
    if unknown := [name for name in names if name not in SUFFIXES]:
        raise UsageError(f"--format {unknown[0]!r}: no such format; give some of {', '.join(SUFFIXES)}")
    if not formats:
        raise UsageError(f"--format: names no format; give some of {', '.join(SUFFIXES)}")
    if "png" in formats and "png16" in formats:
        raise UsageError("--format: png and png16 would both be NAME.png; give one of them")
    return formats


def refuse_unused(context: typer.Context, formats: tuple[Format, ...]) -> None:
    """Raise UsageError for an option that none of the formats has a use for."""
    for name, needed in _NEEDS.items():
        if not set(needed) & set(formats):
            refuse_given(context, (name,), f"is for {', '.join(needed)}; add that to --format")


def config_of(path: Path | None) -> str:
    """The configuration of `--ocio` as OpenImageIO takes it; raises UsageError for a file that is none."""
    if path is None:
        return ""
    if not path.is_file():
        raise UsageError(f"--ocio {path}: no such file; give an OpenColorIO configuration")
    from facerf_cli.image import display as ocio

    ocio.check(str(path))
    return str(path)


def check_stdout(images: int, formats: tuple[Format, ...]) -> None:
    """Raise UsageError unless exactly one file goes to standard output, and not to a terminal."""
    if images != 1:
        raise UsageError(f"-o -: there would be {images} images; give one photo, one face and one light")
    if len(formats) != 1:
        raise UsageError("-o -: takes one image; give one format, such as --format exr")
    if sys.stdout.isatty():
        raise UsageError("-o -: standard output is a terminal; redirect it to a file or a program")
