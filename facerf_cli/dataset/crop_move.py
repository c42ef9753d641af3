"""Random moves of training crops: at test time a crop is cut around a detector's box, not around landmarks.

The spreads are those of `face.crop.from_box` against `face.crop.from_landmarks` on synthetic people in eight
cameras (`benchmarks/crop_boxes.py`): a detector's box is off to the side where a head is turned.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.network.inputs import resize

_LOG_SCALE, _SHIFT = 0.07, (0.1, 0.03)  # standard deviations; shifts right and down in sides of the crop
_MOST = 2.0  # standard deviations


@dataclass(frozen=True)
class CropMove:
    """A scale about a crop's centre, then a shift (right, down) in units of its side.

    The crop's camera is fixed: the face moves within the image, as if the box had been another.
    """

    scale: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)

    @staticmethod
    def draw(generator: torch.Generator) -> "CropMove":
        """Draw a random move."""
        size, right, down = torch.randn(3, generator=generator).clamp(-_MOST, _MOST).tolist()
        return CropMove(float(torch.tensor(_LOG_SCALE * size).exp()), (_SHIFT[0] * right, _SHIFT[1] * down))

    def points(self, share: Tensor) -> Tensor:
        """Move points [..., 2] in units of the crop's side."""
        return (share - 0.5) * self.scale + 0.5 + share.new_tensor(self.shift)

    def image(self, images: Tensor, side: int) -> Tensor:
        """Resample crops [B, C, S, S] to [B, C, side, side]; beyond their border the edge pixels repeat."""
        if self == UNMOVED:
            return resize(images, side)
        right, down = self.shift
        # from the moved crop to the given one, in -1..1
        back = images.new_tensor([[1, 0, -2 * right], [0, 1, -2 * down]]) / self.scale
        grid = F.affine_grid(back[None].expand(len(images), -1, -1), [len(images), 1, side, side], False)
        small = resize(images, side) if images.shape[-1] > side else images  # averages before it samples
        return F.grid_sample(small, grid, padding_mode="border", align_corners=False)


UNMOVED = CropMove()
