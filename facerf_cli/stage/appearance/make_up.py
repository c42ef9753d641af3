"""Make-up: lipstick, eye shadow and eyeliner laid over the skin's albedo."""

import torch
from torch import Tensor

from facerf_cli.stage.appearance.people import People, each
from facerf_cli.stage.appearance.window import Window, blobs, inside, mask, smooth


def make_up(albedo: Tensor, people: People, window: Window) -> Tensor:
    """The albedo [B, 3, T, T] with what each person wears."""
    colour = torch.stack([people.lipstick_red, people.lipstick_green, people.lipstick_blue], -1)
    cover = 0.8 * each(people.lipstick) * mask(window, "lips", 1.6, -0.3)
    own = albedo.mean(1, keepdim=True) / albedo.mean((1, 2, 3), keepdim=True).clamp_min(0.02)
    albedo = albedo + cover * (colour[..., None, None] * own.clamp(0.5, 1.2) - albedo)
    lids = blobs(window, 0.355, 0.285, 17, 0.42) * (1 - mask(window, "brows", 4.0))
    shade = each(colour.mean(-1)) * torch.tensor([0.55, 0.42, 0.45]).view(1, 3, 1, 1)
    cover = 0.8 * each(people.eye_shadow) * lids.clamp(0, 1)
    albedo = albedo + cover * (shade - albedo)
    beyond = inside(window, "eyes")
    line = smooth((beyond + 1.7) / 0.9) * smooth((0.8 - beyond) / 0.9)
    return albedo * (1 - 0.8 * each(people.eyeliner) * line)
