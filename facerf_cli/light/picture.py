"""The light in a picture that shows nobody whose face would tell it: a guess.

A picture shows a sixth of the sphere, behind the person, and little of what lights the face. The picture is
kept where it is known. A small network fills in the rest, trained on drawn skies, rooms, studios, nights and
stages as a camera sees them (`tools/picture_network.py`): light from above outdoors, from windows and from
ceilings indoors. It predicts the logarithm of radiance, over the mean, in spherical harmonics: so the light
is positive and on the picture's scale.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor, nn

from facerf_cli.light.sh import sh_basis
from facerf_cli.light.sphere import LUMINANCE, latlong_directions, latlong_solid_angles

ASSET = Path(__file__).parents[1] / "assets" / "picture_light.safetensors"
FOV_DEG = 60.0  # of a picture that does not state its own
ROWS, COLUMNS = 32, 48  # of what the network sees of a picture, of any aspect
_MAP_ROWS = 128
_ORDER, _COLOUR_ORDER, _CHANNELS, _CODE = 4, 1, 24, 96
_DARK, _CLIPPED = 0.02, 0.985  # added to radiance over the mean; display value of a clipped pixel
_KEPT_COLOUR = 0.7  # power of the light's mean colour
_MOST = 8.0  # of the logarithm of radiance over the mean
_SEAM = 0.15  # of the picture's width and height, over which it fades into what is guessed


@dataclass(frozen=True, eq=False)
class PictureLight:
    """The guessed light of a picture.

    Attributes:
        envmap: Lat-long map [128, 256, 3], scene-linear, on the picture's scale; its centre is at -z.
        error: Expected error of the light: the RMS difference between the irradiance of a matte white ball
            under it, at the best exposure, and under the true light, relative to the latter's RMS.
    """

    envmap: Tensor
    error: float


@torch.inference_mode()
def light_of_picture(picture: Tensor, fov_deg: float = FOV_DEG) -> PictureLight:
    """Guess the light in a picture.

    Args:
        picture: [H, W, 3], scene-linear Rec.709.
        fov_deg: Angle of view across the picture's width; 1 to 170 degrees, else ValueError.
    """
    if not 1 <= fov_deg <= 170:
        raise ValueError(f"the angle of view is {fov_deg:g} degrees; give 1 to 170")
    height, width = picture.shape[:2]
    half_width = math.tan(math.radians(fov_deg / 2))
    tangents = torch.tensor([[half_width, half_width * height / width]])
    pixels = picture.permute(2, 0, 1)[None].float().clamp_min(0)
    directions = latlong_directions(_MAP_ROWS, 2 * _MAP_ROWS)
    guess, log_error = network()(
        F.interpolate(pixels.clamp_max(1), (ROWS, COLUMNS), mode="area"), tangents, directions
    )
    known, inside = _reprojected(pixels, tangents[0], directions)
    return PictureLight(torch.lerp(_less_coloured(guess[0]), known, inside), float(log_error.exp()))


def _less_coloured(envmap: Tensor) -> Tensor:
    """A map whose mean colour is nearer grey: part of a picture's colour is that of the things in it."""
    solid_angles = latlong_solid_angles(*envmap.shape[:2])[..., None]
    mean = (envmap * solid_angles).sum((0, 1))
    cast = mean / (mean @ mean.new_tensor(LUMINANCE))
    return envmap * cast ** (_KEPT_COLOUR - 1)


