"""Where a light comes from, as one direction."""

import math

import torch
from torch import Tensor

from facerf_cli.light.rig_light import RigLight
from facerf_cli.light.sphere import latlong_directions

_BLUR_DEG = 12.0  # less than the paper's 150 lights are apart: 18 degrees
_ROWS = 90
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec.709


def brightest_direction(light: RigLight, front_only: bool = False) -> Tensor:
    """The unit direction [3] in which the light's luminance, blurred a little, is greatest; 0 if it is dark.

    Blurred by a von Mises-Fisher lobe, for a lamp between the lights of a rig is shared out among them.
    `front_only` leaves out what is behind the head's own plane (z < 0), of which shading says little.
    """
    luminance = light.weights.double() @ torch.tensor(_LUMINANCE, dtype=torch.float64)
    if front_only:
        luminance = luminance * (light.directions[:, 2] > 0)
    where = latlong_directions(_ROWS, 2 * _ROWS, torch.float64).reshape(-1, 3)
    sharpness = 1 / math.radians(_BLUR_DEG) ** 2
    blurred = torch.exp(sharpness * (where @ light.directions.double().T - 1)) @ luminance
    best = int(blurred.argmax())
    return (where[best] if blurred[best] > 0 else torch.zeros(3, dtype=torch.float64)).float()
