"""The images of a person under every light of a dense rig, factored for a page.

The person of `facerf relight` under a light l, at the photo's resolution, is close to

    T(x, l) = D(x) sum_k U_k(x) v_k(l)

D, the detail, is an image at full resolution: the person under light from everywhere, times a smooth factor
that makes the contrast of all pixels alike. U_k are K small maps, the left factors of a truncated singular
value decomposition of the ratios T / D; v_k(l) are coefficients. So a page needs one large image, K small
ones and a table, and is linear in light, as `facerf relight` is.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from facerf_cli.colour import AUTO_EXPOSURE_PERCENTILE, FACE_PERCENTILE, auto_exposure_ev, luminance
from facerf_cli.composite import Composition, Relit, Target
from facerf_cli.face.crop import Crop
from facerf_cli.face.head import Head
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.models import Models
from facerf_cli.pipeline import composition_of, reflectance_of, relit_by
from facerf_cli.portrait.classes import class_index
from facerf_cli.portrait_field import PortraitField
from facerf_cli.raster.texture import inpaint
from facerf_cli.resize import resized
from facerf_cli.viewer.frame import PersonBox, small_composition

_LIGHTS_AT_ONCE = 16
_DARK = 1e-3  # floor of the detail, as a share of its mean: ratios over black are noise
_MOST_RATIO = 50.0
_SKIN_SAMPLES, _PERSON_SAMPLES = 1024, 512  # pixels by which a page chooses its exposure
_LEAST_BRIGHTNESS, _EVENNESS = 0.03, 0.4  # of a light: floor, as a share of the median; exponent
_LEAST_SPREAD = 0.05  # of a pixel, as a share of the mean
_SURE = 0.5  # share from which on a pixel is the person's


@dataclass(frozen=True)
class BasisSettings:
    """Lights of the rig, singular values that are kept, and pixels along the maps' longer side."""

    lights: int = 800
    rank: int = 192
    maps_px: int = 256


@dataclass(frozen=True, eq=False)
class ExposureSamples:
    """Radiances [L, 3] a pixel of the person as coarse as the field, under the lights of a rig.

    skin [L, n, 3] and person [L, m, 3]; plate_skin and plate_person [H, W, 3] with masks are the photo's, as
    `WholePerson.exposure_ev` sees them.
    """

    skin: np.ndarray
    person: np.ndarray
    plate_skin: np.ndarray  # [n, 3]
    plate_person: np.ndarray  # [m, 3]


@dataclass(frozen=True, eq=False)
class LightBasis:
    """A person under any light; see above. Images are scene-linear, at the photo's size [H, W]."""

    photo: np.ndarray  # [H, W, 3]
    background: np.ndarray  # [H, W, 3] the photo where the person is not, multiplied by that share
    matte: np.ndarray  # [H, W]
    detail: np.ndarray  # [H, W, 3]
    box: PersonBox  # of the photo, which the maps cover
    crop: Crop  # of the photo, around the face
    maps: np.ndarray  # [K, h, w, 3]
    directions: np.ndarray  # [L, 3]
    triangles: np.ndarray  # [F, 3] of directions, around the sphere
    coefficients: np.ndarray  # [L, K]
    samples: ExposureSamples

    def nearest_image(self, azimuth_deg: float, elevation_deg: float) -> np.ndarray:
        """The photo [H, W, 3] relit by the light of the rig that is nearest to a direction, well exposed."""
        toward = azel_to_direction(azimuth_deg, elevation_deg).numpy()
        light = int((self.directions @ toward).argmax())
        ratio = np.zeros_like(self.detail)
        small = np.tensordot(self.coefficients[light], self.maps, 1)
        self.box.of(ratio)[:] = resized(small, self.box.height, self.box.width)
        person = self.detail * ratio.clip(min=0) * self.matte[..., None]
        return self.background + person * np.float32(2.0 ** auto_exposure_ev(person, self.matte))


def light_basis(
    models: Models, photo: np.ndarray, head: Head, settings: BasisSettings = BasisSettings()
) -> LightBasis:
    """Relight a photo [H, W, 3] by a rig and factor the images."""
    field = reflectance_of(models, head, "portrait", photo=photo)
    assert isinstance(field, PortraitField)
    whole = composition_of(models, photo, head, field, Target(background="none"))
    rig = rig_directions(settings.lights)
    none = _dark(head, field)
    matte = whole.image(none).alpha
    assert matte is not None
    kept = composition_of(models, photo, head, field, Target(matte=matte))
    box = PersonBox.around(matte)
    small = small_composition(models, photo, head, field, matte, box, settings.maps_px)
    images, samples, ambient = _under_rig(small, head, field, rig)
    ambient_small = small.image(ambient)
    detail_small, seen = ambient_small.pixels, ambient_small.alpha
    assert seen is not None
    brightness = brightness_of(samples)
    images /= np.maximum(detail_small, _DARK * max(float(detail_small.mean()), 1e-9))
    images.clip(-_MOST_RATIO, _MOST_RATIO, out=images)
    images /= brightness[:, None, None, None]
    spread = _spread(images, seen)
    images /= spread
    weights = seen[..., None] * np.sqrt(detail_small * spread)
    maps, coefficients = factored(images, weights, settings.rank)
    maps = np.stack([_continued(one, seen) for one in maps])
    wide = np.ones((*matte.shape, 1), np.float32)
    box.of(wide)[:] = resized(spread, box.height, box.width)
    return LightBasis(
        photo=photo,
        background=kept.image(none).pixels,
        matte=matte,
        detail=whole.image(ambient).pixels * wide,
        box=box,
        crop=head.fit.crop,
        maps=maps,
        directions=rig.numpy(),
        triangles=ConvexHull(rig.double().numpy()).simplices.astype(np.uint16),
        coefficients=coefficients * brightness[:, None],
        samples=samples,
    )


