"""Colours from pigments: skin from melanin and blood, hair from its two melanins.

Skin has two layers in the model of Kubelka and Munk, an epidermis with melanin over an infinitely deep dermis
with blood (after Cotton and Claridge, *Developing a predictive model of human skin colouring*, 1996).
Saunderson's correction (1942) accounts for the boundary to the air.

Absorption: melanosomes (6.6e11 nm^-3.33 /cm) and bloodless skin after S. Jacques (*Skin optics summary*,
1998); pheomelanin (2.9e15 nm^-4.75 /cm) after Donner and Jensen (2006); its fraction of all melanin, the same
in all skins, after Del Bino et al. (2015); haemoglobin from S. Prahl's table (omlc.org, after Gratzer and
Kollias). Scattering: Jacques, *Optical properties of biological tissues: a review* (2013).
"""

from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.colour import REC709_CHROMATICITIES, rgb_to_xyz

WAVELENGTHS_NM = np.arange(400, 721, 10.0)
# Molar extinction /(cm mol/l) at `WAVELENGTHS_NM`, from Prahl's table.
_OXYHAEMOGLOBIN = """
266232 466840 480360 246072 102580 62816 44480 33209.2 26629.2 23684.4 20932.8 20035.2 24202.4 39956.8 53236
43016 32613.2 44496 50104 14400.8 3200 1506 942 610 442 368 319.6 294 277.6 276 290 314 348
"""
_DEOXYHAEMOGLOBIN = """
223296 303956 407560 528600 413280 103292 23388.8 16156.4 14550 16684 20862 25773.6 31589.6 39036.4 46592
53412 53788 45072 37020 28324.4 14677.2 9443.6 6509.6 5148.8 4345.2 3750.12 3226.56 2795.12 2407.92 2051.96
1794.28 1540.48 1325.88
"""
# CIE 1931 observer times D65 at `WAVELENGTHS_NM` (ISO/CIE 11664), in percent of white: x y z | x y z ...
_OBSERVER = """
0.112 0.003 0.532 | 0.377 0.01 1.799 | 1.189 0.035 5.72 | 2.33 0.095 11.389 | 3.459 0.228 17.372 |
3.725 0.421 19.662 | 3.244 0.669 18.647 | 2.125 0.989 14.024 | 1.05 1.525 8.936 | 0.33 2.142 4.8 |
0.051 3.343 2.82 | 0.095 5.131 1.617 | 0.628 7.041 0.778 | 1.688 8.784 0.431 | 2.871 9.426 0.201 |
4.271 9.796 0.086 | 5.63 9.416 0.037 | 6.952 8.679 0.019 | 8.312 7.886 0.015 | 8.619 6.353 0.009 |
9.054 5.375 0.007 | 8.507 4.265 0.003 | 7.096 3.162 0.002 | 5.067 2.089 0 | 3.55 1.386 0 |
2.148 0.81 0 | 1.253 0.463 0 | 0.681 0.249 0 | 0.347 0.126 0 | 0.15 0.054 0 | 0.077 0.028 0 |
0.041 0.015 0 | 0.017 0.006 0
"""
_BLOOD_G_PER_L, _HAEMOGLOBIN_G_PER_MOL = 150.0, 64500.0  # haemoglobin in blood; its molar mass
_OXYGENATION = 0.70  # fraction of haemoglobin
_PHEOMELANIN_SHARE = 0.26  # fraction of melanin
_EPIDERMIS_CM = 0.006
_OUTSIDE_REFLECTION, _INSIDE_REFLECTION = 0.028, 0.5  # of diffuse light, at refractive index 1.4
MELANIN_MOST, BLOOD_MOST = 0.6, 0.2  # volume fractions at the ends of the table
_STEPS = 64  # of the table along each axis


def skin_reflectance(melanin: np.ndarray, blood: np.ndarray) -> np.ndarray:
    """Diffuse reflectance [..., 33] at `WAVELENGTHS_NM`, without the gloss of the surface.

    melanin [...]: fraction of the epidermis's volume that is melanosomes; blood [...]: fraction of the
    dermis's volume that is blood.
    """
    nm = WAVELENGTHS_NM
    melanin, blood = melanin[..., None], blood[..., None]
    bloodless = 0.244 + 85.3 * np.exp(-(nm - 154) / 66.2)
    eumelanin, pheomelanin = 6.6e11 * nm**-3.33, 2.9e15 * nm**-4.75
    pigment = (1 - _PHEOMELANIN_SHARE) * eumelanin + _PHEOMELANIN_SHARE * pheomelanin
    epidermis = melanin * pigment + (1 - melanin) * bloodless
    dermis = blood * _blood_absorption() + (1 - blood) * bloodless
    below = _infinite_layer(dermis, 43.6 * (0.41 * (nm / 500) ** -4 + 0.59 * (nm / 500) ** -0.562))
    reflected, passed = _layer(
        epidermis, 66.7 * (0.29 * (nm / 500) ** -4 + 0.71 * (nm / 500) ** -0.689), _EPIDERMIS_CM
    )
    inside = reflected + passed**2 * below / (1 - reflected * below)
    return (1 - _OUTSIDE_REFLECTION) * (1 - _INSIDE_REFLECTION) * inside / (1 - _INSIDE_REFLECTION * inside)


