"""The photo's light in a person's colours: white balance, the colour of shade, shade and glare in the albedo.

The colour of a photo's light and that of its skin are known as a product alone, and networks take too much of
it for the light's: under white light skin turns ashen. But a camera has balanced white already. So under even
white light skin gets the chromaticity that the photo shows (`photo`). Of a photo that is far from white, as
by sodium light, the estimated colour is taken out (`scene`), but never further than to a colour that skin
has. The gains that do this are the same for all lights. Hair and cloth, of whose colour networks leave more,
have gains of their own, by the same light (`Balance`).

Where the key of a photo does not reach, skin is seen in other light: blue sky, a purple wall. Networks take
some of that colour for the skin's own, and under a new key it shows as a stain. So they see a photo whose
shaded skin has the colour of its lit skin (`without_colour_of_shade`). Brightness and detail stay; the
correction of each field knows the photo as it is, and gives it back in its own light.

Networks also leave shade and glare in the albedo of skin. Where the photo's key does not reach skin, or skin
glares in it, the photo tells little of its albedo. What is finer there than a pixel of the maps stays, what
is coarser becomes that of the skin around, in colour, too (`without_baked_in`). Glare is brighter and whiter
than the skin around (the dichromatic model: Shafer, *Using color to separate reflection components*, 1985),
so that of grey photos is not known.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from facerf_cli.image.colour import luminance
from facerf_cli.image.skin import skin_table
from facerf_cli.light.estimate import clipped
from facerf_cli.network.inputs import is_grey
from facerf_cli.portrait.parse import CLASSES, class_index
from facerf_cli.raster.texture import blurred, blurred_within, smoothstep
from facerf_cli.relighting import White

SURE = 0.9  # share of a class
_BLACK = 0.15  # of the median brightness of a class: what is darker has no colour of its own
_BY_KEY = 0.6  # quantile of it: what is darker may have the colour of another light than the scene's key
_LEAST = 500  # pixels or texels that have a colour
_BALANCED, _FAR = 0.3, 0.8  # difference of log chromaticities of a photo's skin from all colours of skin
BARE = [class_index(name) for name in ("skin", "ears", "neck", "hand")]
_GROUPS = [BARE, *([number] for number in range(1, len(CLASSES)) if number not in BARE)]
_SHADE_REACH = 0.03  # blur of colours, in sides: what is narrower, as freckles are, is the skin's own
_SHADE = (0.3, 0.8)  # brightness over that of lit skin, below which all is shade, and from which on none
_MOST_SHADE = 4.0  # change of a channel
_DARK = 0.01  # of the brightness of lit skin: what is darker has no colour of its own
_TINY = 1e-6
_FINE, _NEAR, _AROUND = 1 / 224, 1 / 28, 1 / 10  # standard deviations of blurs, in sides
_SKIN = (0.6, 0.9)  # share of skin from which on a pixel counts, and counts whole
_BRIGHT = 0.9  # quantile of the key on skin
_HARD = (0.5, 0.8)  # share of the key, up to which light is soft, and from which on it is hard
_LIT = (0.2, 0.6)  # key over that, up to which skin lies in shade, and from which on it does not
_WHITER = (0.02, 0.1)  # share of added white from which on skin glares, and surely does
_BRIGHTER = (0.0, 0.2)  # log of its brightness over that around, likewise
_LEAST_PLAIN = 0.01  # share of plain skin around, below which nothing is known of it
_MOST_BAKED = 1.5  # log of a factor


@dataclass(frozen=True, eq=False)
class Balance:
    """The gain [3] of a face, and the log chromaticity [2] of the light that is taken out of the photo.

    `even` is the brightness of even light, from all around, under which skin is as bright as in the photo.
    `off_white` is how far the photo's skin is from all colours of skin, in log chromaticity; in most photos
    about 0. `white` says whose colours are kept.
    """

    gain: Tensor
    light: Tensor
    even: float
    off_white: float = 0.0
    white: White = "photo"

    @staticmethod
    def of(white: White, relit: Tensor, photo: Tensor, skin: Tensor) -> "Balance":
        """The balance of a face relit [3, ...] by even white light, by its photo [3, ...], scene-linear.

        That light has the radiance 1 / 4: a surface that nothing shades receives that much of it.
        `skin` [...] is the share of skin. Grey photos, and those where little skin has a colour, keep theirs.
        """
        chromas = _chromas(relit, photo, skin, white)
        seen, lit = (float(luminance((one * skin).flatten(1).sum(1).numpy())) for one in (photo, relit))
        even = seen / max(4 * lit, 1e-6)
        if chromas is None:
            return Balance(torch.ones(3), torch.zeros(2), even, white=white)
        found, shown = chromas
        nearest = _nearest_skin(shown)
        off_white = float((shown - nearest).norm())
        wanted = shown
        if white == "scene":
            share = smoothstep(torch.tensor((off_white - _BALANCED) / (_FAR - _BALANCED)))
            wanted = torch.lerp(nearest, _nearest_skin(found), share)
        return Balance(_gain(found, wanted), shown - wanted, even, off_white, white)

    @property
    def is_far(self) -> bool:
        """True where the photo's light is certainly coloured."""
        return self.off_white > (_BALANCED + _FAR) / 2

    def gains(self, relit: Tensor, photo: Tensor, classes: Tensor) -> Tensor:
        """Gains [3, ...] of a person relit [3, ...] by even white light; the photo is [3, ...].

        classes [C, ...] are shares.
        """
        gains = torch.ones(len(CLASSES), 3)
        for group in _GROUPS:
            chromas = _chromas(relit, photo, classes[group].sum(0), self.white)
            if chromas is not None:
                gains[group] = _gain(chromas[0], chromas[1] - self.light)
        person = classes[1:].sum(0).clamp_min(1e-6)
        return 1 + torch.einsum("k...,kc->c...", classes[1:] / person, gains[1:] - 1)


