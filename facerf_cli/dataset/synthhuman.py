"""SynthHuman (Microsoft, *DAViD*, ICCV 2025; CDLA-Permissive-2.0): rendered people with their alpha.

    rgb_0000000.png alpha_0000000.png    beside depth, normals and cameras, which are not read

Nothing says where its heads are, and its people have no classes: they teach what is person and what is
background.
"""

from pathlib import Path

import torch
import torch.nn.functional as F

from facerf_cli.errors import InputError
from facerf_cli.files.read import read_image
from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.portrait.parse import LANDMARKS
from facerf_cli.synth.bank.parsing import PortraitCrops
from facerf_cli.synth.random_fields import Uniform

LICENCE = "SynthHuman: CDLA-Permissive-2.0"
_SMALLEST = 0.5  # crop, in shorter sides of the image


class SynthHuman:
    """The images of a folder, and of folders in it, read when they are drawn."""

    def __init__(self, folder: Path) -> None:
        self.paths = sorted(folder.rglob("rgb_*.png"))
        if not self.paths:
            raise InputError(f"{folder}: has no rgb_*.png; give a folder of SynthHuman, unpacked")

    def draw(self, side: int, generator: torch.Generator) -> PortraitCrops:
        """Draw one crop [1, ...] of a random image, mirrored or not."""
        path = self.paths[int(torch.randint(len(self.paths), (), generator=generator))]
        alpha_path = path.with_name(path.name.replace("rgb_", "alpha_", 1))
        image = linear_to_srgb(read_image(path).pixels)
        alpha = read_image(alpha_path, "linear").pixels[..., :1]
        if alpha.shape[:2] != image.shape[:2]:
            raise InputError(f"{alpha_path}: is not of the size of {path.name}; unpack the set again")
        layers = torch.cat([torch.from_numpy(part).float() for part in (image, alpha)], 2).permute(2, 0, 1)
        height, width = layers.shape[1:]
        side_px = round(min(height, width) * float(Uniform(generator)(_SMALLEST, 1)))
        room = height - side_px + 1, width - side_px + 1
        top, left = (int(torch.randint(most, (), generator=generator)) for most in room)
        crop = layers[:, top : top + side_px, left : left + side_px]
        crop = F.interpolate(crop[None], (side, side), mode="bilinear", antialias=True)[0].clamp(0, 1)
        if torch.rand((), generator=generator) < 0.5:
            crop = crop.flip(-1)
        return PortraitCrops(
            crops=crop[None, :3],
            alpha=crop[None, 3],
            label=torch.full((1, side, side), -1),
            weight=torch.ones(1, side, side),
            landmarks=torch.full((1, LANDMARKS, 2), 0.5),
            known=torch.zeros(1, LANDMARKS, dtype=torch.bool),
            present=torch.ones(1),
        )