def _blood_absorption() -> np.ndarray:
    """Absorption [33] of whole blood, per cm."""
    oxy, deoxy = (np.array(text.split(), float) for text in (_OXYHAEMOGLOBIN, _DEOXYHAEMOGLOBIN))
    molar = _OXYGENATION * oxy + (1 - _OXYGENATION) * deoxy
    return np.log(10) * molar * _BLOOD_G_PER_L / _HAEMOGLOBIN_G_PER_MOL


def _infinite_layer(absorption: np.ndarray, scattering: np.ndarray) -> np.ndarray:
    """Kubelka-Munk reflectance of an infinitely deep layer; K = 2 mu_a, S = 3/4 mu_s'."""
    ratio = 2 * absorption / (0.75 * scattering)
    return 1 + ratio - np.sqrt(ratio * (ratio + 2))


def _layer(absorption: np.ndarray, scattering: np.ndarray, depth_cm: float) -> tuple[np.ndarray, np.ndarray]:
    """Kubelka-Munk reflectance and transmittance of one layer."""
    back = 0.75 * scattering
    a = 1 + 2 * absorption / back
    b = np.sqrt(a * a - 1)
    sinh, cosh = np.sinh(b * back * depth_cm), np.cosh(b * back * depth_cm)
    return sinh / (a * sinh + b * cosh), b / (a * sinh + b * cosh)


@lru_cache(maxsize=1)
def observer_weights() -> np.ndarray:
    """Matrix [33, 3] from reflectance at `WAVELENGTHS_NM` to XYZ under D65; white has the colour of D65."""
    return np.array(_OBSERVER.replace("|", " ").split(), float).reshape(-1, 3) / 100


@lru_cache(maxsize=1)
def _skin_table() -> Tensor:
    """Table [1, 3, steps of blood, steps of melanin] of linear Rec.709; steps are even in the square root."""
    step = np.linspace(0, 1, _STEPS) ** 2
    blood, melanin = np.meshgrid(step * BLOOD_MOST, step * MELANIN_MOST, indexing="ij")
    xyz = skin_reflectance(melanin, blood) @ observer_weights()
    rgb = xyz @ np.linalg.inv(rgb_to_xyz(REC709_CHROMATICITIES)).T
    return torch.from_numpy(rgb).float().clamp_min(1e-3).permute(2, 0, 1)[None]


def skin_albedo(melanin: Tensor, blood: Tensor) -> Tensor:
    """Colour [B, 3, H, W] of skin, linear Rec.709, from melanin and blood fractions [B, 1, H, W]."""
    at = torch.stack([melanin[:, 0] / MELANIN_MOST, blood[:, 0] / BLOOD_MOST], -1)
    at = 2 * at.clamp(0, 1).sqrt() - 1
    return F.grid_sample(_skin_table().expand(len(at), -1, -1, -1), at, align_corners=True)


def hair_albedo(eumelanin: Tensor, pheomelanin: Tensor, grey: Tensor) -> Tensor:
    """Colour [..., 3] of dense hair, linear Rec.709, from melanins [...] in the units of d'Eon et al.

    Absorption after d'Eon et al. (*An energy-conserving hair reflectance model*, 2011), colour of many fibres
    after Chiang et al. (*A practical and controllable hair and fur model*, 2016), plus a small reflection at
    the cuticles. Eumelanin 0.3 is blond, 1.3 brown, 8 black; grey in 0..1 is the fraction of white hair.
    """
    absorbed = eumelanin[..., None] * torch.tensor([0.419, 0.697, 1.37])
    absorbed = absorbed + pheomelanin[..., None] * torch.tensor([0.187, 0.4, 1.05])
    pigmented = torch.exp(-5.89 * absorbed.sqrt()) + torch.tensor([0.011, 0.0095, 0.0085])
    white = torch.tensor([0.44, 0.41, 0.36])
    return pigmented + grey[..., None] * (white - pigmented)
