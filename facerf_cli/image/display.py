"""OpenColorIO through OpenImageIO: names of colour spaces, conversions, and display views.

`config` is a configuration's file or `ocio://` name; '' is $OCIO, or without it the built-in `ocio://default`.
Values are float32 [H, W, 3].
"""

from functools import cache

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import UsageError

# Names of linear Rec.709, and then of ACES2065-1, in configurations. OpenImageIO finds the first one in all
# configurations that have the role aces_interchange.
REC709_NAMES = ("lin_rec709_scene", "lin_rec709", "Linear Rec.709 (sRGB)")
ACES_NAMES = ("ACES2065-1", "ACES - ACES2065-1")


def check(config: str) -> None:
    """Raise UsageError for a file that is no configuration."""
    _opened(config)


@cache  # hundreds, asked of OpenColorIO one by one
def names(config: str = "") -> dict[str, str]:
    """Map case-folded names, aliases and roles of the configuration to the names of their spaces."""
    found = _opened(config)
    spaces = [name for name in found.getColorSpaceNames() if not found.isData(name)]
    spaces += [alias for name in spaces for alias in found.getAliases(name)]
    spaces += found.getRoles()
    return {name.casefold(): found.resolve(name) for name in spaces}


def display(config: str = "") -> str:
    """Return the name of the configuration's default display."""
    return str(_opened(config).getDefaultDisplayName())


def displays(config: str = "") -> list[str]:
    return list(_opened(config).getDisplayNames())


def views(config: str = "", display_name: str = "") -> list[str]:
    """List the views of a display, its default one first; by default of the configuration's."""
    name = display_name or display(config)
    default = _opened(config).getDefaultViewName(name)
    return sorted(_opened(config).getViewNames(name), key=lambda view: view != default)


def converted(pixels: np.ndarray, source: str, target: str, config: str = "") -> np.ndarray | None:
    """Convert values from one colour space to another; None if OpenColorIO cannot."""
    result = oiio.ImageBufAlgo.colorconvert(_buffer(pixels), source, target, False, "", "", config)
    return None if _error(result) else np.asarray(result.get_pixels(oiio.FLOAT))


def displayed(
    pixels: np.ndarray, source: str, view: str, config: str = "", display_name: str = ""
) -> np.ndarray | None:
    """Encode values for a display, by default the configuration's, by a view; None if OpenColorIO cannot."""
    result = oiio.ImageBufAlgo.ociodisplay(
        _buffer(pixels), display_name or display(config), view, source, "", False, False, "", "", config
    )
    return None if _error(result) else np.asarray(result.get_pixels(oiio.FLOAT))


@cache  # slow to open
def _opened(config: str) -> oiio.ColorConfig:
    found = oiio.ColorConfig(config) if config else oiio.ColorConfig()
    if error := found.geterror():  # otherwise OpenImageIO continues with a few built-in names
        raise UsageError(f"{config or '$OCIO'}: {error}")
    return found


def _buffer(pixels: np.ndarray) -> oiio.ImageBuf:
    return oiio.ImageBuf(np.ascontiguousarray(pixels, np.float32))


def _error(result: oiio.ImageBuf) -> str:
    """Return a result's error, which OpenImageIO prints if nobody asks for it."""
    return str(result.geterror()) if result.has_error else ""
