"""Studio lights against the laws that they follow: irradiance at the face, distance, cone, size, colour."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from facerf_cli.image.colour import REC709_CHROMATICITIES, luminance, rgb_to_xyz
from facerf_cli.light.entries import StudioLight
from facerf_cli.light.light import PointLights, blackbody_rgb, far_samples, intensity_of
from facerf_cli.light.sphere import azel_to_direction, rig_directions

CENTRE = torch.tensor([0.1, -0.2, -1.0])


def irradiance_of_wall(points: PointLights, place: Tensor, facing: Tensor) -> float:
    """Irradiance of a small surface at a place [3] that faces a direction [3]."""
    directions, irradiance = points.arriving(place[:, None, None])
    return float((irradiance[:, 0, 0] * (directions[:, 0, 0] @ facing).clamp_min(0)).sum())


@pytest.mark.parametrize("size_m", [0.0, 0.4, 1.5])
@pytest.mark.parametrize("at_m", [(0.5, 0.3, 1.0), (0.0, 2.0, 0.0), (0.2, 0.0, -0.3)])
def test_at_the_centre_of_the_face_a_light_is_as_strong_as_a_far_one(
    at_m: tuple[float, float, float], size_m: float
) -> None:
    points = PointLights.of(StudioLight(at_m=at_m, size_m=size_m), CENTRE)
    toward_light = torch.nn.functional.normalize(torch.tensor(at_m), dim=0)
    assert irradiance_of_wall(points, CENTRE, toward_light) == pytest.approx(1, rel=1e-5)
    offsets = points.places_m - CENTRE - torch.tensor(at_m)
    assert float((offsets @ toward_light).abs().max()) < 1e-6  # a square that faces the face
    assert (
        float(offsets.mean(0).norm()) < 1e-6
        and float(offsets.norm(dim=1).max()) < size_m / math.sqrt(2) + 1e-6
    )


def test_irradiance_falls_with_the_distance_and_a_spot_shines_in_its_cone() -> None:
    points = PointLights.of(StudioLight(at_m=(0.0, 0.0, 0.5)), CENTRE)
    ahead = torch.tensor([0.0, 0.0, 1.0])
    assert irradiance_of_wall(points, CENTRE - 0.5 * ahead, ahead) == pytest.approx(1 / 4, rel=1e-5)
    assert irradiance_of_wall(points, CENTRE + 0.25 * ahead, ahead) == pytest.approx(4, rel=1e-5)
    points = PointLights.of(StudioLight(at_m=(0.0, 0.0, 1.0), spot_deg=30), CENTRE)
    plain = PointLights.of(StudioLight(at_m=(0.0, 0.0, 1.0)), CENTRE)
    shares = []
    for angle_deg in (0.0, 11.9, 13.5, 15.1, 40.0):
        place = (CENTRE + torch.tensor([math.tan(math.radians(angle_deg)), 0.0, 0.0]))[:, None, None]
        shares.append(float(points.arriving(place)[1] / plain.arriving(place)[1]))
    assert shares == pytest.approx([1, 1, 0.5, 0, 0], abs=1e-3)


@pytest.mark.parametrize("size_deg", [0.0, 3.0, 60.0])
def test_a_soft_far_light_is_as_strong_as_a_hard_one(size_deg: float) -> None:
    directions, shares = far_samples(StudioLight(azel_deg=(40.0, 20.0), size_deg=size_deg))
    middle = azel_to_direction(40.0, 20.0)
    assert float((shares * (directions @ middle)).sum()) == pytest.approx(1, rel=1e-5)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(len(directions)))
    torch.testing.assert_close(torch.nn.functional.normalize(shares @ directions, dim=0), middle)
    widest = math.degrees(math.acos(min(1.0, float((directions @ middle).min()))))
    assert size_deg / 3 <= widest <= 0.75 * size_deg + 0.1  # of a square: toward its corners


def test_light_from_around_reaches_every_surface_alike() -> None:
    directions, shares = far_samples(StudioLight())
    facing = rig_directions(200)
    received = ((facing @ directions.T).clamp_min(0) * shares).sum(1)
    torch.testing.assert_close(received, torch.ones(200), rtol=0.04, atol=0)  # 32 samples of the sphere


def test_stops_double_and_colours_multiply() -> None:
    light = StudioLight(azel_deg=(0.0, 0.0), rgb=(1.0, 0.5, 0.25), stops=3)
    torch.testing.assert_close(intensity_of(light), torch.tensor([8.0, 4.0, 2.0]))
    warm = StudioLight(azel_deg=(0.0, 0.0), rgb=(1.0, 0.5, 0.25), kelvin=3200.0, stops=-1)
    wanted = torch.from_numpy(blackbody_rgb(3200) * np.array([1, 0.5, 0.25]) / 2).float()
    torch.testing.assert_close(intensity_of(warm), wanted)


def test_blackbodies_are_white_at_6504_k_and_have_luminance_1() -> None:
    np.testing.assert_allclose(blackbody_rgb(6504), 1, atol=1e-12)
    reds = [blackbody_rgb(kelvin)[0] for kelvin in (1700, 2500, 3200, 5000, 8000, 20000)]
    assert reds == sorted(reds, reverse=True) and blackbody_rgb(3200)[2] < 0.4 < 1.5 < reds[2]
    for kelvin in (1667.0, 2222.5, 3999.0, 4001.0, 25000.0):
        assert luminance(blackbody_rgb(kelvin)) == pytest.approx(1) and blackbody_rgb(kelvin).min() >= 0


@pytest.mark.parametrize("kelvin", [1800.0, 2300.0, 3200.0, 5600.0, 12000.0])
def test_blackbodies_agree_with_plancks_law(kelvin: float) -> None:
    """Planck's law under the colour matching functions; its spline errs by less than 2 %."""
    colour = pytest.importorskip("colour")

    def rgb(kelvin: float) -> np.ndarray:
        shape = colour.SpectralShape(360, 780, 1)
        xyz = colour.sd_to_XYZ(colour.sd_blackbody(kelvin, shape), method="Integration") / 100
        found: np.ndarray = np.linalg.solve(rgb_to_xyz(REC709_CHROMATICITIES), xyz)
        return found / luminance(found)

    wanted = (rgb(kelvin) / rgb(6504)).clip(min=0)
    np.testing.assert_allclose(blackbody_rgb(kelvin), wanted / luminance(wanted), atol=0.02 * wanted.max())
