"""Colour spaces by codes of primaries and transfer function (ITU-T H.273), as PNG, HEIF and films have.

Films, and the images that ffmpeg takes from them, hold display values whatever camera curve they state: codes
of BT.709 and BT.601 are read by the sRGB curve, alike in both. BT.2020 is read by its own curve.
"""

from collections.abc import Callable

import numpy as np

from facerf_cli.image.colour import (
    DISPLAY_P3,
    REC709_CHROMATICITIES,
    REC2020,
    SRGB,
    ColourSpace,
    colour_science,
    known_space,
    power_curve,
)

HDR_CURVES = {16: "PQ", 18: "HLG"}  # which are not read
_UNSPECIFIED = 2
_CURVES: dict[int, Callable[[np.ndarray], np.ndarray] | None] = {
    **dict.fromkeys((1, _UNSPECIFIED, 6, 13), SRGB.decode),
    4: power_curve(2.2),
    5: power_curve(2.8),
    8: None,  # linear
    **dict.fromkeys((14, 15), REC2020.decode),
}
_PRIMARIES = {  # that many files have, so that colour-science is not imported for them
    1: REC709_CHROMATICITIES,
    _UNSPECIFIED: REC709_CHROMATICITIES,
    9: REC2020.chromaticities,
    12: DISPLAY_P3.chromaticities,
}
_BLACK, _RANGE = 16 / 255, 219 / 255  # of the narrow range


def space_of_codes(primaries: int, transfer: int, full_range: bool = True) -> ColourSpace | None:
    """Return the colour space of two code points, with its usual name if it has one; None if unknown."""
    chromaticities = _chromaticities(primaries)
    if chromaticities is None or transfer not in _CURVES:
        return None
    decode = _CURVES[transfer]
    if not full_range:
        curve = decode or (lambda values: values)
        return ColourSpace(
            f"CICP {primaries}-{transfer}, narrow range",
            chromaticities,
            lambda encoded: curve((encoded - _BLACK) / _RANGE),
        )
    return known_space(ColourSpace(f"CICP {primaries}-{transfer}", chromaticities, decode))


def _chromaticities(primaries: int) -> tuple[float, ...] | None:
    if primaries in _PRIMARIES:
        return _PRIMARIES[primaries]
    codes = colour_science().models.rgb.itut_h_273
    try:
        points = *codes.COLOUR_PRIMARIES_ITUTH273[primaries], codes.CCS_WHITEPOINTS_ITUTH273[primaries]
        return tuple(round(float(value), 4) for value in np.vstack(points).ravel())
    except (KeyError, TypeError, ValueError):  # reserved
        return None
