"""The colour of skin in the shade.

Where the key of a photo does not reach, skin is seen in other light: blue sky, a purple wall. Networks take
some of that colour for the skin's own, and under a new key it shows as a stain. So they see a photo whose
shaded skin has the colour of its lit skin. Brightness and detail stay; the correction of each field knows the
photo as it is, and gives it back in its own light.
"""

from torch import Tensor

from facerf_cli.raster.texture import blurred_within
from facerf_cli.relighting.white import BARE

_REACH = 0.03  # blur of colours, in sides: what is narrower, as freckles are, is the skin's own
_SHADE = (0.3, 0.8)  # brightness over that of lit skin, below which all is shade, and from which on none
_MOST = 4.0  # change of a channel
_NOISE = 0.01  # of the brightness of lit skin: what is darker has no colour of its own
_TINY = 1e-6


def without_colour_of_shade(image: Tensor, skin: Tensor) -> Tensor:
    """Factors [3, S, S] for a scene-linear image [3, S, S], where shaded skin gets the colour of lit skin.

    `skin` [S, S] is the share of skin; without any the factors are 1.
    """
    image, skin = image.detach(), skin.detach()
    near, reach = 0.3 * _REACH * image.shape[-1], _REACH * image.shape[-1]
    brightness = image.mean(0)
    lit = (image * skin * brightness).sum((1, 2)) / (skin * brightness).sum().clamp_min(_TINY)
    level = blurred_within(brightness[None], skin, near)[0] / lit.mean().clamp_min(_TINY)
    shade = ((_SHADE[1] - level) / (_SHADE[1] - _SHADE[0])).clamp(0, 1)
    even = image / (brightness + _NOISE * lit.mean()).clamp_min(_TINY)  # each pixel counts alike
    colour = blurred_within(even, shade * skin, reach)
    typical = (lit / lit.mean().clamp_min(_TINY))[:, None, None]
    change = typical * colour.mean(0) / colour.clamp_min(_TINY)
    amount = blurred_within(shade[None], skin, near)[0] * (2 * skin).clamp(max=1)
    return change.clamp(1 / _MOST, _MOST) ** amount


def even_shade_of(image: Tensor, classes: Tensor) -> Tensor:
    """Factors of bare skin, by classes [C, S, S], for an image that the Portrait Network is to see."""
    return without_colour_of_shade(image, classes[BARE].sum(0))
