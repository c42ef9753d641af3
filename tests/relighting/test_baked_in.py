"""Shade and glare that are baked into the albedo of skin."""

import torch
from torch import Tensor

from facerf_cli.relighting.baked_in import without_baked_in

SIDE = 224
SKIN = torch.tensor([0.5, 0.3, 0.22])
WHOLE, SPOT = torch.ones(SIDE, SIDE), (slice(100, 116), slice(100, 116))


def plain() -> Tensor:
    """Skin [3, S, S] with freckles a pixel wide."""
    image = SKIN[:, None, None].expand(3, SIDE, SIDE).clone()
    image[:, 3::8, 3::8] *= 0.7
    return image


def test_what_the_key_does_not_reach_becomes_as_the_skin_around_and_keeps_its_freckles() -> None:
    albedo, key = plain(), WHOLE.clone()
    key[SPOT] = 0
    albedo[:, *SPOT] *= torch.tensor([0.8, 0.6, 0.5])[:, None, None]
    found = albedo * without_baked_in(albedo, plain() * key.clamp_min(0.05), WHOLE, key, 1.0)
    middle = found[:, 104:112, 104:112]  # of which no pixel is near the border
    wanted = plain()[:, 104:112, 104:112].mean((1, 2))
    torch.testing.assert_close(middle.mean((1, 2)), wanted, rtol=0.03, atol=0)
    assert (found[:, 107, 107] / found[:, 111, 111] < 0.8).all()  # a freckle
    assert torch.equal(found[:, :, :64], albedo[:, :, :64])


def test_what_is_brighter_and_whiter_than_the_skin_around_is_glare() -> None:
    albedo, photo = plain(), plain()
    photo[:, *SPOT] += 0.15
    albedo[:, *SPOT] += 0.05
    found = albedo * without_baked_in(albedo, photo, WHOLE, WHOLE, 1.0)
    torch.testing.assert_close(found[:, 109, 109], SKIN, rtol=0.08, atol=0)


def test_bright_skin_of_its_colour_grey_photos_and_what_is_no_skin_stay_and_all_in_soft_light() -> None:
    one = torch.ones(3, SIDE, SIDE)
    lit, white = plain(), plain()
    lit[:, *SPOT] *= 1.6
    white[:, *SPOT] += 0.15
    grey = white.mean(0).expand(3, -1, -1)
    part, unlit = WHOLE.clone(), WHOLE.clone()
    part[SPOT], unlit[SPOT] = 0.5, 0
    for photo, skin, key, share in (
        (lit, WHOLE, WHOLE, 1.0),
        (grey, WHOLE, WHOLE, 1.0),
        (white, part, unlit, 1.0),
        (white, WHOLE, WHOLE, 0.4),
    ):
        torch.testing.assert_close(without_baked_in(photo, photo, skin, key, share), one, rtol=0, atol=1e-4)
