"""White balance, the colour of shade, and shading and highlights left in the albedo.

A photo shows only the product of light colour and skin colour, and networks attribute too much of it to the
light: under white light, skin turns ashen. But a camera has already balanced white. So under uniform white
light skin gets the chromaticity of the photo (`keep`). In a photo that is far from white, such as one taken
under sodium light, the estimated colour is removed (`neutral`), but only until skin has a colour that skin
can have. The gains are the same for all lights. Hair and cloth have their own gains, for the same light,
because networks keep more of their colour (`WhiteBalance`).

Where a photo's key light does not reach, skin is lit by other light: blue sky, a purple wall. Networks
attribute some of that colour to the skin, and under a new key light it shows as a stain. Therefore networks
see a photo in which shaded skin has the colour of lit skin (`without_colour_of_shade`). Brightness and detail
stay. The ratio image of each field uses the unmodified photo, so the original light still reproduces it.

Networks also leave shading and specular highlights in the albedo of skin. Where the photo's key light does
not reach skin, or skin has a highlight, the photo says little about the albedo. There, detail finer than a
pixel of the maps is kept, and the low frequencies, including colour, are replaced by those of the surrounding
skin (`without_baked_in`). Highlights are brighter and whiter than the skin around them (the dichromatic
model: Shafer, *Using color to separate reflection components*, 1985), so they cannot be detected in grey
photos.
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
from facerf_cli.relighting import BalanceMode

SURE = 0.9  # coverage of a class above which a pixel counts
_BLACK = 0.15  # fraction of the class's median brightness below which chromaticity is ignored
_BY_KEY = 0.6  # quantile of brightness; darker pixels may be lit by another light than the scene's key light
_LEAST = 500  # least number of pixels or texels with a chromaticity
_BALANCED, _FAR = 0.3, 0.8  # distance of the photo's skin from all colours of skin, in log chromaticity
BARE = [class_index(name) for name in ("skin", "ears", "neck", "hand")]
_GROUPS = [BARE, *([number] for number in range(1, len(CLASSES)) if number not in BARE)]
_SHADE_REACH = 0.03  # blur of colours as a fraction of the image side; finer detail, like freckles, is skin's
_SHADE = (0.3, 0.8)  # brightness relative to lit skin: below the first all is shade, above the second none
_MOST_SHADE = 4.0  # limit of a channel's change
_DARK = 0.01  # fraction of the brightness of lit skin below which chromaticity is ignored
_TINY = 1e-6
_FINE, _NEAR, _AROUND = 1 / 224, 1 / 28, 1 / 10  # standard deviations of blurs, fractions of the image side
_SKIN = (0.6, 0.9)  # coverage of skin at which a pixel begins to count, and counts fully
_BRIGHT = 0.9  # quantile of the key light on skin
_HARD = (0.5, 0.8)  # fraction of the key light: light is soft below the first, hard above the second
_LIT = (0.2, 0.6)  # key light over that quantile: skin is shaded below the first, lit above the second
_WHITER = (0.02, 0.1)  # fraction of added white at which a highlight begins, and is certain
_BRIGHTER = (0.0, 0.2)  # log brightness over the surroundings at which it begins, and is certain
_LEAST_PLAIN = 0.01  # fraction of plain skin around below which its albedo is unknown
_MOST_BAKED = 1.5  # limit of a factor's logarithm


@dataclass(frozen=True, eq=False)
class WhiteBalance:
    """White balance of a person."""

    gain: Tensor  # [3] of the face
    light: Tensor  # log chromaticity [2] of the light that is removed from the photo
    uniform_scale: float  # intensity of uniform light that reproduces the skin's brightness in the photo
    off_white: float = 0.0  # log chromaticity between the photo's skin and the nearest skin; mostly about 0
    mode: BalanceMode = "keep"

    @staticmethod
    def of(mode: BalanceMode, relit: Tensor, photo: Tensor, skin: Tensor) -> "WhiteBalance":
        """Return the white balance of a face from its photo [3, ...], scene-linear.

        `relit` [3, ...] is the face under uniform white light of radiance 1 / 4: the radiance that a surface
        without any occluder receives. `skin` [...] is the coverage of skin. Grey photos, and those where
        little skin has a chromaticity, are not changed.
        """
        chromas = _chromas(relit, photo, skin, mode)
        sums = [float(luminance((one * skin).flatten(1).sum(1).numpy())) for one in (photo, relit)]
        uniform_scale = sums[0] / max(4 * sums[1], 1e-6)
        if chromas is None:
            return WhiteBalance(torch.ones(3), torch.zeros(2), uniform_scale, mode=mode)
        of_relit, of_photo = chromas
        nearest = _nearest_skin(of_photo)
        off_white = float((of_photo - nearest).norm())
        wanted = of_photo
        if mode == "neutral":
            weight = smoothstep(torch.tensor((off_white - _BALANCED) / (_FAR - _BALANCED)))
            wanted = torch.lerp(nearest, _nearest_skin(of_relit), weight)
        return WhiteBalance(_gain(of_relit, wanted), of_photo - wanted, uniform_scale, off_white, mode)

    @property
    def is_strongly_coloured(self) -> bool:
        """Whether the photo's light certainly has a colour."""
        return self.off_white > (_BALANCED + _FAR) / 2

    def gains(self, relit: Tensor, photo: Tensor, classes: Tensor) -> Tensor:
        """Return gains [3, ...] of a whole person.

        `relit` [3, ...] is the person under uniform white light, the photo is [3, ...], and `classes` [C,
        ...] is the coverage of each class.
        """
        gains = torch.ones(len(CLASSES), 3)
        for group in _GROUPS:
            chromas = _chromas(relit, photo, classes[group].sum(0), self.mode)
            if chromas is not None:
                gains[group] = _gain(chromas[0], chromas[1] - self.light)
        person = classes[1:].sum(0).clamp_min(1e-6)
        return 1 + torch.einsum("k...,kc->c...", classes[1:] / person, gains[1:] - 1)


