"""The photo's own detail, added to a relit texture of the face.

A texture is coarser than the photo. Where the source texture is S and the relit one R, a pixel P becomes

    R (P + e) / (S + e) + k e (P - S) / (S + e)    where P >= S,    k = mean R / mean S,
    R D / S + R (P - D) / (S + e)                  where P < S,

D is P, but in dark pixels has the colour of S, for theirs is noise. For bright sources both are the
quotient P R / S. Where the source is nearly black the quotient would be noise, and e, a small share of the
source's mean, keeps the pixel near R. Under the photo's own light (R = S) the photo comes back, its dark
pixels nearly. All steps are linear in R. A light with negative weights, such as the paper's plain least
squares gives, can make pixels negative.
"""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.head import FaceTexture
from facerf_cli.face.topology import region_mask
from facerf_cli.face.view import FaceView
from facerf_cli.image.colour import luminance
from facerf_cli.image.strips import Rows
from facerf_cli.raster.texture import inpaint

DARK = 0.08  # e above, a share of the source's mean
TINY = 1e-8
_NOISY = 2.0  # times e: the luminance below which colours of pixels are noise
_OWN_REGIONS = ("eyes", "mouth", "brows")  # keep the photo's own detail, scaled as the skin around them
_CAVITY = 0.75  # of the light that lips keep from the teeth
_OWN_SIDE = 128  # texels of their mask; finer ones take seconds to draw


@dataclass(frozen=True, eq=False)
class DetailRows:
    """Values in some rows [h, w] of the window that no light changes.

    They are the pixels, factors of R and of k, and the share that stays the photo's.
    """

    pixels: np.ndarray
    gain: np.ndarray
    bias: np.ndarray
    own: np.ndarray


@dataclass(frozen=True, eq=False)
class RelitDetail:
    """A relit texture with the change of light on the skin [6, T, T], and k [3]."""

    textures: Tensor
    mean_change: Tensor


class PhotoDetail:
    """Gives relit textures the detail of a photo [H, W, 3], in the window [h, w] of a view (formula above).

    Eyes, brows and teeth stay the photo's: they are scaled as the skin around them, teeth by the light that
    falls into the mouth.
    """

    def __init__(self, face: FaceTexture, view: FaceView, photo: Rows) -> None:
        self._view = view
        masks = torch.stack([region_mask(name, _OWN_SIDE) for name in _OWN_REGIONS])[None]
        masks = F.interpolate(masks, face.texture.shape[1:], mode="bilinear", align_corners=False)[0]
        own, self._mouth = masks.amax(0), masks[_OWN_REGIONS.index("mouth")]
        self.trusted = face.visible * (1 - own)
        self.mean_source = mean_colour(face.texture, self.trusted)
        self.floor = DARK * float(self.mean_source.mean()) + TINY
        self._around_source = inpaint(face.texture, self.trusted).clamp(min=self.floor)
        self._source, self._photo = torch.cat([face.texture, own[None]]), photo

    def observe(self, inside: slice) -> DetailRows:
        """Read rows of the window."""
        floor = self.floor
        pixels = self._photo[self._view.in_photo(inside)][:, self._view.window[1]].clip(min=0)
        source, own = np.split(self._view.render(self._source, inside).numpy(), [3], -1)
        finer = pixels >= source
        steady = _steady_colours(pixels, source, _NOISY * floor)
        darker = steady / source.clip(min=TINY) + (pixels - steady) / (source + floor)
        gain = np.where(finer, (pixels + floor) / (source + floor), darker)
        bias = np.where(finer, floor * (pixels - source) / (source + floor), 0)
        return DetailRows(pixels, gain, bias, own)

    def ready(self, texture: Tensor, mouth: Tensor | None = None) -> RelitDetail:
        """A relit texture [3, T, T] and the change of light on the skin, continued over eyes and brows.

        `mouth` [3, T, T] is relit by what falls into the mouth.
        """
        mean_change = mean_colour(texture, self.trusted) / self.mean_source.clamp(min=TINY)
        around = inpaint(texture, self.trusted)
        if mouth is not None:
            around = torch.lerp(around, inpaint(mouth, self.trusted), _CAVITY * self._mouth)
        return RelitDetail(torch.cat([texture, around / self._around_source]), mean_change)

    def pixels(self, relit: RelitDetail, seen: DetailRows, inside: slice) -> Tensor:
        """The photo's pixels [h, w, 3] in rows of the window under the light of a relit texture."""
        skin, change = self._view.render(relit.textures, inside).chunk(2, -1)
        pixels, gain, bias, own = map(torch.from_numpy, (seen.pixels, seen.gain, seen.bias, seen.own))
        skin = skin * gain + relit.mean_change * bias
        return skin + own * (change * pixels - skin)


def _steady_colours(pixels: np.ndarray, around: np.ndarray, dark: float) -> np.ndarray:
    """Pixels [h, w, 3], which where they are darker than `dark` take on the colour of what is around them."""
    light, mean = (luminance(image)[..., None] for image in (pixels, around))
    share = (1 - light / dark).clip(min=0)
    return pixels + share * (around * light / mean.clip(min=TINY) - pixels)


def mean_colour(texture: Tensor, weight: Tensor) -> Tensor:
    """Mean colour [3] of a texture [3, T, T] under weights [T, T]."""
    return (texture * weight).sum((1, 2)) / weight.sum().clamp(min=TINY)
