"""Write an image in every format that the options name."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facerf_cli.errors import UsageError
from facerf_cli.files.output_options import Format, OutputOptions
from facerf_cli.files.write import write_display, write_exr, write_tiff
from facerf_cli.image.colour import LINEAR, ColourSpace, View, named_space, named_view
from facerf_cli.image.strips import Rows
from facerf_cli.run.logs import step


@dataclass(frozen=True, eq=False)
class OutputImage:
    """An image to write: linear Rec.709 [H, W, 3], not multiplied by alpha [H, W], and layers of the EXR.

    `share` [H, W] is the amount of the soft view per pixel; `added` [H, W, 3], by rows, is light that the
    photo does not contain (`colour.encode_display`); without both the view applies everywhere. `header` is
    metadata of the EXR only.
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
    path: Path, image: OutputImage, exposure_ev: float, options: OutputOptions, metadata: Mapping[str, Any]
) -> None:
    """Write an image in all formats at the same time, to `path` with the suffix of each format."""
    space, view = _space_of(options), _view_of(options)
    pixels, alpha = image.pixels, image.alpha

    def write(name: Format) -> None:
        target = path.with_suffix(options.suffix_of(name))
        if name == "exr":
            single, header = options.exr == "single", {**metadata, **image.header}
            write_exr(target, pixels, alpha, image.layers, header, space, options.compression, single)
        elif name == "tiff":
            write_tiff(target, pixels, alpha, metadata, space)
        else:
            shown = {"facerf:view": view.name, **metadata}
            kept, quality = (image.share, image.added), options.quality
            bits: Literal[8, 16] = 16 if name == "png16" else 8
            write_display(target, pixels, exposure_ev, alpha, shown, view, *kept, bits, quality)

    at_once = len(options.formats) if not isinstance(pixels, np.memmap) else 1
    with ThreadPoolExecutor(at_once) as pool:
        list(pool.map(write, options.formats))


def _space_of(options: OutputOptions) -> ColourSpace:
    if options.output_colourspace is None:
        return LINEAR
    space = named_space(options.output_colourspace, options.config)
    if space.decode is not None:
        raise UsageError(
            f"--output-colourspace {options.output_colourspace}: EXR and TIFF are linear; use a linear "
            "space, such as ACEScg (PNG and JPEG are sRGB)"
        )
    return space


def _view_of(options: OutputOptions) -> View:
    return named_view(options.view, options.config, options.display)
