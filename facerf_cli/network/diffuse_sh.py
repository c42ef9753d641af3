"""A face taken for diffuse under smooth light: one network regresses albedo and light from its texture.

The assumption is that of Tewari et al., *MoFA: model-based deep convolutional face autoencoder for
unsupervised monocular reconstruction*, ICCV 2017, which the paper compares with ('Results'): Lambert's law,
spherical harmonics of order 2, both regressed by a network. What it works on is facerf's own: the chart, the
fitted normals, and an albedo that is a map of texels where theirs is a vector of a linear model. It is an
honest form of the assumption, not those authors' network.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.light.sh import irradiance, sh_basis
from facerf_cli.light.sphere import rig_directions
from facerf_cli.network.reflectance import MEAN_RADIANCE, Down, exposure_of, head_rotation, resize

ORDER = 2
COEFFICIENTS = (ORDER + 1) ** 2
_DARKEST = 1e-8  # radiance at which the square root's slope is still finite
_DARK = 0.01  # from black and white, where the logit of a radiance ends
_GAIN = 0.5  # of an untaught network
_MAP_SIDE = 64  # of the mean face's normals
_TURNED_LIGHTS = 36  # directions in which a light is turned: four a coefficient
_CONSTANT = math.sqrt(4 * math.pi)  # the coefficient of a constant map of radiance 1
_MOST_WIDTH = 1024  # of a layer, in a checkpoint that is read


@dataclass(frozen=True)
class DiffuseSettings:
    """Channels at each halving of the working side, and of what the light is read off."""

    side: int = 128
    encoder_widths: tuple[int, ...] = (16, 32, 64, 96, 128)
    decoder_widths: tuple[int, ...] = (16, 24, 48, 64, 96)
    light_channels: int = 24
    light_grid: int = 8  # the side to which the coarsest features are pooled for the light
    light_hidden: int = 96


class DiffuseEstimate(NamedTuple):
    """B faces of albedo A under light c: radiance is A exposure E(n) / pi, E of `light.sh.irradiance`."""

    albedo: Tensor  # [B, 3, T, T] in 0..1, of a mean near `MEAN_RADIANCE`
    coefficients: Tensor  # [B, 9, 3] in camera space, by light.sh.CONVENTION
    exposure: Tensor  # [B, 1, 1, 1] what the texture was divided by, that its visible mean be MEAN_RADIANCE


class DiffuseNetwork(nn.Module):
    """T_s, N_s and what is seen of them -> DiffuseEstimate."""

    mean_normals: Tensor
    directions: Tensor
    coefficients_of: Tensor

    def __init__(self, settings: DiffuseSettings = DiffuseSettings()) -> None:
        super().__init__()
        self.settings = settings
        enc, dec = settings.encoder_widths, settings.decoder_widths
        self.down = nn.ModuleList(
            Down(a, b, first=i == 0) for i, (a, b) in enumerate(zip((7, *enc), enc, strict=False))
        )
        coarser = (*dec[1:], enc[-1])
        self.up = nn.ModuleList(_Up(coarser[i], dec[i], enc[i]) for i in range(len(dec)))
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
        directions = rig_directions(_TURNED_LIGHTS)
        self.register_buffer("directions", directions, persistent=False)
        inverse = torch.linalg.pinv(sh_basis(directions.double(), ORDER)).float()
        self.register_buffer("coefficients_of", inverse, persistent=False)

    def as_metadata(self) -> dict[str, Any]:
        """Form and settings, for a checkpoint."""
        return {"form": "default", **asdict(self.settings)}

    @classmethod
    def from_metadata(cls, metadata: dict[str, Any]) -> Self:
        """An untrained network of these; raises KeyError, TypeError or ValueError where they make none."""
        given = {k: v for k, v in metadata.items() if k != "form"}
        settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}
        made = DiffuseSettings(**settings)
        widths = (*made.encoder_widths, *made.decoder_widths, made.light_channels, made.light_grid)
        if not all(type(w) is int and 0 < w <= _MOST_WIDTH for w in (*widths, made.light_hidden)):
            raise ValueError(f"no diffuse network has the settings {metadata}")
        return cls(made)

    def set_mean_face(self, normals: Tensor) -> None:
        """Hold the mean face's normals [3, T, T], head frame, by which a face's turn is known."""
        size = (_MAP_SIDE, _MAP_SIDE)
        self.mean_normals.copy_(F.normalize(F.interpolate(normals[None], size, mode="area")[0], dim=0))

    def forward(self, texture: Tensor, normals: Tensor, visible: Tensor) -> DiffuseEstimate:
        """Of linear textures and camera-space normals [B, 3, T, T]; visible [B, 1, T, T] in 0..1."""
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
        # Where the head says 0, the face stands in a constant map, which shows it as it is.
        ambient = _CONSTANT * F.one_hot(torch.zeros((), dtype=torch.long), COEFFICIENTS).to(light)
        light = self._turned(light + ambient[:, None], normals)
        return DiffuseEstimate(self._albedo(x, texture / exposure), light, exposure)

    def _albedo(self, features: Tensor, radiance: Tensor) -> Tensor:
        """Albedo at the texture's own side, off radiance [B, 3, T, T] at the network's exposure.

        Gain and bias of the radiance's logit, which is its logarithm but near 1: a gain of 1 divides by a
        shading, a gain of 0 paints over what is clipped or in the dark.
        """
        gain, bias = (resize(y, radiance.shape[-1]) for y in self.albedo(features).float().chunk(2, 1))
        mean = math.log(MEAN_RADIANCE / (1 - MEAN_RADIANCE))
        away = radiance.clamp(_DARK, 1 - _DARK).logit() - mean
        return torch.sigmoid(mean + (_GAIN + gain) * away + bias)

    def _turned(self, coefficients: Tensor, normals: Tensor) -> Tensor:
        """Light [B, 9, 3] of the head's own frame, in which the chart sees it, in the camera's."""
        head_to_camera = head_rotation(self.mean_normals, normals).float()
        came_from = (self.directions[None, :, :, None] * head_to_camera[:, None]).sum(2)  # row by row: R^T d
        turn = (self.coefficients_of[None, :, :, None] * sh_basis(came_from, ORDER)[:, None]).sum(2)
        return (turn[..., None] * coefficients[:, None]).sum(2)  # sums: a product would be in half precision


def shading(normals: Tensor, coefficients: Tensor) -> Tensor:
    """What of its albedo a diffuse face shows [B, M, 3, T, T] in M lights: irradiance over pi, not below 0.

    normals [B, 3, T, T] and coefficients [B, M, 9, 3] of one space. Nothing shades another part of the face:
    that is the assumption.
    """
    faces = []
    for normal, lights in zip(normals, coefficients, strict=True):
        of_lights = lights.permute(1, 0, 2).flatten(1)  # [9, M 3]
        e = irradiance(normal.permute(1, 2, 0), of_lights).permute(2, 0, 1)
        faces.append(e.view(len(lights), 3, *e.shape[1:]))
    return torch.stack(faces).clamp_min(0) / math.pi


class _Up(nn.Module):
    """Take what is coarser to the skip's side, add the skip, then a convolution with a residual."""

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
