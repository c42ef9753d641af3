"""Clear sky and sun after Preetham, Shirley and Smits, 'A Practical Analytic Model for Daylight' (1999).

The sky is appendix A.2: Perez's distribution, and the luminance and chromaticity of the zenith. The sun is
appendix A.1 with the spectra of table 2: the radiance above the atmosphere, reduced by Rayleigh, aerosol and
ozone extinction. Mixed gases and water vapour are left out, as they absorb only beyond 690 nm.
"""

from functools import lru_cache

import numpy as np

# Appendix A.2: Perez coefficients A..E of Y, x, y as slope and offset in turbidity.
_PEREZ = np.array(
    [
        [[0.1787, -1.4630], [-0.3554, 0.4275], [-0.0227, 5.3251], [0.1206, -2.5771], [-0.0670, 0.3703]],
        [[-0.0193, -0.2592], [-0.0665, 0.0008], [-0.0004, 0.2125], [-0.0641, -0.8989], [-0.0033, 0.0452]],
        [[-0.0167, -0.2608], [-0.0950, 0.0092], [-0.0079, 0.2102], [-0.0441, -1.6537], [-0.0109, 0.0529]],
    ]
)
# Appendix A.2: zenith chromaticity x, y; rows T^2, T, 1; columns theta^3, theta^2, theta, 1.
_ZENITH = np.array(
    [
        [
            [0.00166, -0.00375, 0.00209, 0],
            [-0.02903, 0.06377, -0.03202, 0.00394],
            [0.11693, -0.21196, 0.06052, 0.25886],
        ],
        [
            [0.00275, -0.00610, 0.00317, 0],
            [-0.04214, 0.08970, -0.04153, 0.00516],
            [0.15346, -0.26756, 0.06670, 0.26688],
        ],
    ]
)
# Rec.709 primaries, white D65.
_XYZ_TO_REC709 = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.969266, 1.8760108, 0.041556],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)
SUN_RADIUS_DEG = 0.2665  # angular radius of the disc
SUN_SR = 2 * np.pi * (1 - np.cos(np.radians(SUN_RADIUS_DEG)))  # its solid angle
_SUN_NM = np.arange(380, 751, 10.0)  # wavelengths of the two tables below
# Table 2: radiance of the sun above the atmosphere, W / (cm2 um sr).
# fmt: off
_SUN = 10 * np.array([
    165.5, 162.3, 211.2, 258.8, 258.2, 242.3, 267.6, 296.6, 305.4, 300.6, 306.6, 288.3, 287.1, 278.2,
    271.0, 272.3, 263.6, 255.0, 250.6, 253.1, 253.5, 251.3, 246.3, 241.7, 236.8, 232.1, 228.2, 223.4,
    219.7, 215.3, 211.0, 207.3, 202.4, 198.7, 194.3, 190.7, 186.3, 182.6,
])
# Table 2: absorption of ozone, 1 / cm.
_OZONE = np.array([
    0, 0, 0, 0, 0, 0, 0, 0.003, 0.006, 0.009, 0.014, 0.021, 0.030, 0.040, 0.048, 0.063, 0.075, 0.085,
    0.103, 0.120, 0.120, 0.115, 0.125, 0.120, 0.105, 0.090, 0.079, 0.067, 0.057, 0.048, 0.036, 0.028,
    0.023, 0.018, 0.014, 0.011, 0.010, 0.009,
])
# fmt: on
_OZONE_CM = 0.35  # thickness of the ozone layer (appendix A.1)
_LUMENS_PER_WATT = 683.0  # at the peak of photopic vision


def preetham_sky(directions: np.ndarray, sun: np.ndarray, turbidity: float) -> np.ndarray:
    """Compute sky radiance [H, W, 3], linear Rec.709 (kcd/m2), without the disc of the sun.

    Directions below the horizon get the radiance of the horizon.
    """
    xyz = sky_xyz(directions, sun, turbidity)
    return np.asarray(np.clip(xyz @ _XYZ_TO_REC709.T.astype(xyz.dtype), 0, None))