def factored(images: np.ndarray, weights: np.ndarray, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """Maps [K, ...] and orthonormal coefficients [L, K] whose products come nearest to images [L, ...].

    An error counts in proportion to `weights`, which broadcast to an image. By the eigenvectors of the
    Gram matrix of the images: there are far fewer lights than pixels.
    """
    flat = images.reshape(len(images), -1)
    weight = np.broadcast_to(weights, images.shape[1:]).reshape(-1)
    gram = np.zeros((len(flat), len(flat)))
    for columns in np.array_split(np.arange(flat.shape[1]), max(1, flat.size // (1 << 25))):
        part = flat[:, columns] * weight[columns]
        gram += part @ part.T
    _, vectors = np.linalg.eigh(gram)
    coefficients = np.ascontiguousarray(vectors[:, ::-1][:, :rank], np.float32)
    return (coefficients.T @ flat).reshape(-1, *images.shape[1:]), coefficients


def brightness_of(samples: ExposureSamples) -> np.ndarray:
    """A brightness [L] by which the images of lights are divided before they are factored.

    Exposure shows a light from behind as bright as others, so its image counts for more than its radiance
    says; less than in proportion, since the darkest are the least use.
    """
    skin, person = (luminance(points) for points in (samples.skin, samples.person))
    face = np.percentile(skin, FACE_PERCENTILE, axis=1)
    most = np.percentile(person, AUTO_EXPOSURE_PERCENTILE, axis=1) / 4
    shown = np.maximum(face, most)
    floor = max(_LEAST_BRIGHTNESS * float(np.median(shown)), 1e-6)
    return np.asarray(np.maximum(shown, floor) ** _EVENNESS, np.float32)


def _spread(images: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Root mean square [h, w, 1] of each pixel over images [L, h, w, 3], continued over the background."""
    spread = np.sqrt(np.einsum("lhwc,lhwc->hw", images, images) / (3 * len(images)))
    inside = spread[seen > _SURE]
    least = _LEAST_SPREAD * float(inside.mean()) if inside.size else 1.0
    return np.maximum(_continued(spread[..., None], seen), least)


def _under_rig(
    small: Composition, head: Head, field: PortraitField, rig: Tensor
) -> tuple[np.ndarray, ExposureSamples, Relit]:
    """The small images [L, h, w, 3] of a rig's lights, samples, and the head under all lights at once."""
    images = np.zeros(0, np.float32)
    skin_mask, person_mask = _masks(field)
    skin, person = _spaced(skin_mask, _SKIN_SAMPLES), _spaced(person_mask, _PERSON_SAMPLES)
    coarse: list[Tensor] = []
    texture, surround = torch.zeros(()), torch.zeros(())
    for index, relit in enumerate(_single_lights(small, head, field, rig)):
        image = small.image(relit).pixels
        if not index:
            images = np.empty((len(rig), *image.shape), np.float32)
        images[index] = image
        assert relit.surround is not None
        coarse.append(_coarse(field, relit.surround)[:, torch.cat([skin, person])])
        texture, surround = texture + relit.texture / len(rig), surround + relit.surround / len(rig)
    points = torch.stack(coarse).permute(0, 2, 1).numpy()
    plate = field.person.image.flatten(1).T.numpy()
    samples = ExposureSamples(points[:, : len(skin)], points[:, len(skin) :], plate[skin], plate[person])
    return images, samples, Relit(texture, surround)


def _single_lights(small: Composition, head: Head, field: PortraitField, rig: Tensor) -> Iterator[Relit]:
    for some in torch.split(rig, _LIGHTS_AT_ONCE):
        weights = torch.eye(len(some))[..., None].expand(-1, -1, 3)
        yield from relit_by(small, head, field, some, weights)


def _coarse(field: PortraitField, lit: Tensor) -> Tensor:
    """The person in the square [3, S * S], as `WholePerson` exposes it, under maps [9, S, S]."""
    return ((field.maps.albedo[0] * lit[:3] + lit[3:6]) * field.exposure).flatten(1)


def _masks(field: PortraitField) -> tuple[Tensor, Tensor]:
    """The pixels of the square [S, S] that are skin, and those that are the person's."""
    classes = field.person.classes
    return classes[class_index("skin")] > _SURE, 1 - classes[0] > _SURE


def _spaced(mask: Tensor, most: int) -> Tensor:
    """Indices of `most` of a mask's pixels, evenly spaced; of fewer, all; of none, that of the middle."""
    every = mask.flatten().nonzero()[:, 0]
    if not len(every):
        return torch.tensor([mask.numel() // 2])
    step = max(1.0, len(every) / most)
    return every[(torch.arange(min(len(every), most)) * step).long()]


def _dark(head: Head, field: PortraitField) -> Relit:
    """The head without light."""
    side = field.person.image.shape[-1]
    return Relit(torch.zeros_like(head.face.texture), torch.zeros(9, side, side))


def _continued(image: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """An image [h, w, C] with the person's values continued over the background: it compresses well."""
    inside = torch.from_numpy((seen > _SURE).astype(np.float32))
    if not inside.any():
        return image
    filled = inpaint(torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1), inside)
    return np.asarray(filled.permute(1, 2, 0).numpy())
