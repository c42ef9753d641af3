"""Images written in every format of the options."""

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facerf_cli.cli.output_options import SUFFIXES, Format, OutputOptions
from facerf_cli.errors import UsageError
from facerf_cli.files.atomic import hidden_folder
from facerf_cli.files.images import write_display, write_exr, write_tiff
from facerf_cli.image.colour import LINEAR, ColourSpace, View, named_space, named_view
from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME

Exposure = float | Literal["auto"]
_FLOATS = (
    "rgb",
    "A",
    "person.A",
    "position",
    "depth",
    "uv",
)  # layers that are not only written as half floats
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class OutputImage:
    """An image to write: linear Rec.709 [H, W, 3], not multiplied by alpha [H, W], and its layers.

    `share` [H, W] is how far a soft view applies to each pixel (`colour.encode_display`); None: to all.
    """

    pixels: np.ndarray
    alpha: np.ndarray | None = None
    layers: Mapping[str, np.ndarray] = field(default_factory=dict)
    share: np.ndarray | None = None


def check_output(options: OutputOptions) -> None:
    """Raise UsageError for a colour space, a view or a configuration that cannot be used."""
    _space_of(options)
    _view_of(options)


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
        target = path.with_suffix(SUFFIXES[name])
        if name == "exr":
            write_exr(target, image.pixels, image.alpha, image.layers, metadata, space, options.compression)
        elif name == "tiff":
            write_tiff(target, image.pixels, image.alpha, metadata, space)
        else:
            bits: Literal[8, 16] = 16 if name == "png16" else 8
            shown = {"facerf:view": view.name, **(metadata or {})}
            write_display(target, image.pixels, exposure, image.alpha, shown, view, image.share, bits)

    at_once = len(options.formats) if not isinstance(image.pixels, np.memmap) else 1
    with ThreadPoolExecutor(at_once) as pool:
        list(pool.map(write, options.formats))


@contextmanager
def canvas(path: Path, held_bytes: int) -> Iterator[Callable[[str, tuple[int, ...]], np.ndarray]]:
    """Yield a function that makes an array for a layer of an output, by its name and shape.

    Arrays that do not fit the budget, with what is held already, are mapped to files in a hidden folder of
    the output: the parts of an EXR are written one after the other. There layers that an EXR holds in half
    floats are half floats.
    """
    with ExitStack() as stack:
        left, folders = memory.limit_bytes() - held_bytes, list[Path]()

        def empty(name: str, shape: tuple[int, ...]) -> np.ndarray:
            nonlocal left
            needed = 4 * math.prod(shape)
            if left > needed:
                left -= needed
                return np.empty(shape, np.float32)
            folders[:] = folders or [stack.enter_context(hidden_folder(path))]
            kind = np.float32 if name in _FLOATS else np.float16
            return np.memmap(folders[0] / f"{name}.values", kind, "w+", shape=shape)

        yield empty


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
