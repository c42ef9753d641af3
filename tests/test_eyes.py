"""Catchlights: the mirror image of a light in the cornea."""

import math

import numpy as np
import pytest
import torch

from facerf_cli.image.strips import whole
from facerf_cli.light.entries import StudioLight
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.light.studio_points import Lights, far_samples
from facerf_cli.portrait.mesh import SeenEyes
from facerf_cli.relighting.eyes import Eyes, mirrored_in_cornea
from tests import astronaut

SIDE, IRIS = 40, np.array([[20.0, 18.0, 10.0]])
LIDS = np.array([[5.0, 0], [35, 0], [35, 24], [5, 24]])  # the lower one covers the end of the iris
DARK = np.full((SIDE, SIDE, 3), 0.05, np.float32)


def image_of(azimuth_deg: float, elevation_deg: float) -> torch.Tensor:
    light = azel_to_direction(azimuth_deg, elevation_deg)[None]
    return mirrored_in_cornea(light, torch.ones(1, 1, 3), torch.ones(1, 1))[0, 0]


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (50, 0), (0, 40), (-40, -20)])
def test_a_light_is_seen_where_the_cornea_faces_half_way_to_it(azimuth: float, elevation: float) -> None:
    seen = image_of(azimuth, elevation)[0]
    half = azel_to_direction(azimuth, elevation) + torch.tensor([0.0, 0, 1])
    half = half / half.norm() * (7.8 / 5.9)  # radius of the cornea over the iris's
    at = 2 * (torch.arange(len(seen)) + 0.5) / len(seen) - 1
    right, down = (seen.sum(0) @ at) / seen.sum(), (seen.sum(1) @ at) / seen.sum()
    assert float(right) == pytest.approx(float(half[0]), abs=0.04)
    assert float(-down) == pytest.approx(float(half[1]), abs=0.04)


def test_a_light_behind_the_head_is_not_seen() -> None:
    assert image_of(180, 0).max() == 0 and image_of(0, 0).max() > 0.5
    assert mirrored_in_cornea(torch.zeros(0, 3), torch.zeros(1, 0, 3), torch.zeros(1, 0)).abs().max() == 0


def test_light_from_all_around_is_not_mirrored() -> None:
    around, _ = far_samples(StudioLight())
    assert mirrored_in_cornea(around, torch.ones(1, len(around), 3), torch.ones(1, len(around))).max() == 0


def test_a_light_is_seen_alike_whatever_else_shines() -> None:
    lamps = torch.cat(
        [azel_to_direction(20.0, 10.0)[None], rig_directions(24), azel_to_direction(24.0, 10.0)[None]]
    )
    weights = torch.rand(1, len(lamps), 3, generator=torch.Generator().manual_seed(0))
    arrives = torch.rand(2, len(lamps), generator=torch.Generator().manual_seed(1))
    each = [mirrored_in_cornea(lamps[[n]], weights[:, [n]], arrives[:, [n]]) for n in range(len(lamps))]
    torch.testing.assert_close(mirrored_in_cornea(lamps, weights, arrives), sum(each))


def eyes(photo: np.ndarray) -> Eyes:
    return Eyes(photo.__getitem__, SeenEyes(IRIS, LIDS[None]), (SIDE, SIDE))


def test_the_photos_catchlight_gives_way_to_the_new_lights() -> None:
    photo = DARK.copy()
    photo[14:17, 15:18] = 3.0
    relit, mirrored = 2 * photo, image_of(40, 0)
    found = whole(eyes(photo).lit(lambda rows: relit[rows].copy(), mirrored[None]), SIDE, SIDE)
    assert found[14:17, 15:18].max() < 0.2  # 6 before
    assert found[18, 22:28].max() > 0.5 and found[18, 12:18].max() < 0.2
    assert np.array_equal(found[:5], relit[:5]) and np.array_equal(found[:, :8], relit[:, :8])
    rows = slice(17, 21)
    part = eyes(photo).lit(lambda rows: relit[rows].copy(), mirrored[None])(rows)
    assert np.array_equal(part, found[rows])


def test_a_lid_before_the_iris_keeps_its_light() -> None:
    """It is brighter than the iris, as a catchlight is, and mirrors nothing."""
    photo = DARK.copy()
    photo[24:] = 0.5
    mirrored = torch.ones(1, 3, 64, 64)
    found = whole(eyes(photo).lit(lambda rows: photo[rows].copy(), mirrored), SIDE, SIDE)
    assert np.array_equal(found[24:], photo[24:])
    assert found[23, 20].min() > 1


def test_light_that_arrives_from_near_and_far() -> None:
    place = torch.tensor([0.0, 0.0, -1.0])
    near = StudioLight(at_m=(0.0, 2.0, 0.0), rgb=(1.0, 1.0, 1.0))
    lights = Lights(
        azel_to_direction(90.0, 0.0)[None], torch.ones(1, 1, 3), (near,), torch.full((1, 1, 3), 2.0)
    )
    directions, weights = lights.arriving(place)
    mean = torch.einsum("mnc,nd->mcd", weights, directions)[0, 0]
    torch.testing.assert_close(mean, torch.tensor([1.0, 2.0, 0.0]), atol=1e-4, rtol=1e-3)
    assert math.isclose(float(weights[0, :, 0].sum()), 3.0, rel_tol=1e-3)


def test_the_nose_keeps_a_light_from_the_eye_behind_it() -> None:
    lights = torch.stack([azel_to_direction(azimuth, 0.0) for azimuth in (-95.0, 0.0, 95.0)])
    left, right = astronaut.field().person.reaching_irises(lights)  # as the picture shows them
    assert left[1] > 0.9 and right[1] > 0.9
    assert right[0] < 0.1 and left[2] < 0.1  # each from the other's side
