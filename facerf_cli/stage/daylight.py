"""Clear sky and sun after Preetham, Shirley and Smits, 'A Practical Analytic Model for Daylight', 1999."""

import numpy as np

# Appendix A.2: Perez coefficients A..E of Y, x, y as slope and offset in turbidity.
_PEREZ = np.array(
    [
        [[0.1787, -1.4630], [-0.3554, 0.4275], [-0.0227, 5.3251], [0.1206, -2.5771], [-0.0670, 0.3703]],
        [[-0.0193, -0.2592], [-0.0665, 0.0008], [-0.0004, 0.2125], [-0.0641, -0.8989], [-0.0033, 0.0452]],
        [[-0.0167, -0.2608], [-0.0950, 0.0092], [-0.0079, 0.2102], [-0.0441, -1.6537], [-0.0109, 0.0529]],
    ]
)
# Zenith chromaticity x, y: rows T^2, T, 1; columns theta^3, theta^2, theta, 1.
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
_XYZ_TO_REC709 = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.969266, 1.8760108, 0.041556],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)
_RGB_UM = np.array([0.61, 0.55, 0.465])  # a wavelength for each channel
_SUN_KLX = 128.0  # illuminance above the atmosphere, across the beam


def preetham_sky(directions: np.ndarray, sun: np.ndarray, turbidity: float) -> np.ndarray:
    """Sky radiance [H, W, 3] linear Rec.709 (kcd/m2), without the sun's disc; the horizon's below it."""
    cos_theta = np.clip(directions[..., 1], 0.01, 1)  # B / cos diverges at the horizon
    cos_gamma = np.clip(directions @ sun, -1, 1)
    sun_theta = np.arccos(np.clip(sun[1], 0, 1))
    chi = (4 / 9 - turbidity / 120) * (np.pi - 2 * sun_theta)
    zenith_y = max((4.0453 * turbidity - 4.9710) * np.tan(chi) - 0.2155 * turbidity + 2.4192, 0.1)
    powers_t, powers_theta = turbidity ** np.array([2, 1, 0]), sun_theta ** np.array([3, 2, 1, 0])
    zenith = np.array([zenith_y, *(powers_t @ _ZENITH @ powers_theta)])
    values = []
    for level, slopes in zip(zenith, _PEREZ, strict=True):
        perez = slopes @ [turbidity, 1.0]
        values.append(level * _perez(perez, cos_theta, cos_gamma) / _perez(perez, 1.0, np.cos(sun_theta)))
    luminance, x, y = values
    xyz = np.stack([x / y, np.ones_like(x), (1 - x - y) / y], -1) * luminance[..., None]
    return np.asarray(np.clip(xyz @ _XYZ_TO_REC709.T, 0, None))


def _perez(c: np.ndarray, cos_theta: np.ndarray | float, cos_gamma: np.ndarray | float) -> np.ndarray:
    """Perez' distribution, equation 3 of the paper."""
    gamma = np.arccos(cos_gamma)
    haze = 1 + c[2] * np.exp(c[3] * gamma) + c[4] * cos_gamma**2
    return np.asarray((1 + c[0] * np.exp(c[1] / cos_theta)) * haze)


def sun_irradiance(elevation_deg: float, turbidity: float) -> np.ndarray:
    """Irradiance [3] across the sun's beam (unit: klx): Rayleigh and aerosol extinction of appendix A.1."""
    theta_deg = 90 - elevation_deg
    air_mass = 1 / (np.cos(np.radians(theta_deg)) + 0.15 * (93.885 - theta_deg) ** -1.253)
    beta = 0.04608 * turbidity - 0.04586
    depth = 0.008735 * _RGB_UM**-4.08 + beta * _RGB_UM**-1.3
    return np.asarray(_SUN_KLX * np.exp(-depth * air_mass))
