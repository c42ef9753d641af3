"""Parts of a photo that cover the skin of a face."""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.crop import Crop
from facerf_cli.image.strips import Band, enlarged
from facerf_cli.portrait.classes import CLASSES
from facerf_cli.portrait.parse import Seen
from facerf_cli.raster.camera import PIXEL_CENTRE

_OF_THE_FACE = ("skin", "brows", "eyes", "lips", "mouth", "beard", "ears", "neck")
_SURE = (0.35, 0.65)  # share of a pixel from which on it counts as covered, and as wholly covered


def uncovered(seen: Seen, crop: Crop) -> np.ndarray:
    """Share [S, S] of each pixel of a crop that shows the face itself, without hair, glasses or a hand.

    Outside of what the network saw it is 1.
    """
    return _shown(seen.classes, seen.square.to_share(_places(crop)))


def uncovered_in(classes: Tensor, size_px: tuple[int, int], crop: Crop) -> np.ndarray:
    """The share of `uncovered`, by the classes [C, h, w] of a whole photo of H x W pixels."""
    return _shown(classes, _places(crop) / (size_px[1], size_px[0]))


def uncovered_rows(classes: Tensor, size_px: tuple[int, int]) -> Band:
    """The same share [H, W] of the photo's own pixels, by the classes [C, h, w] of the whole photo."""
    covered = _covering(classes)[None].numpy()
    return lambda rows: _share_shown(enlarged(covered, size_px, rows)[0])


def _places(crop: Crop) -> np.ndarray:
    """Centres [S, S, 2] of a crop's pixels in the photo's."""
    centres = (np.arange(crop.size_px) + PIXEL_CENTRE) / crop.scale
    return np.stack(np.meshgrid(centres + crop.x0_px, centres + crop.y0_px), -1)


def _shown(classes: Tensor, shares: np.ndarray) -> np.ndarray:
    """Share of the face itself [S, S] at places [S, S, 2], in sides of the map of classes [C, h, w]."""
    grid = torch.from_numpy(2 * shares - 1).float()[None]
    sampled = F.grid_sample(_covering(classes)[None, None], grid, align_corners=False)[0, 0]
    return _share_shown(sampled.numpy())


def _covering(classes: Tensor) -> Tensor:
    """Share [h, w] of what is not of the face, by classes [C, h, w]."""
    own = torch.tensor([name in _OF_THE_FACE for name in CLASSES])
    return classes[~own].sum(0).float()


def _share_shown(covered: np.ndarray) -> np.ndarray:
    low, high = _SURE
    return (1 - (covered - low) / (high - low)).clip(0, 1)