def _chromas(relit: Tensor, photo: Tensor, share: Tensor, white: White) -> tuple[Tensor, Tensor] | None:
    """Median chromaticities [2] of what is surely of a class and has a colour: relit, and in the photo."""
    sure = share > SURE
    sure &= ~clipped(photo, sure).any(0)
    brightness = photo.mean(0)
    sure &= brightness > _BLACK * brightness[sure].median()
    if sure.sum() < _LEAST or is_grey(photo):
        return None
    if white == "scene":
        sure &= brightness >= torch.quantile(brightness[sure], _BY_KEY)
    return _chroma(relit[:, sure]), _chroma(photo[:, sure])


def _chroma(colours: Tensor) -> Tensor:
    """Median log red / green and log blue / green [2] of colours [3, N]."""
    red, green, blue = colours.clamp_min(1e-6).log()
    return torch.stack([(red - green).median(), (blue - green).median()])


def _gain(found: Tensor, wanted: Tensor) -> Tensor:
    """The gain [3] from a chromaticity [2] to another, which keeps luminance."""

    def colour(chroma: Tensor) -> Tensor:
        rgb = torch.stack([chroma[0], chroma.new_zeros(()), chroma[1]]).exp()
        return rgb / float(luminance(rgb.numpy()))

    return colour(wanted) / colour(found)


def _nearest_skin(chroma: Tensor) -> Tensor:
    red, green, blue = skin_table()[0].flatten(1).log()
    known = torch.stack([red - green, blue - green], 1)  # [N, 2] of all skins
    return known[(known - chroma).norm(dim=1).argmin()]


def without_colour_of_shade(image: Tensor, skin: Tensor) -> Tensor:
    """Factors [3, S, S] for a scene-linear image [3, S, S], where shaded skin gets the colour of lit skin.

    `skin` [S, S] is the share of skin; without any the factors are 1.
    """
    image, skin = image.detach(), skin.detach()
    near, reach = 0.3 * _SHADE_REACH * image.shape[-1], _SHADE_REACH * image.shape[-1]
    brightness = image.mean(0)
    lit = (image * skin * brightness).sum((1, 2)) / (skin * brightness).sum().clamp_min(_TINY)
    level = blurred_within(brightness[None], skin, near)[0] / lit.mean().clamp_min(_TINY)
    shade = ((_SHADE[1] - level) / (_SHADE[1] - _SHADE[0])).clamp(0, 1)
    even = image / (brightness + _DARK * lit.mean()).clamp_min(_TINY)  # each pixel counts alike
    colour = blurred_within(even, shade * skin, reach)
    typical = (lit / lit.mean().clamp_min(_TINY))[:, None, None]
    change = typical * colour.mean(0) / colour.clamp_min(_TINY)
    amount = blurred_within(shade[None], skin, near)[0] * (2 * skin).clamp(max=1)
    return change.clamp(1 / _MOST_SHADE, _MOST_SHADE) ** amount


def even_shade_of(image: Tensor, classes: Tensor) -> Tensor:
    """Factors of bare skin, by classes [C, S, S], for an image that the Portrait Network is to see."""
    return without_colour_of_shade(image, classes[BARE].sum(0))


def without_baked_in(albedo: Tensor, photo: Tensor, skin: Tensor, key: Tensor, share: float) -> Tensor:
    """Factors [3, S, S] of an albedo [3, S, S], where skin then has neither shade nor glare of the photo.

    The photo [3, S, S] is scene-linear, `skin` [S, S] the share of bare skin; `key` [S, S] is what the
    photo's key light does to a white surface there, `share` what it is of the photo's light: in soft light
    albedo has neither.
    """
    sure, skin = skin > _SKIN[1], _ramp(skin, _SKIN)
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
    baked = baked * near / (near + _LEAST_PLAIN)
    return (skin * baked * (around - coarse)).clamp(-_MOST_BAKED, _MOST_BAKED).exp()


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
