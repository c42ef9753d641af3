"""Transfer the detail of a photo to images that are relit at a lower resolution.

The maps of the portrait field and the texture of the face are coarser than the photo, and networks predict an
albedo with about half of the contrast that the photo shows at that resolution. Two factors restore it.
Neither depends on the light: relit images stay linear in the light, and shadows keep their edges.

`lost_detail` multiplies the albedo at the resolution of the maps. Colour is restored fully, because under
white light it belongs to the albedo. Luminance is restored where its local contrast is low, as in skin;
strong contrast is the edge of a shadow or a highlight, which the network has removed on purpose.

`finer_detail` multiplies the relit image. With the photo P and the same photo S at the resolution of the maps
it is (P + f) / (S + f) per channel; f is a small floor that keeps noise in dark pixels low. On skin, pixels
brighter than their surroundings are mostly highlights of the photo's light, and far darker ones belong to the
other side of an edge, for example at a collar: their factors are limited. Where skin is brighter and whiter
than the rest, it has a specular highlight (Shafer, *Using color to separate reflection components*, 1985),
and luminance detail fades.
"""

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.head import FaceTexture
from facerf_cli.face.topology import region_mask
from facerf_cli.face.view import FaceView
from facerf_cli.image.colour import luminance
from facerf_cli.image.strips import Window
from facerf_cli.raster.texture import Inpainting, blurred_within

NOISE = 0.03  # radiance of skin in the maps below which colour is noise, as a fraction of its mean
FLOOR = 0.01  # f, and the same limit in hair
_BRIGHTEST, _DARKEST = 0.25, 1.0  # limits of the logarithm of luminance factors on skin
_MOST_COLOUR = 1.5  # limit of a channel's factor over the luminance factor
_GLARE = 2.5  # loss of luminance detail per fraction of white in highlights
_GLARING = (0.9, 1.4)  # brightness over the mean of the skin at which highlights begin, and are certain
_PALE = 0.003  # keeps the fraction of white near 0 if the skin itself is nearly white
_STRONG = 0.2  # standard deviation of log luminance at which lost luminance is restored to 1 / e
_MOST_LOST = 0.7  # limit of the logarithm of lost detail
TINY = 1e-8
_LEAST_AROUND = 0.08  # least radiance of the skin that own regions are scaled by, as a fraction of its mean
_OWN_REGIONS = ("eyes", "mouth", "brows")  # regions of the face that are only scaled by the light around them
_CAVITY = 0.75  # fraction of the light on the lips that does not reach the teeth
_OWN_SIDE = 128  # side of their mask in texels; a finer mask takes seconds to draw


def contrast(image: Tensor, weight: Tensor, sigma_px: float, floor: Tensor | float) -> tuple[Tensor, Tensor]:
    """Return detail finer than a Gaussian blur of an image [3, S, S], as logarithms of ratios.

    The first tensor [1, S, S] is luminance, the second [3, S, S] is colour. Only pixels with a `weight` [S,
    S] above 0 take part; detail is 0 elsewhere. `floor` is the radiance below which colour is noise.
    """
    logs = (image + floor).clamp_min(TINY).log()
    detail = (logs - blurred_within(logs, weight, sigma_px)) * (weight > 0)
    grey = detail.mean(0, keepdim=True)
    return grey, detail - grey


def lost_detail(
    grey: Tensor, colour: Tensor, weight: Tensor, sigma_px: float, hair: Tensor | float = 0.0
) -> Tensor:
    """Return the factor [3, S, S] that adds detail to an albedo.

    `grey` [1, S, S] and `colour` [3, S, S] are the missing detail, as returned by `contrast`. In `hair`, a
    fraction [S, S], strong contrast comes from strands and is also restored.
    """
    power = blurred_within(grey**2, weight, sigma_px)
    faint = torch.exp(-power / _STRONG**2 * (1 - hair))
    return (colour + faint * grey).clamp(-_MOST_LOST, _MOST_LOST).exp()