def _chromas(
    relit: Tensor, photo: Tensor, coverage: Tensor, mode: BalanceMode
) -> tuple[Tensor, Tensor] | None:
    """Return the median log chromaticities [2] of a class, relit and in the photo; None if it has none."""
    sure = coverage > SURE
    sure &= ~clipped(photo, sure).any(0)
    brightness = photo.mean(0)
    sure &= brightness > _BLACK * brightness[sure].median()
    if sure.sum() < _LEAST or is_grey(photo):
        return None
    if mode == "neutral":
        sure &= brightness >= torch.quantile(brightness[sure], _BY_KEY)
    return _chroma(relit[:, sure]), _chroma(photo[:, sure])


def _chroma(colours: Tensor) -> Tensor:
    """Return median log red / green and log blue / green [2] of colours [3, N]."""
    red, green, blue = colours.clamp_min(1e-6).log()
    return torch.stack([(red - green).median(), (blue - green).median()])


def _gain(start: Tensor, wanted: Tensor) -> Tensor:
    """Return the gain [3] from one log chromaticity [2] to another that keeps luminance."""

    def colour(chroma: Tensor) -> Tensor:
        rgb = torch.stack([chroma[0], chroma.new_zeros(()), chroma[1]]).exp()
        return rgb / float(luminance(rgb.numpy()))

    return colour(wanted) / colour(start)


def _nearest_skin(chroma: Tensor) -> Tensor:
    red, green, blue = skin_table()[0].flatten(1).log()
    known = torch.stack([red - green, blue - green], 1)  # [N, 2] of all skins
    return known[(known - chroma).norm(dim=1).argmin()]


