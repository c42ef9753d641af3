"""OpenColorIO through OpenImageIO: names of colour spaces, conversions and display views.

`config` is a configuration's file or `ocio://` name; '' is $OCIO or, without it, the built-in `ocio://default`.
Values are float32 [H, W, 3].
"""

from functools import cache

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import UsageError

# Names of linear Rec.709 and ACES2065-1 in configurations. OpenImageIO finds the first one in every
# configuration with the role aces_interchange.
REC709_NAMES = ("lin_rec709_scene", "lin_rec709", "Linear Rec.709 (sRGB)")
ACES_NAMES = ("ACES2065-1", "ACES - ACES2065-1")


def check(config: str) -> None:
    """Raise UsageError for a file that is not a configuration."""
    _opened(config)


@cache  # hundreds of calls of OpenColorIO
def names(config: str = "") -> dict[str, str]:
    """Return the colour space of each case-folded name, alias and role of the configuration."""
    opened = _opened(config)
    spaces = [name for name in opened.getColorSpaceNames() if not opened.isData(name)]
    spaces += [alias for name in spaces for alias in opened.getAliases(name)]
    spaces += opened.getRoles()
    return {name.casefold(): opened.resolve(name) for name in spaces}


def display(config: str = "") -> str:
    """Return the name of the configuration's default display."""
    return str(_opened(config).getDefaultDisplayName())


def displays(config: str = "") -> list[str]:
    return list(_opened(config).getDisplayNames())


def views(config: str = "", display_name: str = "") -> list[str]:
    """List the views of a display, by default the configuration's; its default view comes first."""
    name = display_name or display(config)
    default = _opened(config).getDefaultViewName(name)
    return sorted(_opened(config).getViewNames(name), key=lambda view: view != default)


def converted(pixels: np.ndarray, source: str, target: str, config: str = "") -> np.ndarray | None:
    """Convert from one colour space to another; return None if OpenColorIO cannot."""
    result = oiio.ImageBufAlgo.colorconvert(_buffer(pixels), source, target, False, "", "", config)
    return None if _error(result) else np.asarray(result.get_pixels(oiio.FLOAT))


def displayed(
    pixels: np.ndarray, source: str, view: str, config: str = "", display_name: str = ""
) -> np.ndarray | None:
    """Encode for a view of a display, by default the configuration's; return None if OpenColorIO cannot."""
    result = oiio.ImageBufAlgo.ociodisplay(
        _buffer(pixels), display_name or display(config), view, source, "", False, False, "", "", config
    )
    return None if _error(result) else np.asarray(result.get_pixels(oiio.FLOAT))


@cache  # slow to open
def _opened(config: str) -> oiio.ColorConfig:
    opened = oiio.ColorConfig(config) if config else oiio.ColorConfig()
    if error := opened.geterror():  # otherwise OpenImageIO continues with a few built-in names
        raise UsageError(f"{config or '$OCIO'}: {error}")
    return opened


def _buffer(pixels: np.ndarray) -> oiio.ImageBuf:
    return oiio.ImageBuf(np.ascontiguousarray(pixels, np.float32))


def _error(result: oiio.ImageBuf) -> str:
    """Return and clear a result's error, which OpenImageIO would print."""
    return str(result.geterror()) if result.has_error else ""
