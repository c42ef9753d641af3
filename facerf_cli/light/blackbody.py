"""The colour of a blackbody, for lights given by their colour temperature."""

import numpy as np

from facerf_cli.colour import REC709_CHROMATICITIES, luminance, rgb_to_xyz

COOLEST_K, HOTTEST_K = 1667.0, 25000.0  # of the formula
WHITE_K = 6504.0  # the correlated colour temperature of D65


def blackbody_rgb(kelvin: float) -> np.ndarray:
    """Linear Rec.709 [3] of a blackbody, of luminance 1; 1, 1, 1 at `WHITE_K`.

    The Planckian locus is a little greener than D65: colours are divided by that of `WHITE_K`. What is
    outside Rec.709, as of candles, is clipped.
    """
    rgb = (_unbalanced(kelvin) / _unbalanced(WHITE_K)).clip(min=0)
    balanced: np.ndarray = rgb / luminance(rgb)
    return balanced


def _unbalanced(kelvin: float) -> np.ndarray:
    x, y = _planckian_xy(kelvin)
    xyz = np.array([x / y, 1.0, (1 - x - y) / y])
    rgb: np.ndarray = np.linalg.solve(rgb_to_xyz(REC709_CHROMATICITIES), xyz)
    return rgb


def _planckian_xy(kelvin: float) -> tuple[float, float]:
    """Chromaticity of the Planckian locus.

    Kang et al., *Design of Advanced Color Temperature Control System for HDTV Applications*, 2002.
    """
    t = 1e3 / kelvin
    if kelvin <= 4000:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390
    if kelvin <= 2222:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif kelvin <= 4000:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    return x, y
