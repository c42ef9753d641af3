"""The white of a relit person.

The colour of a photo's light and that of its skin are known as a product alone, and networks take too much of
it for the light's: under white light skin turns ashen. But a camera has balanced white already. So under
even white light skin gets the chromaticity that the photo shows (`photo`). Of a photo that is far from
white, as by sodium light, the estimated colour is taken out (`scene`), but never further than to a colour
that skin has. The gains that do this are the same for all lights. Hair and cloth, of whose colour networks
leave more, have gains of their own, by the same light.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from facerf_cli.image.colour import luminance
from facerf_cli.image.skin import skin_table
from facerf_cli.light.estimate import clipped
from facerf_cli.network.inputs import is_grey
from facerf_cli.portrait.classes import CLASSES, class_index
from facerf_cli.raster.texture import smoothstep
from facerf_cli.relighting import White

SURE = 0.9  # share of a class
_BLACK = 0.15  # of the median brightness of a class: what is darker has no colour of its own
_BY_KEY = 0.6  # quantile of it: what is darker may have the colour of another light than the scene's key
_LEAST = 500  # pixels or texels that have a colour
_BALANCED, _FAR = 0.3, 0.8  # difference of log chromaticities of a photo's skin from all colours of skin
BARE = [class_index(name) for name in ("skin", "ears", "neck", "hand")]
_GROUPS = [BARE, *([number] for number in range(1, len(CLASSES)) if number not in BARE)]


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