def without_colour_of_shade(image: Tensor, skin: Tensor) -> Tensor:
    """Return factors [3, S, S] that give shaded skin in an image [3, S, S] the colour of lit skin.

    The image is scene-linear. `skin` [S, S] is the coverage of skin; without any skin the factors are 1.
    """
    image, skin = image.detach(), skin.detach()
    near, reach = 0.3 * _SHADE_REACH * image.shape[-1], _SHADE_REACH * image.shape[-1]
    brightness = image.mean(0)
    lit = (image * skin * brightness).sum((1, 2)) / (skin * brightness).sum().clamp_min(_TINY)
    level = blurred_within(brightness[None], skin, near)[0] / lit.mean().clamp_min(_TINY)
    shade = ((_SHADE[1] - level) / (_SHADE[1] - _SHADE[0])).clamp(0, 1)
    chroma = image / (brightness + _DARK * lit.mean()).clamp_min(_TINY)  # all pixels have equal weight
    colour = blurred_within(chroma, shade * skin, reach)
    typical = (lit / lit.mean().clamp_min(_TINY))[:, None, None]
    change = typical * colour.mean(0) / colour.clamp_min(_TINY)
    amount = blurred_within(shade[None], skin, near)[0] * (2 * skin).clamp(max=1)
    return change.clamp(1 / _MOST_SHADE, _MOST_SHADE) ** amount


def even_shade_of(image: Tensor, classes: Tensor) -> Tensor:
    """Return the factors for bare skin, by classes [C, S, S], in an image for the Portrait Network."""
    return without_colour_of_shade(image, classes[BARE].sum(0))


def without_baked_in(albedo: Tensor, photo: Tensor, skin: Tensor, key: Tensor, key_fraction: float) -> Tensor:
    """Return factors [3, S, S] that remove the photo's shading and highlights from an albedo [3, S, S].

    The photo [3, S, S] is scene-linear. `skin` [S, S] is the coverage of bare skin, `key` [S, S] the radiance
    of a white surface under the photo's key light, and `key_fraction` that light's fraction of all light. In
    soft light the factors are 1.
    """
    sure, skin = skin > _SKIN[1], _ramp(skin, _SKIN)
    if not sure.any():
        return torch.ones_like(albedo)
    side = photo.shape[-1]
    shade = 1 - _ramp(key / torch.quantile(key[sure], _BRIGHT).clamp_min(_TINY), _LIT)
    highlights = _highlights(photo, skin * (1 - shade))
    baked = _ramp(torch.tensor(key_fraction), _HARD) * torch.maximum(shade, highlights)
    logs = albedo.clamp_min(1e-4).log()
    coarse = blurred_within(logs, skin, _FINE * side)
    plain = (skin * (1 - baked)) ** 4
    around = blurred_within(logs, plain, _AROUND * side)
    (near,) = blurred(plain[None], _AROUND * side)
    baked = baked * near / (near + _LEAST_PLAIN)
    return (skin * baked * (around - coarse)).clamp(-_MOST_BAKED, _MOST_BAKED).exp()


def _highlights(photo: Tensor, skin: Tensor) -> Tensor:
    """Return the certainty [S, S] that skin has a highlight: the surrounding colour plus white."""
    if is_grey(photo):
        return torch.zeros_like(skin)
    near, around = (blurred_within(photo, skin, blur * photo.shape[-1]) for blur in (_FINE, _NEAR))
    colour, white = around / around.sum(0).clamp_min(_TINY), torch.full_like(around, 1 / 3)
    of_white, of_colour, mixed = ((x * y).sum(0) for x, y in ((near, white), (near, colour), (colour, white)))
    square = (colour * colour).sum(0)
    added = (of_white * square - of_colour * mixed) / (square / 3 - mixed**2).clamp_min(1e-4)
    whiter = added / near.sum(0).clamp_min(_TINY)
    brighter = (near.sum(0).clamp_min(_TINY) / around.sum(0).clamp_min(_TINY)).log()
    return _ramp(whiter, _WHITER) * _ramp(brighter, _BRIGHTER)


def _ramp(values: Tensor, ends: tuple[float, float]) -> Tensor:
    """Return a smooth step from 0 at the first end to 1 at the second."""
    return smoothstep((values - ends[0]) / (ends[1] - ends[0]))