def _reprojected(pixels: Tensor, tangents: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """A picture [1, 3, h, w] in directions [H, W, 3] and how far it counts there [H, W, 1], 0 outside."""
    x, y, z = directions.unbind(-1)
    at = torch.stack([x, -y], -1) / (-z[..., None]).clamp_min(1e-6) / tangents
    rows = max(1, round(float(tangents[1]) * _MAP_ROWS / math.pi * 2))
    small = F.interpolate(pixels, (rows, max(1, round(rows * float(tangents[0] / tangents[1])))), mode="area")
    known = F.grid_sample(small, at[None], padding_mode="border", align_corners=False)[0].permute(1, 2, 0)
    inside = ((1 - at.abs().amax(-1)) / _SEAM).clamp(0, 1) * (z < 0)
    return known, inside[..., None]


class PictureLightNetwork(nn.Module):
    """A picture to the light all around it.

    Convolutions see the logarithm of radiance over the mean, display values, clipped pixels and each pixel's
    tangents; a linear layer of their code and of the picture's statistics gives the harmonics.
    """

    def __init__(self) -> None:
        super().__init__()
        c = _CHANNELS
        self.look = nn.Sequential(
            _halved(9, c), _halved(c, 2 * c), _halved(2 * c, 3 * c), nn.Flatten(), nn.Dropout(0.2)
        )
        self.code = nn.Linear(3 * c * (ROWS // 8) * (COLUMNS // 8) + 8, _CODE)
        self.out = nn.Linear(_CODE, 1 + (_ORDER + 1) ** 2 + 2 * (_COLOUR_ORDER + 1) ** 2)
        for values in self.out.parameters():
            nn.init.zeros_(values)

    def forward(self, linear: Tensor, tangents: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return radiance [B, ..., 3] in directions [..., 3], and the logarithm of its expected error [B].

        `linear` [B, 3, 32, 48] is the picture, scene-linear with 1 where it clips; `tangents` [B, 2] are
        those of half its angles of view, across and down.
        """
        weights = linear.new_tensor(LUMINANCE)
        mean = linear.mean((2, 3)).clamp_min(1e-4)
        level = (mean * weights).sum(1)
        logs = torch.log(linear / level[:, None, None, None] + _DARK)
        shown = _encoded(linear)
        clipped = (shown > _CLIPPED).float().mean(1, keepdim=True)
        down = -torch.linspace(-1, 1, ROWS, device=linear.device)[:, None].expand(ROWS, COLUMNS)
        across = torch.linspace(-1, 1, COLUMNS, device=linear.device).expand(ROWS, COLUMNS)
        places = torch.stack([across, down]) * tangents[:, :, None, None]
        seen = self.look(torch.cat([logs, shown, clipped, places], 1))
        facts = [torch.log(mean / level[:, None]), level.log()[:, None], clipped.mean((1, 2, 3))[:, None]]
        facts += [tangents.log(), logs.std((1, 2, 3))[:, None]]
        code = F.silu(self.code(torch.cat([seen, *facts], 1)))
        out = self.out(code)
        basis = math.sqrt(4 * math.pi) * sh_basis(directions, _ORDER)
        logs = basis @ out[:, 1 : 1 + basis.shape[-1]].T
        colours = out[:, 1 + basis.shape[-1] :].unflatten(1, (-1, 2))
        ratios = torch.einsum("...k,bkc->b...c", basis[..., : colours.shape[1]], colours)
        red, blue = ratios.unbind(-1)
        grey = logs.movedim(-1, 0)
        radiance = torch.exp(torch.stack([grey + red, grey, grey + blue], -1).clamp(-_MOST, _MOST))
        return radiance * mean.reshape(-1, *[1] * (directions.ndim - 1), 3), out[:, 0]


def _halved(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, 2, 1), nn.GroupNorm(4, outputs), nn.SiLU(),
        nn.Conv2d(outputs, outputs, 3, 1, 1), nn.GroupNorm(4, outputs), nn.SiLU(),
    )  # fmt: skip


def _encoded(linear: Tensor) -> Tensor:
    """Encode values in 0..1 as sRGB; with a finite gradient at 0."""
    return torch.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(1e-4) ** (1 / 2.4) - 0.055
    )


def network() -> PictureLightNetwork:
    """The trained network."""
    trained = PictureLightNetwork().eval().requires_grad_(False)
    trained.load_state_dict({name: values.float() for name, values in load_file(ASSET).items()})
    return trained
