"""Parts of a photo that cover the skin of a face."""

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.face.crop import Crop
from facerf_cli.portrait.classes import CLASSES
from facerf_cli.portrait.parse import Seen
from facerf_cli.raster.camera import PIXEL_CENTRE

_OF_THE_FACE = ("skin", "brows", "eyes", "lips", "mouth", "beard", "ears", "neck")
_SURE = (0.35, 0.65)  # share of a pixel from which on it counts as covered, and as wholly covered


def uncovered(seen: Seen, crop: Crop) -> np.ndarray:
    """Share [S, S] of each pixel of a crop that shows the face itself, without hair, glasses or a hand.

    Outside of what the network saw it is 1.
    """
    own = torch.tensor([name in _OF_THE_FACE for name in CLASSES])
    covered = seen.classes[~own].sum(0)
    centres = (np.arange(crop.size_px) + PIXEL_CENTRE) / crop.scale
    x, y = np.meshgrid(centres + crop.x0_px, centres + crop.y0_px)
    grid = 2 * seen.square.to_share(np.stack([x, y], -1)) - 1
    sampled = F.grid_sample(
        covered[None, None].float(), torch.from_numpy(grid).float()[None], align_corners=False
    )[0, 0]
    low, high = _SURE
    return np.asarray((1 - (sampled - low) / (high - low)).clamp(0, 1).numpy())
