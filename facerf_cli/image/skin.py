"""Skin colour from pigments.

Skin has two layers in the model of Kubelka and Munk, an epidermis with melanin over an infinitely deep dermis
with blood (after Cotton and Claridge, *Developing a predictive model of human skin colouring*, 1996).
Saunderson's correction (1942) accounts for the boundary to the air.

Absorption: melanosomes (6.6e11 nm^-3.33 /cm) and bloodless skin after S. Jacques (*Skin optics summary*,
1998); pheomelanin (2.9e15 nm^-4.75 /cm) after Donner and Jensen (2006); its fraction of all melanin, the same
for all skin, after Del Bino et al. (2015); haemoglobin from S. Prahl's table (omlc.org, after Gratzer and
Kollias). Scattering: Jacques, *Optical properties of biological tissues: a review* (2013).
"""

import tomllib
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.image.colour import REC709_CHROMATICITIES, rgb_to_xyz

WAVELENGTHS_NM = np.arange(400, 721, 10.0)
_TABLES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_BLOOD_G_PER_L, _HAEMOGLOBIN_G_PER_MOL = 150.0, 64500.0  # haemoglobin in blood; its molar mass
_OXYGENATION = 0.70  # fraction of haemoglobin
_PHEOMELANIN_SHARE = 0.26  # fraction of melanin
_EPIDERMIS_CM = 0.006
_OUTSIDE_REFLECTION, _INSIDE_REFLECTION = 0.028, 0.5  # of diffuse light, at refractive index 1.4
MELANIN_MOST, BLOOD_MOST = 0.6, 0.2  # volume fractions at the ends of the table
_STEPS = 64  # of the table along each axis


def skin_reflectance(melanin: np.ndarray, blood: np.ndarray) -> np.ndarray:
    """Return the diffuse reflectance [..., 33] at `WAVELENGTHS_NM`, without surface gloss.

    melanin [...]: fraction of the epidermis's volume that is melanosomes; blood [...]: fraction of the
    dermis's volume that is blood.
    """
    nm = WAVELENGTHS_NM
    melanin, blood = melanin[..., None], blood[..., None]
    bloodless = 0.244 + 85.3 * np.exp(-(nm - 154) / 66.2)
    eumelanin, pheomelanin = 6.6e11 * nm**-3.33, 2.9e15 * nm**-4.75
    pigment = (1 - _PHEOMELANIN_SHARE) * eumelanin + _PHEOMELANIN_SHARE * pheomelanin
    epidermis = melanin * pigment + (1 - melanin) * bloodless
    oxy, deoxy = (np.array(_TABLES[name], float) for name in ("oxyhaemoglobin", "deoxyhaemoglobin"))
    molar = _OXYGENATION * oxy + (1 - _OXYGENATION) * deoxy
    whole_blood = np.log(10) * molar * _BLOOD_G_PER_L / _HAEMOGLOBIN_G_PER_MOL  # absorption per cm
    dermis = blood * whole_blood + (1 - blood) * bloodless
    # Kubelka-Munk reflectance of an infinitely deep layer; K = 2 mu_a, S = 3/4 mu_s'.
    ratio = 2 * dermis / (0.75 * (43.6 * (0.41 * (nm / 500) ** -4 + 0.59 * (nm / 500) ** -0.562)))
    below = 1 + ratio - np.sqrt(ratio * (ratio + 2))
    reflected, passed = _layer(
        epidermis, 66.7 * (0.29 * (nm / 500) ** -4 + 0.71 * (nm / 500) ** -0.689), _EPIDERMIS_CM
    )
    inside = reflected + passed**2 * below / (1 - reflected * below)
    return (1 - _OUTSIDE_REFLECTION) * (1 - _INSIDE_REFLECTION) * inside / (1 - _INSIDE_REFLECTION * inside)


def _layer(absorption: np.ndarray, scattering: np.ndarray, depth_cm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the Kubelka-Munk reflectance and transmittance of one layer."""
    back = 0.75 * scattering
    a = 1 + 2 * absorption / back
    b = np.sqrt(a * a - 1)
    sinh, cosh = np.sinh(b * back * depth_cm), np.cosh(b * back * depth_cm)
    return sinh / (a * sinh + b * cosh), b / (a * sinh + b * cosh)


def observer_weights() -> np.ndarray:
    """Return the matrix [33, 3] from reflectance at `WAVELENGTHS_NM` to XYZ under D65."""
    return np.array(_TABLES["observer"], float) / 100


@lru_cache(maxsize=1)  # thousands of spectra
def skin_table() -> Tensor:
    """Return linear Rec.709 [1, 3, blood, melanin] at steps that are uniform in the square root."""
    step = np.linspace(0, 1, _STEPS) ** 2
    blood, melanin = np.meshgrid(step * BLOOD_MOST, step * MELANIN_MOST, indexing="ij")
    xyz = skin_reflectance(melanin, blood) @ observer_weights()
    rgb = xyz @ np.linalg.inv(rgb_to_xyz(REC709_CHROMATICITIES)).T
    return torch.from_numpy(rgb).float().clamp_min(1e-3).permute(2, 0, 1)[None]


def skin_albedo(melanin: Tensor, blood: Tensor) -> Tensor:
    """Return skin colour [B, 3, H, W], linear Rec.709, from melanin and blood fractions [B, 1, H, W]."""
    at = torch.stack([melanin[:, 0] / MELANIN_MOST, blood[:, 0] / BLOOD_MOST], -1)
    at = 2 * at.clamp(0, 1).sqrt() - 1
    return F.grid_sample(skin_table().expand(len(at), -1, -1, -1), at, align_corners=True)
