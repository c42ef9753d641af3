"""The correction of a portrait's lights by its photo."""

import torch
from torch import Tensor

from facerf_cli.portrait.correction import Correction
from facerf_cli.raster.texture import Pixels

SIDE = 64


def olats() -> Tensor:
    """Images [3, 3, S, S] of three lights: two alike from the right, and one from the left."""
    across = torch.linspace(0, 1, SIDE).expand(SIDE, SIDE)
    shades = torch.stack([0.1 + across, 0.12 + 0.9 * across, (1 - across) ** 4])
    return shades[:, None] * torch.tensor([0.8, 0.6, 0.5]).view(1, 3, 1, 1)


def photo_under(weights: Tensor) -> Tensor:
    """The true photo: what the model explains, and a mark that it does not know."""
    photo = torch.einsum("lc,lcij->cij", weights, olats())
    photo[:, 20:30, 20:40] *= 0.6
    return photo


WEIGHTS = torch.tensor([[0.7, 0.6, 0.5], [0.3, 0.4, 0.5], [0.0, 0.0, 0.0]])
PERSON = torch.ones(SIDE, SIDE)


def correction_of(photo: Tensor, images: Tensor, weights: Tensor, person: Tensor = PERSON) -> Correction:
    """The correction by a photo [3, S, S] of images [L, 3, S, S]; every pixel of the maps is chosen."""
    pixels = Pixels.of(PERSON > 0)
    photo, images, person = (pixels.values(maps) for maps in (photo, images, person))
    return Correction.of(photo, images, weights, person, pixels)


def excess_of(correction: Correction) -> Tensor:
    return correction.pixels.maps(correction.excess)


def factors_of(correction: Correction, images: Tensor) -> tuple[Tensor, Tensor]:
    """Factors and additions of images [L, 3, S, S], in their shape."""
    factor, added = correction.terms(correction.pixels.values(images.mean(1)))
    return correction.pixels.maps(factor).transpose(0, 1), correction.pixels.maps(added).transpose(0, 1)


def by_light(correction: Correction, images: Tensor) -> Tensor:
    """Corrected images [L, 3, S, S]."""
    factor, added = factors_of(correction, images)
    return images * factor + added


def corrected(correction: Correction) -> Tensor:
    return by_light(correction, olats())


def test_the_photos_light_gives_the_photo_back_and_a_right_explanation_changes_nothing() -> None:
    photo = photo_under(WEIGHTS)
    correction = correction_of(photo, olats(), WEIGHTS)
    found = torch.einsum("lc,lcij->cij", WEIGHTS, corrected(correction))
    away = torch.ones(SIDE, SIDE, dtype=torch.bool)
    away[15:35, 15:45], away[25, 25:35] = False, True  # of the mark's edges, which are blurred
    # No image is made darker than black, so where the third light is nearly black a little is missing.
    torch.testing.assert_close(found[:, away], photo[:, away], rtol=1e-2, atol=1e-4)
    plain = torch.einsum("lc,lcij->cij", WEIGHTS, olats())
    assert (plain - photo).abs().max() > 0.1
    photo = torch.einsum("lc,lcij->cij", WEIGHTS, olats())
    torch.testing.assert_close(corrected(correction_of(photo, olats(), WEIGHTS)), olats())


def test_lights_that_shade_alike_are_corrected_alike_and_others_hardly() -> None:
    photo = photo_under(WEIGHTS)
    marked = (slice(None), slice(22, 28), slice(24, 36))
    change = (corrected(correction_of(photo, olats(), WEIGHTS)) / olats())[(slice(None), *marked)]
    first, second, other = change.mean((1, 2, 3))
    assert 0.55 < first < 0.75 and 0.55 < second < 0.75
    assert 0.97 < other < 1.03


def test_off_the_person_nothing_changes_without_stairs_or_negative_light() -> None:
    person = PERSON.clone()
    person[:, :32] = 0
    photo = photo_under(WEIGHTS)
    correction = correction_of(photo, olats(), WEIGHTS, person)
    torch.testing.assert_close(corrected(correction)[..., :32], olats()[..., :32])
    photo[..., :32] = 3  # a bright background
    other = correction_of(photo, olats(), WEIGHTS, person)
    torch.testing.assert_close(excess_of(other)[..., 32:], excess_of(correction)[..., 32:])
    # Near a sharp edge of the photo that the model does not know.
    excess = excess_of(correction_of(photo_under(WEIGHTS), olats(), WEIGHTS))[1, 25, 10:50]
    assert excess.diff().abs().max() < 0.5 * float(excess.max() - excess.min())
    photo = photo_under(WEIGHTS)
    photo[:, 20:30, 20:40] = 0
    factor, _ = factors_of(correction_of(photo, olats(), WEIGHTS), olats())
    assert factor.min() >= 0


def test_the_error_of_a_shadow_is_not_enlarged_in_the_light() -> None:
    """A mark in the shadow of the photo's light, under a light without the shadow."""
    shadow = torch.ones(SIDE, SIDE)
    shadow[46:62, 16:44] = 0.1  # so small that both lights are alike
    plain = 0.5 + torch.linspace(0, 0.5, SIDE).expand(SIDE, SIDE)
    images = torch.stack([plain * shadow, plain])[:, None].expand(-1, 3, -1, -1)
    weights = torch.tensor([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    photo = images[0].clone()
    photo[:, 50:60, 20:40] *= 3  # not so deep a shadow
    found = by_light(correction_of(photo, images, weights), images)
    change = (found - images)[:, 2, 52:58, 24:36].mean((1, 2))
    brightness = images[1].mean() / images[0].mean()
    assert change[0] > 0.1  # the photo comes back
    assert 0 < change[1] < 1.01 * brightness * change[0]


def test_colours_of_what_is_nearly_black_are_not_multiplied() -> None:
    images, mark = olats(), (slice(22, 28), slice(24, 36))
    images[:, :, 20:30, 20:40] *= 0.05
    photo = torch.einsum("lc,lcij->cij", WEIGHTS, images)
    photo[:, 20:30, 20:40] = torch.tensor([2e-3, 1e-3, 3e-2]).view(3, 1, 1)
    ratio = excess_of(correction_of(photo, images, WEIGHTS))[:, *mark] + 1
    assert ratio.amin() > 0.3  # not at the end of its range
    assert ratio.amax() < 1.2 * ratio.amin()
