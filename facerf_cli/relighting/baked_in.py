"""Light of the photo that is baked into albedo: shade and glare that networks leave in skin.

Where the photo's key does not reach skin, or skin glares in it, the photo tells little of its albedo. What is
finer there than a pixel of the maps stays, what is coarser becomes that of the skin around, in colour, too.
Glare is brighter and whiter than the skin around (the dichromatic model: Shafer, *Using color to separate
reflection components*, 1985), so that of grey photos is not known.
"""

import torch
from torch import Tensor

from facerf_cli.network.inputs import is_grey
from facerf_cli.raster.texture import blurred, blurred_within, smoothstep

_FINE, _NEAR, _AROUND = 1 / 224, 1 / 28, 1 / 10  # standard deviations of blurs, in sides
_SURE = (0.6, 0.9)  # share of skin from which on a pixel counts, and counts whole
_BRIGHT = 0.9  # quantile of the key on skin
_HARD = (0.5, 0.8)  # share of the key, up to which light is soft, and from which on it is hard
_LIT = (0.2, 0.6)  # key over that, up to which skin lies in shade, and from which on it does not
_WHITER = (0.02, 0.1)  # share of added white from which on skin glares, and surely does
_BRIGHTER = (0.0, 0.2)  # log of its brightness over that around, likewise
_LEAST = 0.01  # share of plain skin around, below which nothing is known of it
_MOST = 1.5  # log of a factor
_TINY = 1e-6


def without_baked_in(albedo: Tensor, photo: Tensor, skin: Tensor, key: Tensor, share: float) -> Tensor:
    """Factors [3, S, S] of an albedo [3, S, S], where skin then has neither shade nor glare of the photo.

    The photo [3, S, S] is scene-linear, `skin` [S, S] the share of bare skin; `key` [S, S] is what the
    photo's key light does to a white surface there, `share` what it is of the photo's light: in soft light
    albedo has neither.
    """
    sure, skin = skin > _SURE[1], _ramp(skin, _SURE)
    if not sure.any():
        return torch.ones_like(albedo)
    side = photo.shape[-1]
    shade = 1 - _ramp(key / torch.quantile(key[sure], _BRIGHT).clamp_min(_TINY), _LIT)
    baked = _ramp(torch.tensor(share), _HARD) * torch.maximum(shade, _glare(photo, skin * (1 - shade)))
    logs = albedo.clamp_min(1e-4).log()
    coarse = blurred_within(logs, skin, _FINE * side)
    plain = (skin * (1 - baked)) ** 4
    around = blurred_within(logs, plain, _AROUND * side)
    (near,) = blurred(plain[None], _AROUND * side)
    baked = baked * near / (near + _LEAST)
    return (skin * baked * (around - coarse)).clamp(-_MOST, _MOST).exp()


def _glare(photo: Tensor, skin: Tensor) -> Tensor:
    """The certainty [S, S] that skin glares: colours are those around, and white besides."""
    if is_grey(photo):
        return torch.zeros_like(skin)
    near, around = (blurred_within(photo, skin, blur * photo.shape[-1]) for blur in (_FINE, _NEAR))
    colour, white = around / around.sum(0).clamp_min(_TINY), torch.full_like(around, 1 / 3)
    of_white, of_colour, mixed = ((x * y).sum(0) for x, y in ((near, white), (near, colour), (colour, white)))
    square = (colour * colour).sum(0)
    added = (of_white * square - of_colour * mixed) / (square / 3 - mixed**2).clamp_min(1e-4)
    share = added / near.sum(0).clamp_min(_TINY)
    brighter = (near.sum(0).clamp_min(_TINY) / around.sum(0).clamp_min(_TINY)).log()
    return _ramp(share, _WHITER) * _ramp(brighter, _BRIGHTER)


def _ramp(values: Tensor, ends: tuple[float, float]) -> Tensor:
    """0 up to the first end, 1 from the second on."""
    return smoothstep((values - ends[0]) / (ends[1] - ends[0]))
