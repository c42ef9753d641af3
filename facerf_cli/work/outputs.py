"""Images written in every format of the options."""

import logging
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facerf_cli.errors import UsageError
from facerf_cli.files.write import write_display, write_exr, write_tiff
from facerf_cli.image.colour import LINEAR, ColourSpace, View, named_space, named_view
from facerf_cli.image.strips import Rows
from facerf_cli.run.logs import LOGGER_NAME, step
from facerf_cli.work.output_options import Format, OutputOptions

Exposure = float | Literal["auto"]
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class OutputImage:
    """An image to write: linear Rec.709 [H, W, 3], not multiplied by alpha [H, W], and its layers.

    `share` [H, W] is how far a soft view applies to each pixel, or `added` [H, W, 3], by rows, what was
    not photographed (`colour.encode_display`); without both it applies to all. `header` is metadata that only
    the EXR has.
    """

    pixels: np.ndarray
    alpha: np.ndarray | None = None
    layers: Mapping[str, np.ndarray] = field(default_factory=dict)
    share: np.ndarray | None = None
    added: Rows | None = None
    header: Mapping[str, Any] = field(default_factory=dict)


def check_output(options: OutputOptions) -> None:
    """Raise UsageError for a colour space, a view or a configuration that cannot be used."""
    _space_of(options)
    _view_of(options)


@step("write")
def write_output(
    path: Path,
    image: OutputImage,
    exposure: Exposure,
    options: OutputOptions,
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Write an image in every format, at the same time, under `path` with the suffix of each."""
    space, view = _space_of(options), _view_of(options)

    def write(name: Format) -> None:
        target = path.with_suffix(options.suffix_of(name))
        if name == "exr":
            one = options.exr == "single"
            header = {**(metadata or {}), **image.header}
            write_exr(
                target, image.pixels, image.alpha, image.layers, header, space, options.compression, one
            )
        elif name == "tiff":
            write_tiff(target, image.pixels, image.alpha, metadata, space)
        else:
            bits: Literal[8, 16] = 16 if name == "png16" else 8
            shown = {"facerf:view": view.name, **(metadata or {})}
            kept = image.share, image.added
            write_display(
                target,
                image.pixels,
                exposure,
                image.alpha,
                shown,
                view,
                *kept,
                bits,
                options.quality,
            )

    at_once = len(options.formats) if not isinstance(image.pixels, np.memmap) else 1
    with ThreadPoolExecutor(at_once) as pool:
        list(pool.map(write, options.formats))


def _space_of(options: OutputOptions) -> ColourSpace:
    """The colour space of EXR and TIFF files."""
    if options.output_colourspace is None:
        return LINEAR
    space = named_space(options.output_colourspace, options.config)
    if space.decode is not None:
        raise UsageError(
            f"--output-colourspace {options.output_colourspace}: EXR and TIFF are linear, without the curve "
            f"of {space.name}; give a linear space, such as ACEScg (PNG and JPEG are sRGB)"
        )
    return space


def _view_of(options: OutputOptions) -> View:
    """The display view of PNG and JPEG files."""
    return named_view(options.view, options.config, options.display)
