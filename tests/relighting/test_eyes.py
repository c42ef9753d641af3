"""Eyes: the mirror image of a light in the cornea, irises without the photo's catchlights; lips."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from skimage.draw import polygon2mask
from torch import Tensor

from facerf_cli.image.colour import luminance
from facerf_cli.image.strips import Window
from facerf_cli.light.entries import StudioLight
from facerf_cli.light.light import Light, far_samples
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.portrait.find import SeenEyes
from facerf_cli.relighting import detail as module
from facerf_cli.relighting.eyes import Eyes, blur_px, mirrored_in_cornea, opening, outlined
from tests import astronaut

SIDE, IRIS = 40, np.array([[20.0, 18.0, 10.0]])
LIDS = np.array([[5.0, 0], [35, 0], [35, 24], [5, 24]])  # the lower one covers the end of the iris
DARK = np.full((SIDE, SIDE, 3), 0.05, np.float32)


def image_of(azimuth_deg: float, elevation_deg: float) -> torch.Tensor:
    light = azel_to_direction(azimuth_deg, elevation_deg)[None]
    return mirrored_in_cornea(light, torch.ones(1, 1, 3), torch.ones(1))[0]


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (50, 0), (0, 40), (-40, -20)])
def test_a_light_is_seen_where_the_cornea_faces_half_way_to_it(azimuth: float, elevation: float) -> None:
    seen = image_of(azimuth, elevation)[0]
    half = azel_to_direction(azimuth, elevation) + torch.tensor([0.0, 0, 1])
    half = half / half.norm() * (7.8 / 5.9)  # radius of the cornea over the iris's
    at = 2 * (torch.arange(len(seen)) + 0.5) / len(seen) - 1
    right, down = (seen.sum(0) @ at) / seen.sum(), (seen.sum(1) @ at) / seen.sum()
    assert float(right) == pytest.approx(float(half[0]), abs=0.04)
    assert float(-down) == pytest.approx(float(half[1]), abs=0.04)


def test_a_light_behind_the_head_or_all_around_is_not_mirrored() -> None:
    assert image_of(180, 0).max() == 0 and image_of(0, 0).max() > 0.5
    assert mirrored_in_cornea(torch.zeros(0, 3), torch.zeros(1, 0, 3), torch.zeros(0)).abs().max() == 0
    around, _ = far_samples(StudioLight())
    assert mirrored_in_cornea(around, torch.ones(1, len(around), 3), torch.ones(len(around))).max() == 0
    lamps = torch.cat(
        [azel_to_direction(20.0, 10.0)[None], rig_directions(24), azel_to_direction(24.0, 10.0)[None]]
    )
    weights = torch.rand(1, len(lamps), 3, generator=torch.Generator().manual_seed(0))
    arrives = torch.rand(len(lamps), generator=torch.Generator().manual_seed(1))
    each = [mirrored_in_cornea(lamps[[n]], weights[:, [n]], arrives[[n]]) for n in range(len(lamps))]
    torch.testing.assert_close(mirrored_in_cornea(lamps, weights, arrives), sum(each))


def eyes(photo: np.ndarray) -> Eyes:
    return Eyes(photo, SeenEyes(IRIS, LIDS[None]), (SIDE, SIDE))


def lit(photo: np.ndarray, relit: np.ndarray, mirrored: Tensor, rows: slice = slice(0, SIDE)) -> np.ndarray:
    """Some rows of a relit image with mirror images in the eyes."""
    seen = eyes(photo)
    return seen.lit(relit[rows].copy(), seen.precompute(mirrored), Window(rows, slice(0, SIDE)))


def test_the_photos_catchlight_gives_way_and_a_lid_keeps_its_light() -> None:
    photo = DARK.copy()
    photo[14:17, 15:18] = 3.0
    relit, mirrored = 2 * photo, image_of(40, 0)
    found = lit(photo, relit, mirrored[None])
    assert found[14:17, 15:18].max() < 0.2  # 6 before
    assert found[18, 22:28].max() > 0.5 and found[18, 12:18].max() < 0.2
    assert np.array_equal(found[:5], relit[:5]) and np.array_equal(found[:, :8], relit[:, :8])
    rows = slice(17, 21)
    part = lit(photo, relit, mirrored[None], rows)
    assert np.array_equal(part, found[rows])
    # It is brighter than the iris, as a catchlight is, and mirrors nothing.
    photo = DARK.copy()
    photo[24:] = 0.5
    mirrored = torch.ones(1, 3, 64, 64)
    found = lit(photo, photo, mirrored)
    assert np.array_equal(found[24:], photo[24:])
    assert 0.1 < found[23, 20].min() < found[18, 20].min() and found[18, 20].min() > 1  # lashes shade it


def eye(shift: tuple[float, float] = (0.0, 0.0), radius_px: float = 10.0) -> np.ndarray:
    """A brown iris with a pupil in the white of an eye, away from where it is said to be."""
    at = np.arange(SIDE) + 0.5
    away = np.hypot(at - IRIS[0, 0] - shift[0], at[:, None] - IRIS[0, 1] - shift[1])[..., None]
    colours = np.where(away < 0.4 * radius_px, [0.01, 0.008, 0.006], [0.2, 0.1, 0.04])
    return np.where(away < radius_px, colours, 0.7).astype(np.float32)


def relit(photo: np.ndarray, mirrored: torch.Tensor) -> np.ndarray:
    return lit(photo, photo, mirrored[None])


NOTHING = torch.zeros(3, 64, 64)


def test_a_catchlight_is_filled_by_the_colours_around_it() -> None:
    """It lies half over the pupil; the white of the eye, which is as bright, stays."""
    photo = eye()
    shining = photo.copy()
    shining[13:17, 18:21] = 1
    assert np.array_equal(relit(photo, NOTHING), photo)
    filled = relit(shining, NOTHING)[13:17, 18:21]
    assert np.abs(filled - photo[13:17, 18:21]).mean() < 0.02
    np.testing.assert_allclose(filled[..., 1] / filled[..., 0], 0.65, atol=0.16)  # brown, as all of it
    white = photo.min(-1) > 0.5
    assert np.array_equal(relit(shining, NOTHING)[white], photo[white])
    photo[13:17, 18:21] = [1, 1, 0]
    dim = np.full_like(photo, 0.1)
    assert lit(photo, dim, NOTHING[None]).max() <= 0.1
    photo = eye()
    photo[16:19, 24:28] = 1.4
    photo[16:19, 28:31] = 0.75  # over the border
    assert relit(photo, NOTHING)[16:19, 24:27].max() < 0.3


@pytest.mark.parametrize(("shift", "size"), [((1.5, -1.0), 1.0), ((-1.0, 0.5), 0.9)])
def test_the_outline_of_an_iris_is_found_where_the_photo_shows_it(
    shift: tuple[float, float], size: float
) -> None:
    light = luminance(eye(shift, 10 * size))
    circle = outlined(light, IRIS[0], opening(LIDS, slice(0, SIDE), slice(0, SIDE)))
    np.testing.assert_allclose(circle, IRIS[0] + [*shift, 10 * (size - 1)], atol=0.6)


def test_images_of_lights_are_as_blurred_as_the_photo_and_add_up() -> None:
    sharp, soft = (gaussian_filter(eye(), (sigma, sigma, 0)) for sigma in (0.5, 2))
    light = [(relit(photo, image_of(20, 0)) - relit(photo, NOTHING))[..., 0] for photo in (sharp, soft)]
    assert light[1].max() < 0.5 * light[0].max()
    assert light[1].sum() == pytest.approx(light[0].sum(), rel=0.05)
    assert blur_px(luminance(soft), 10) == pytest.approx(2, rel=0.25)
    photo, one, two = eye(), image_of(20, 10), image_of(-30, 0)
    photo[13:17, 18:21] = 1
    apart = relit(photo, one) + relit(photo, two) - relit(photo, NOTHING)
    np.testing.assert_allclose(relit(photo, one + two), apart, rtol=1e-5, atol=1e-6)
    assert apart.min() >= 0
    # They are 7 degrees apart; a map's light fills its cell of the rig.
    sizes = {}
    for name, light in (("one", azel_to_direction(0, 0)[None]), ("cell", nearest_of_rig())):
        sizes[name] = float((mirrored_in_cornea(light, torch.ones(1, 1, 3), torch.ones(1))[0, 0] > 0.1).sum())
    assert sizes["cell"] > 1.8 * sizes["one"]
    soft, share = far_samples(StudioLight(azel_deg=(0.0, 0.0), size_deg=40.0))
    seen = mirrored_in_cornea(soft, share[None, :, None].expand(-1, -1, 3), torch.ones(len(soft)))[0, 0]
    middle = seen[26:38, 26:38]
    assert middle.min() > 0.8 * middle.max()


def nearest_of_rig() -> torch.Tensor:
    rig = rig_directions()
    return rig[[int(rig[:, 2].argmax())]]


def test_light_arrives_from_near_and_far() -> None:
    place = torch.tensor([0.0, 0.0, -1.0])
    near = StudioLight(at_m=(0.0, 2.0, 0.0), rgb=(1.0, 1.0, 1.0))
    far = Light(azel_to_direction(90.0, 0.0)[None], torch.ones(1, 1, 3))
    lights = replace(far, near=(near,), near_weights=torch.full((1, 1, 3), 2.0))
    directions, weights = lights.arriving(place, place)
    mean = torch.einsum("mnc,nd->mcd", weights, directions)[0, 0]
    torch.testing.assert_close(mean, torch.tensor([1.0, 2.0, 0.0]), atol=1e-4, rtol=1e-3)
    assert math.isclose(float(weights[0, :, 0].sum()), 3.0, rel_tol=1e-3)


def test_the_nose_keeps_a_light_from_an_eye_and_each_sees_a_near_light_where_it_is() -> None:
    lights = torch.stack([azel_to_direction(azimuth, 10.0) for azimuth in (-75.0, 0.0, 75.0)])
    seen = astronaut.field().views[0].eye_reflections(Light.each(lights), torch.zeros(3)).amax((2, 3, 4))
    alone = mirrored_in_cornea(lights, Light.each(lights).weights, torch.ones(3)).amax((1, 2, 3))
    left, right = (seen / alone[:, None]).T  # as the photo shows them
    assert left[1] > 0.8 and right[1] > 0.8
    assert left[0] > 0.5 and right[2] > 0.5
    assert right[0] < 0.05 and left[2] < 0.05  # each from the other's side
    near = StudioLight(at_m=(0.0, 0.1, 0.3), rgb=(1.0, 1.0, 1.0))
    lights = Light(torch.zeros(0, 3), torch.zeros(1, 0, 3), near=(near,), near_weights=torch.ones(1, 1, 3))
    at, view = 2 * (torch.arange(64) + 0.5) / 64 - 1, astronaut.field().views[0]
    images = view.eye_reflections(lights, view.person.maps.positions_m.mean((1, 2)))[0, :, 0]
    left, right = (float(image.sum(0) @ at / image.sum()) for image in images)
    assert left > 0.05 and right < -0.05  # toward the nose


def test_lips_keep_light_from_above_and_aside_from_the_teeth(monkeypatch: pytest.MonkeyPatch) -> None:
    """In front of the face they keep nothing. Layers add up."""
    person, photo = astronaut.person(), astronaut.photo()
    people = person.prepare()
    inner = person.head.fit.crop.to_photo(person.head.landmarks_px)[60:68]
    teeth = polygon2mask(photo.shape[:2], inner[:, ::-1]) & (luminance(photo) > 0.3)
    lights = torch.stack([azel_to_direction(*light) for light in ((0.0, 0.0), (0.0, 55.0), (-70.0, 0.0))])

    def shown(lights: Light) -> list[np.ndarray]:
        return [people.image(relit)[teeth] for relit in people.relit(lights)]

    each, (both,) = shown(Light.each(lights)), shown(Light(lights, torch.ones(1, 3, 3)))
    np.testing.assert_allclose(both, sum(each), rtol=1e-3)
    monkeypatch.setattr(module, "_CAVITY", 0.0)
    front, above, aside = (
        kept.mean() / whole.mean() for kept, whole in zip(each, shown(Light.each(lights)), strict=True)
    )
    assert 0.9 < front < 1.1
    assert above < 0.8 and aside < 0.8
