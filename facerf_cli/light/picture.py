"""Estimate the light from an image without a face.

An image covers a sixth of the sphere, behind the person, and little of it lights the face. The image is used
where it is known. A small network estimates the rest: light from above outdoors, from windows and ceilings
indoors. It is trained on procedural skies, rooms, studios, nights and stages as seen by a camera
(`tools/picture_network.py`). It predicts the logarithm of radiance over the mean in spherical harmonics, so
the light is positive and in the image's units.
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
FOV_DEG = 60.0  # default horizontal angle of view
ROWS, COLUMNS = 32, 48  # of the network's input, for any aspect ratio
_MAP_ROWS = 128
_ORDER, _COLOUR_ORDER, _CHANNELS, _CODE = 4, 1, 24, 96
_DARK, _CLIPPED = 0.02, 0.985  # added to radiance over the mean; display value of a clipped pixel
_KEPT_COLOUR = 0.7  # exponent of the light's mean colour
_MOST = 8.0  # largest logarithm of radiance over the mean
_SEAM = 0.15  # fraction of the image's width and height over which it fades into the estimate


@dataclass(frozen=True, eq=False)
class PictureLight:
    """The estimated light of an image.

    Attributes:
        envmap: Lat-long map [128, 256, 3], scene-linear, in the image's units; its centre is at -z.
        error: Expected error of the light: the RMS difference between the irradiance of a white diffuse ball
            under it, at the best exposure, and under the true light, relative to the latter's RMS.
    """

    envmap: Tensor
    error: float


@torch.inference_mode()
def light_of_picture(picture: Tensor, fov_deg: float = FOV_DEG) -> PictureLight:
    """Estimate the light from an image.

    Args:
        picture: [H, W, 3], scene-linear Rec.709.
        fov_deg: Horizontal angle of view, 1 to 170 degrees, otherwise ValueError.
    """
    if not 1 <= fov_deg <= 170:
        raise ValueError(f"the angle of view is {fov_deg:g} degrees; use 1 to 170")
    height, width = picture.shape[:2]
    half_width = math.tan(math.radians(fov_deg / 2))
    tangents = torch.tensor([half_width, half_width * height / width])
    pixels = picture.permute(2, 0, 1)[None].float().clamp_min(0)
    directions = latlong_directions(_MAP_ROWS, 2 * _MAP_ROWS)
    network_input = F.interpolate(pixels.clamp_max(1), (ROWS, COLUMNS), mode="area")
    (estimate,), log_error = network()(network_input, tangents[None], directions)

    # Part of an image's colour comes from the objects in it.
    mean = (estimate * latlong_solid_angles(_MAP_ROWS, 2 * _MAP_ROWS)[..., None]).sum((0, 1))
    cast = mean / (mean @ mean.new_tensor(LUMINANCE))
    estimate = estimate * cast ** (_KEPT_COLOUR - 1)

    x, y, z = directions.unbind(-1)
    at = torch.stack([x, -y], -1) / (-z[..., None]).clamp_min(1e-6) / tangents
    rows = max(1, round(float(tangents[1]) * _MAP_ROWS / math.pi * 2))
    small = F.interpolate(pixels, (rows, max(1, round(rows * float(tangents[0] / tangents[1])))), mode="area")
    known = F.grid_sample(small, at[None], padding_mode="border", align_corners=False)[0].permute(1, 2, 0)
    weight = ((1 - at.abs().amax(-1)) / _SEAM).clamp(0, 1) * (z < 0)
    return PictureLight(torch.lerp(estimate, known, weight[..., None]), float(log_error.exp()))


class PictureLightNetwork(nn.Module):
    """Estimates the environment light from an image.

    Convolutions process the logarithm of radiance over the mean, display values, clipped pixels and the
    tangents of each pixel. A linear layer maps their code and the image's statistics to the harmonics.
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
        """Return radiance [B, ..., 3] in directions [..., 3], and the log of its expected error [B].

        `linear` [B, 3, 32, 48] is the image, scene-linear and 1 where clipped; `tangents` [B, 2] are those of
        half its horizontal and vertical angles of view.
        """
        weights = linear.new_tensor(LUMINANCE)
        mean = linear.mean((2, 3)).clamp_min(1e-4)
        level = (mean * weights).sum(1)
        logs = torch.log(linear / level[:, None, None, None] + _DARK)
        display = _encoded(linear)
        clipped = (display > _CLIPPED).float().mean(1, keepdim=True)
        down = -torch.linspace(-1, 1, ROWS, device=linear.device)[:, None].expand(ROWS, COLUMNS)
        across = torch.linspace(-1, 1, COLUMNS, device=linear.device).expand(ROWS, COLUMNS)
        positions = torch.stack([across, down]) * tangents[:, :, None, None]
        features = self.look(torch.cat([logs, display, clipped, positions], 1))
        statistics = [torch.log(mean / level[:, None]), level.log()[:, None]]
        statistics += [clipped.mean((1, 2, 3))[:, None], tangents.log(), logs.std((1, 2, 3))[:, None]]
        code = F.silu(self.code(torch.cat([features, *statistics], 1)))
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
    """Encode values in 0..1 as sRGB, with a finite gradient at 0."""
    return torch.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(1e-4) ** (1 / 2.4) - 0.055
    )


def network() -> PictureLightNetwork:
    """Load the trained network."""
    trained = PictureLightNetwork().eval().requires_grad_(False)
    trained.load_state_dict({name: values.float() for name, values in load_file(ASSET).items()})
    return trained
