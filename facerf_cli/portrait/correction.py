"""Corrections of a model by its photo, so that the photo's original light reproduces it.

A network's errors (the white of an eye too bright, a crease too shallow) are similar under lights that shade
the person alike. Under the photo's light they are known: the photo divided by its explanation is a ratio
image (Riklin-Raviv and Shashua, *The quotient image*, 2001). `Quotient` corrects the face field, `Correction`
the light transport of a portrait.

For `Correction`, with the model's image s_l of light l, the photo P and its explanation E = sum_l w_l s_l,
the corrected image of a light is

    s_l + (p_l / p) (Q - 1) (s_l + f k_l),    Q = (P + f) / (E + f),    k_l = mean s_l / mean E,

where p_l is the likeness of s_l and E, f a small floor, and p the mean of p_l in each pixel over the photo's
lights, weighted by their fraction of E + f there. So sum_l w_l s_l becomes P, and the correction of any sum
of lights is the sum of their corrections. Where a light makes a pixel brighter than the photo's light does,
its likeness falls in proportion: the error of a shadow, which is large relative to little light, stays as
small there. Darkening is a factor of only s_l, at least 0, so that no light is negative. Where the photo is
nearly black its colours are noise, so Q has one value in all channels. Q is blurred by a pixel, because its
edges would be stairs at the photo's resolution.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.network.inputs import resize
from facerf_cli.raster.texture import Pixels, blurred_within

_FLOOR = 0.05  # f, relative to the person's mean in the photo
_RANGE = (0.2, 5.0)  # of Q
_BLUR_PX = 1.0  # standard deviation of Q's blur
_DARK = 4.0  # radiance, in floors, below which a photo's colours are noise
_SHARPNESS = 20.0  # exponent of the likeness
_LARGEST = 1.5  # of p_l / p
_SMALL_PX = 48  # side of the images for the likeness
_FACE_FLOOR = 0.2  # relative to the photo's mean radiance: keeps ratios in shadows near 1
_FACE_RANGE = (0.3, 3.0)  # of the ratios
_FACE_SHARPNESS = 8.0  # exponent of the likeness: higher values correct fewer lights


@dataclass(frozen=True, eq=False)
class Correction:
    """Q - 1 [3, 1, N], p [1, N], the floor f, the mean of E over the person, and E [1, N], grey.

    All images are values of N pixels of maps, which include the person.
    """

    excess: Tensor
    mean_likeness: Tensor
    floor: float
    mean: float
    explained: Tensor
    person: Tensor  # [1, N]
    pixels: Pixels

    @staticmethod
    def of(photo: Tensor, olats: Tensor, weights: Tensor, person: Tensor, pixels: Pixels) -> "Correction":
        """Correct images [L, 3, 1, N] whose sum with weights [L, 3] explains a photo [3, 1, N].

        person [1, N] is the person's coverage of each pixel.
        """
        explained = torch.einsum("lc,lcij->cij", weights, olats)
        total = person.sum().clamp_min(1.0)
        floor = _FLOOR * float((photo.mean(0) * person).sum() / total)
        ratio = (photo + floor) / (explained + floor).clamp_min(1e-9)
        brightness = photo.mean(0, keepdim=True)
        grey = (brightness + floor) / (explained.mean(0, keepdim=True) + floor).clamp_min(1e-9)
        coloured = brightness**2 / (brightness**2 + (_DARK * floor) ** 2).clamp_min(1e-12)
        ratio = torch.lerp(grey, ratio, coloured).clamp(*_RANGE)
        mean = float((explained.mean(0) * person).sum() / total)
        blurred = blurred_within(pixels.maps(ratio - 1), pixels.maps(person), _BLUR_PX)
        excess = pixels.values(blurred) * person
        plain = Correction(excess, torch.ones_like(person), floor, mean, explained.mean(0), person, pixels)
        grey = olats.mean(1)
        brightness = plain._brightness(grey)
        likeness = plain._likeness(grey, brightness)
        shares = torch.einsum("lc,lcij->lij", weights, olats + floor * brightness[:, None])
        mean_likeness = (likeness * shares).sum(0) / shares.sum(0).clamp_min(1e-9)
        return replace(plain, mean_likeness=mean_likeness.clamp_min(1e-3))

    def terms(self, grey: Tensor) -> tuple[Tensor, Tensor]:
        """Return factors and additions [3, l, 1, N] that correct single-light images, grey ones [l, 1, N]."""
        brightness = self._brightness(grey)
        power = self._likeness(grey, brightness) / self.mean_likeness
        power, raised = power.clamp(max=_LARGEST), self.floor * brightness
        more, less = self.excess[:, None].clamp(min=0), self.excess[:, None].clamp(max=0)
        more = power * more
        factor = (1 + more).addcmul_(power * (1 + raised / grey.clamp_min(1e-9)), less)
        return factor.clamp_min_(0), more * raised

    def _brightness(self, grey: Tensor) -> Tensor:
        """Return k_l [l, 1, 1]."""
        means = (grey * self.person).sum((1, 2)) / self.person.sum().clamp_min(1.0)
        return (means / max(self.mean, 1e-9))[:, None, None]

    def _likeness(self, grey: Tensor, brightness: Tensor) -> Tensor:
        """Return p_l [l, 1, N]."""
        small, explained = self._small(grey), self._small_explained
        lengths = small.flatten(-2).norm(dim=-1) * explained.norm()
        cosine = (small * explained).sum((-2, -1)) / lengths.clamp_min(1e-12)
        allowed = brightness * (self.explained + self.floor)
        brighter = (grey + self.floor * brightness) / allowed.clamp_min(1e-9)
        return cosine.clamp(0, 1)[:, None, None] ** _SHARPNESS / brighter.clamp_min(1)

    @cached_property
    def _small_explained(self) -> Tensor:
        return self._small(self.explained[None])

    def _small(self, grey: Tensor) -> Tensor:
        """Reduce grey images [n, 1, N] of the person to [n, s, s]."""
        masked = self.pixels.maps(grey * self.person)
        return F.interpolate(masked[None], (_SMALL_PX, _SMALL_PX), mode="area")[0]


@dataclass(frozen=True)
class Quotient:
    """Photo over its reconstruction [3, t, t], and the visible reconstruction, grey [t, t].

    `albedo` [3, t, t], if not None, are factors of the field's albedo that the reconstruction includes.
    """

    ratio: Tensor
    explained: Tensor
    albedo: Tensor | None = None

    @staticmethod
    def of(photo: Tensor, explained: Tensor, visible: Tensor, albedo: Tensor | None = None) -> "Quotient":
        """Divide a photo by its reconstruction, scene-linear textures [3, t, t]; visible [t, t] in 0..1."""
        explained = explained if albedo is None else explained * albedo
        floor = _FACE_FLOOR * (photo.mean(0) * visible).sum() / visible.sum().clamp_min(1e-6)
        ratio = ((photo + floor) / (explained + floor).clamp_min(1e-12)).clamp(*_FACE_RANGE)
        return Quotient(1 + visible * (ratio - 1), explained.mean(0) * visible, albedo)

    def corrected(self, olats: Tensor) -> Tensor:
        """Multiply OLAT textures [l, 3, T, T] by the ratio image, to the power of each light's likeness.

        The factors of albedo are the same for all lights. Likeness is the cosine between the OLAT and the
        reconstruction. It compares the shading of the face, not light directions: a photo in uniform light
        hardly corrects a light from the side.
        """
        side = olats.shape[-1]
        if self.albedo is not None:
            olats = olats * resize(self.albedo[None], side)
        small = resize(olats.mean(1, keepdim=True), self.explained.shape[-1])[:, 0]
        lengths = (small * (self.explained > 0)).flatten(1).norm(dim=1) * self.explained.norm()
        likeness = (small * self.explained).sum((1, 2)) / lengths.clamp_min(1e-12)
        power = likeness.clamp(0, 1)[:, None, None, None] ** _FACE_SHARPNESS
        return olats * (power * resize(self.ratio[None].log(), side)).exp_()

    def enlarged(self, side: int) -> "Quotient":
        """Return the same correction with maps of a side, which textures of that side need not resize."""
        albedo = None if self.albedo is None else resize(self.albedo[None], side)[0]
        return replace(self, ratio=resize(self.ratio[None].log(), side)[0].exp(), albedo=albedo)