def finer_detail(pixels: Tensor, coarse: Tensor, skin: Tensor, typical: Tensor) -> Tensor:
    """Return the factor [h, w, 3] that adds the detail of the photo to a relit image.

    Args:
        pixels: The photo [h, w, 3], scene-linear, not negative.
        coarse: The photo at the resolution of the relit maps [h, w, 3].
        skin: Fraction of skin [h, w, 1].
        typical: Mean radiance [3] of the skin.
    """
    floor = float(typical.mean()) * FLOOR
    pixels, coarse = pixels + floor, coarse.clamp_min(0) + floor
    weights = torch.from_numpy(luminance(np.eye(3, dtype=np.float32)))
    grey = (pixels @ weights / (coarse @ weights))[..., None]
    logs = grey.log()
    limited = torch.minimum(logs, _BRIGHTEST * (logs / _BRIGHTEST).tanh()).clamp_min(-_DARKEST)
    limited = limited * (1 - _specular_fraction(coarse, typical))
    colour = (pixels / coarse / grey).clamp(1 / _MOST_COLOUR, _MOST_COLOUR)
    return torch.lerp(logs, limited, skin).exp() * colour


def _specular_fraction(coarse: Tensor, typical: Tensor) -> Tensor:
    """Return the fraction [h, w, 1] of the luminance of skin [h, w, 3] that is white, like highlights."""
    colour, white = typical / typical.sum(), 1 / 3 - typical / typical.sum()
    whiter = (coarse / coarse.sum(-1, keepdim=True) - colour) @ white / (white @ white + _PALE)
    brighter = (coarse.sum(-1) / typical.sum() - _GLARING[0]) / (_GLARING[1] - _GLARING[0])
    return ((_GLARE * whiter).clamp(0, 1) * brighter.clamp(0, 1))[..., None]


class FaceDetail:
    """Add the detail of a photo to relit textures of a face, in the window [h, w] of a view.

    Eyes, brows and teeth are not rendered from the relit texture. Their pixels in the photo are scaled by the
    change of light on the surrounding skin, teeth by the light that enters the mouth.
    """

    def __init__(self, face: FaceTexture, view: FaceView) -> None:
        self._view = view
        masks = torch.stack([region_mask(name, _OWN_SIDE) for name in _OWN_REGIONS])[None]
        masks = F.interpolate(masks, face.texture.shape[1:], mode="bilinear", align_corners=False)[0]
        own, self._mouth = masks.amax(0), masks[_OWN_REGIONS.index("mouth")]
        self._skin = face.visible * (1 - own)
        self._typical = mean_colour(face.texture, self._skin) + TINY
        least = _LEAST_AROUND * float(self._typical.mean())
        self._around_skin = Inpainting(self._skin)
        self._around_source = self._around_skin(face.texture).clamp(min=least)
        self._source = torch.cat([face.texture, own[None]])

    def precompute(self, texture: Tensor, mouth: Tensor | None = None) -> Tensor:
        """Return a relit texture [3, T, T] and the change of light on the skin, in one tensor [6, T, T].

        `mouth` [3, T, T] is the face relit by the light that enters the mouth.
        """
        around = self._around_skin(texture if mouth is None else torch.cat([texture, mouth]))
        if mouth is not None:
            outside, inside = around.chunk(2)
            around = torch.lerp(outside, inside, _CAVITY * self._mouth)
        return torch.cat([texture, around / self._around_source])

    def over(self, part: Window, photo: np.ndarray) -> Callable[[Tensor], np.ndarray]:
        """Return a function that renders a part of the window, where the photo is [h, w, 3].

        It takes the maps of a light from `precompute`.
        """
        inside, pixels = part.inside(self._view.window), torch.from_numpy(photo.clip(min=0))
        source, own = torch.split(self._view.render(self._source, inside), [3, 1], -1)
        gain = finer_detail(pixels, source, 1 - own, self._typical)

        def lit(light: Tensor) -> np.ndarray:
            skin, change = self._view.render(light, inside).chunk(2, -1)
            return torch.lerp(skin * gain, change * pixels, own).numpy()

        return lit


def mean_colour(texture: Tensor, weight: Tensor) -> Tensor:
    """Return the mean colour [3] of a texture [3, T, T], weighted by [T, T]."""
    return (texture * weight).sum((1, 2)) / weight.sum().clamp_min(TINY)
