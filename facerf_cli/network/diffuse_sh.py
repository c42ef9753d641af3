"""Network of the diffuse baseline: it regresses albedo and a smooth light from the texture of a face.

The paper compares with Tewari et al., *MoFA: model-based deep convolutional face autoencoder for unsupervised
monocular reconstruction*, ICCV 2017 ('Results'). They assume Lambert's law and spherical harmonics of order
2, both regressed by a network, and so does this one. It differs in that it works in UV space with the fitted
normals, and that its albedo is a texture instead of a linear model's coefficients.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.light.sh import irradiance, sh_basis
from facerf_cli.light.sphere import rig_directions
from facerf_cli.network.base import Count, Down, SavedNetwork, Side, Widths
from facerf_cli.network.inputs import MEAN_RADIANCE, exposure_of, head_rotation, resize

ORDER = 2
COEFFICIENTS = (ORDER + 1) ** 2
_DARKEST = 1e-8  # least radiance, to keep the slope of the square root finite
_LOGIT_MARGIN = 0.01  # least distance of a radiance from black and white, for its logit
_GAIN = 0.5  # gain of the albedo's logit in an untrained network
_MAP_SIDE = 64  # of the stored normals of the mean face
_ROTATION_DIRECTIONS = 36  # samples of a light, used to rotate it: four per coefficient
_CONSTANT = math.sqrt(4 * math.pi)  # the coefficient of a constant envmap of radiance 1


@dataclass(frozen=True)
class DiffuseSettings:
    """Channels at each halving of the working side, and sizes of the branch that regresses the light."""

    side: Side = 128
    encoder_widths: Widths = (16, 32, 64, 96, 128)
    decoder_widths: Widths = (16, 24, 48, 64, 96)
    light_channels: Count = 24
    light_grid: Count = 8  # side to which the coarsest features are pooled for the light
    light_hidden: Count = 96


class DiffuseEstimate(NamedTuple):
    """Albedo A and light of B faces: radiance is A * exposure * E(n) / pi (E: `light.sh.irradiance`)."""

    albedo: Tensor  # [B, 3, T, T] in 0..1, with a mean near `MEAN_RADIANCE`
    coefficients: Tensor  # [B, 9, 3] in camera space, see light.sh.CONVENTION
    exposure: Tensor  # [B, 1, 1, 1] divisor of the texture, see `exposure_of`


class DiffuseNetwork(SavedNetwork):
    """Estimate albedo and light from T_s, N_s and the visibility of the texels."""

    kind_of_settings = DiffuseSettings
    mean_normals: Tensor
    directions: Tensor
    coefficients_of: Tensor

    def __init__(self, settings: DiffuseSettings = DiffuseSettings()) -> None:
        super().__init__(settings)
        enc, dec = settings.encoder_widths, settings.decoder_widths
        self.down = nn.ModuleList(
            Down(a, b, first=i == 0) for i, (a, b) in enumerate(zip((7, *enc), enc, strict=False))
        )
        coarser = (*dec[1:], enc[-1])
        self.up = nn.ModuleList(_SkipUp(coarser[i], dec[i], enc[i]) for i in range(len(dec)))
        self.albedo = nn.Conv2d(dec[0], 6, 3, padding=1)
        self.light = nn.Sequential(
            nn.AdaptiveAvgPool2d(settings.light_grid),
            nn.Conv2d(enc[-1], settings.light_channels, 1),
            nn.SiLU(),
            nn.Flatten(),
            nn.Linear(settings.light_channels * settings.light_grid**2, settings.light_hidden),
            nn.SiLU(),
            nn.Linear(settings.light_hidden, 3 * COEFFICIENTS),
        )
        self.register_buffer("mean_normals", torch.zeros(3, _MAP_SIDE, _MAP_SIDE))
        directions = rig_directions(_ROTATION_DIRECTIONS)
        self.register_buffer("directions", directions, persistent=False)
        inverse = torch.linalg.pinv(sh_basis(directions.double(), ORDER)).float()
        self.register_buffer("coefficients_of", inverse, persistent=False)

    def set_mean_face(self, normals: Tensor) -> None:
        """Store the mean face's normals [3, T, T], head frame, used to estimate a head's pose."""
        size = (_MAP_SIDE, _MAP_SIDE)
        self.mean_normals.copy_(F.normalize(F.interpolate(normals[None], size, mode="area")[0], dim=0))

    def forward(self, texture: Tensor, normals: Tensor, visible: Tensor) -> DiffuseEstimate:
        """Estimate from linear textures, camera-space normals [B, 3, T, T], visible [B, 1, T, T] in 0..1."""
        exposure = exposure_of(texture, visible)
        root = (texture / exposure).clamp_min(_DARKEST).sqrt()
        x = torch.cat([resize(field, self.settings.side) for field in (root, visible, normals)], 1)
        features = []
        for down in self.down:
            x = down(x)
            features.append(x)
        light = self.light(x).float().unflatten(1, (COEFFICIENTS, 3))
        for up, skip in zip(reversed(self.up), reversed(features), strict=True):
            x = up(x, skip)
        # The layer predicts the difference from a constant envmap, which makes a face show its albedo.
        ambient = _CONSTANT * F.one_hot(torch.zeros((), dtype=torch.long), COEFFICIENTS).to(light)
        light = self._to_camera(light + ambient[:, None], normals)
        return DiffuseEstimate(self._albedo(x, texture / exposure), light, exposure)

    def _albedo(self, features: Tensor, radiance: Tensor) -> Tensor:
        """Return the albedo at the texture's side from its radiance [B, 3, T, T] over the exposure.

        The network predicts a gain and a bias of the radiance's logit, which is about its logarithm except
        near 1: a gain of 1 divides by a shading, a gain of 0 replaces what is clipped or dark.
        """
        gain, bias = (resize(y, radiance.shape[-1]) for y in self.albedo(features).float().chunk(2, 1))
        mean = math.log(MEAN_RADIANCE / (1 - MEAN_RADIANCE))
        difference = radiance.clamp(_LOGIT_MARGIN, 1 - _LOGIT_MARGIN).logit() - mean
        return torch.sigmoid(mean + (_GAIN + gain) * difference + bias)

    def _to_camera(self, coefficients: Tensor, normals: Tensor) -> Tensor:
        """Rotate lights [B, 9, 3] from the head frame, where UV space is fixed, to camera space."""
        head_to_camera = head_rotation(self.mean_normals, normals).float()
        came_from = (self.directions[None, :, :, None] * head_to_camera[:, None]).sum(2)  # row by row: R^T d
        turn = (self.coefficients_of[None, :, :, None] * sh_basis(came_from, ORDER)[:, None]).sum(2)
        return (turn[..., None] * coefficients[:, None]).sum(2)  # autocast would halve a matmul's precision


def shading(normals: Tensor, coefficients: Tensor) -> Tensor:
    """Return the radiance [B, M, 3, T, T] of a white diffuse face: irradiance over pi, at least 0.

    normals [B, 3, T, T] and coefficients [B, M, 9, 3] are in the same space. Cast shadows are ignored.
    """
    faces = []
    for normal, lights in zip(normals, coefficients, strict=True):
        by_coefficient = lights.permute(1, 0, 2).flatten(1)  # [9, M 3]
        e = irradiance(normal.permute(1, 2, 0), by_coefficient).permute(2, 0, 1)
        faces.append(e.view(len(lights), 3, *e.shape[1:]))
    return torch.stack(faces).clamp_min(0) / math.pi


class _SkipUp(nn.Module):
    """Resize coarser features to the side of the skip, add it, then apply a residual convolution."""

    def __init__(self, channels_in: int, channels_out: int, skip_channels: int) -> None:
        super().__init__()
        self.enter = nn.Conv2d(channels_in, channels_out, 1)
        self.skip = nn.Conv2d(skip_channels, channels_out, 1)
        self.norm = nn.GroupNorm(4, channels_out)
        self.inner = nn.Conv2d(channels_out, channels_out, 3, padding=1)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        x = F.silu(self.norm(resize(self.enter(x), skip.shape[-1]) + self.skip(skip)))
        result: Tensor = x + F.silu(self.inner(x))
        return result