def sky_xyz(directions: np.ndarray, sun: np.ndarray, turbidity: float) -> np.ndarray:
    """Compute sky radiance [..., 3] as CIE XYZ, Y in kcd/m2, along directions [..., 3]."""
    cos_theta = np.clip(directions[..., 1], 0.01, 1)  # B / cos(theta) diverges at the horizon
    cos_gamma = np.clip(directions @ sun, -1, 1)
    sun_theta = np.arccos(np.clip(sun[1], 0, 1))
    chi = (4 / 9 - turbidity / 120) * (np.pi - 2 * sun_theta)
    zenith_y = max((4.0453 * turbidity - 4.9710) * np.tan(chi) - 0.2155 * turbidity + 2.4192, 0.1)
    powers_t, powers_theta = turbidity ** np.array([2, 1, 0]), sun_theta ** np.array([3, 2, 1, 0])
    zenith = np.array([zenith_y, *(powers_t @ _ZENITH @ powers_theta)])
    values = []
    gamma = np.arccos(cos_gamma)
    for level, slopes in zip(zenith, _PEREZ, strict=True):
        perez = [float(value) for value in slopes @ [turbidity, 1.0]]
        at_zenith = _perez(perez, 1.0, float(sun_theta), float(np.cos(sun_theta)))
        values.append(_perez(perez, cos_theta, gamma, cos_gamma) * float(level / at_zenith))
    luminance, x, y = values
    return np.stack([x / y, np.ones_like(x), (1 - x - y) / y], -1) * luminance[..., None]


def _perez(
    c: list[float],
    cos_theta: np.ndarray | float,
    gamma: np.ndarray | float,
    cos_gamma: np.ndarray | float,
) -> np.ndarray:
    """Perez's distribution, equation 3 of the paper."""
    haze = 1 + c[2] * np.exp(c[3] * gamma) + c[4] * cos_gamma**2
    return np.asarray((1 + c[0] * np.exp(c[1] / cos_theta)) * haze)


def sun_irradiance(elevation_deg: float, turbidity: float) -> np.ndarray:
    """Compute the irradiance [3] on a plane across the sunlight, linear Rec.709 (klx)."""
    xyz = _sun_to_xyz() @ (transmittance(_SUN_NM, elevation_deg, turbidity) * _SUN)
    return np.asarray(np.clip(_XYZ_TO_REC709 @ xyz, 0, None))


def transmittance(wavelength_nm: np.ndarray, elevation_deg: float, turbidity: float) -> np.ndarray:
    """Compute the share of sunlight [W] that reaches the ground at each wavelength [W] (appendix A.1)."""
    theta_deg, um = 90 - elevation_deg, wavelength_nm / 1000
    air_mass = 1 / (np.cos(np.radians(theta_deg)) + 0.15 * (93.885 - theta_deg) ** -1.253)
    beta = 0.04608365822050 * turbidity - 0.04586025928522  # Angstrom's turbidity coefficient
    ozone = np.interp(wavelength_nm, _SUN_NM, _OZONE) * _OZONE_CM
    return np.asarray(np.exp(-air_mass * (0.008735 * um**-4.08 + beta * um**-1.3 + ozone)))


@lru_cache(maxsize=1)
def _sun_to_xyz() -> np.ndarray:
    """Matrix [3, W] from the spectral radiance of the sun (table 2) to its XYZ irradiance in klx."""
    per_nm = SUN_SR * 10.0  # from W / (cm2 um sr) over the disc to W / (m2 nm)
    step_nm = _SUN_NM[1] - _SUN_NM[0]
    return np.asarray(_LUMENS_PER_WATT / 1000 * per_nm * step_nm * _colour_matching(_SUN_NM))


def _colour_matching(wavelength_nm: np.ndarray) -> np.ndarray:
    """CIE 1931 colour matching functions [3, W] at wavelengths [W].

    They are the multi-lobe fit of Wyman, Sloan and Shirley, 'Simple Analytic Approximations to the CIE XYZ
    Color Matching Functions', JCGT 2(2), 2013.
    """
    x = _lobe(wavelength_nm, 1.056, 599.8, 37.9, 31.0) + _lobe(wavelength_nm, 0.362, 442.0, 16.0, 26.7)
    x = x + _lobe(wavelength_nm, -0.065, 501.1, 20.4, 26.2)
    y = _lobe(wavelength_nm, 0.821, 568.8, 46.9, 40.5) + _lobe(wavelength_nm, 0.286, 530.9, 16.3, 31.1)
    z = _lobe(wavelength_nm, 1.217, 437.0, 11.8, 36.0) + _lobe(wavelength_nm, 0.681, 459.0, 26.0, 13.8)
    return np.stack([x, y, z])


def _lobe(nm: np.ndarray, height: float, middle: float, left: float, right: float) -> np.ndarray:
    return np.asarray(height * np.exp(-0.5 * ((nm - middle) / np.where(nm < middle, left, right)) ** 2))
