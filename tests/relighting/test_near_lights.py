"""Near and soft lights on a whole person: sums, distance, shadows, and agreement with far lights."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import grid_triangles
from facerf_cli.light.entries import StudioLight
from facerf_cli.light.light import Light, PointLights, far_samples
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.person import Person, Target
from facerf_cli.raster.texture import bake_attributes, normal_map
from facerf_cli.relighting.field import near_texture
from facerf_cli.relighting.fitting import reflectance_of
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.relighting.relightable import Relightable
from tests import astronaut

TARGET = Target(background="none")
DARK = torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 1, 3)
KEY, RIM = StudioLight(at_m=(0.5, 0.3, 0.8), size_m=0.3), StudioLight(at_m=(-0.6, 0.5, -0.4), spot_deg=50)


class Shown:
    """The astronaut, and images of her."""

    def __init__(self) -> None:
        self.field: PortraitField = astronaut.field()
        self.people = astronaut.person().prepare(TARGET)
        self.matte = self.field.person.segmentation.matte

    def image(self, *lights: StudioLight, rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> np.ndarray:
        """The person under near lights of a colour."""
        return over_black(self.people, near(*lights, rgb=rgb))

    def under(self, directions: Tensor, shares: Tensor) -> np.ndarray:
        """The person under far lights [L, 3], white, of shares [L]."""
        weights = shares[None, :, None].expand(-1, -1, 3)
        return over_black(self.people, Light(directions, weights, keys=(slice(len(shares)),)))

    def reached_by(self, light: StudioLight) -> Tensor:
        """Share [S, S] of a near light that arrives."""
        lights = near(light)
        assert isinstance(self.people, PeopleInPhoto)
        around = lights.near_points(self.people.people[0].vertices_m.mean(0))
        return self.field.views[0].shade(lights.directions, lights.weights, around).visibility[0, 0]


def near(*lights: StudioLight, rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Light:
    return Light(*DARK, near=lights, near_weights=torch.tensor(rgb).expand(1, len(lights), 3))


def over_black(people: Relightable, lights: Light) -> np.ndarray:
    return people.light_layer(next(people.relit(lights)))


@pytest.fixture(scope="module")
def person() -> Shown:
    return Shown()


def test_lights_add_up_at_any_distance_and_none_inside_the_head_reaches_the_face(person: Shown) -> None:
    both, key, rim = person.image(KEY, RIM, rgb=(2.0, 0.5, 0.0)), person.image(KEY), person.image(RIM)
    assert key.max() > 0.1 and rim.max() > 0.1
    np.testing.assert_allclose(both, (key + rim) * (2, 0.5, 0), atol=1e-3 * both.max())
    skin = person.field.person.segmentation.layer("skin")[:] > 0.9
    means = [person.image(StudioLight(at_m=(0.0, 0.0, z)))[skin].mean() for z in (1.0, 4.0)]
    assert means[0] == pytest.approx(
        means[1], rel=0.1
    )  # the nose is nearer than the centre, the ears farther
    skin = person.field.person.classes[1] > 0.95
    assert person.reached_by(StudioLight(at_m=(0.0, 0.1, -0.12)))[skin].mean() < 0.2


@pytest.mark.parametrize("azimuth_deg", [40.0, 150.0])
def test_a_near_light_far_away_is_a_far_light(person: Shown, azimuth_deg: float) -> None:
    """3 km away; a ray that grazes the proxy may differ, so the mean is compared."""
    direction = azel_to_direction(azimuth_deg, 20.0)
    x, y, z = (3000 * direction).tolist()
    close, far = person.image(StudioLight(at_m=(x, y, z))), person.under(direction[None], torch.ones(1))
    assert np.abs(close - far).mean() < 1e-3 * far[person.matte > 0.5].mean()
    assert np.abs(close - far).max() < 0.1 * far.max()


def test_a_light_that_is_near_falls_off_and_comes_from_its_own_side(person: Shown) -> None:
    """Irradiance (d0 / d)^2 across the person: right by the head the near side has more of the light."""
    place = torch.nn.functional.normalize(torch.tensor([1.0, 0.0, 1.0]), dim=0)
    shares = []
    for distance_m in (0.3, 3000.0):
        x, y, z = (distance_m * place).tolist()
        image = person.image(StudioLight(at_m=(x, y, z))).mean(-1)
        skin = person.field.person.segmentation.layer("skin")[:] > 0.9
        middle = person.field.person.square.x0_px + person.field.person.square.side_px / 2
        right = np.arange(image.shape[1]) > middle
        shares.append(image[skin & right].mean() / image[skin & ~right].mean())
    assert shares[0] > 1.3 * shares[1]


def test_every_pixel_of_a_matt_person_follows_cosine_and_distance(person: Shown) -> None:
    """Lambert's law, by the proxy's positions: also on hair and garment, where no other field is mixed in."""
    view = person.field.views[0]
    maps = view.maps
    dark = {name: 0 * getattr(maps, name) for name in ("gloss", "lit", "around", "shadow")}
    matt = replace(view, correction=None, maps=maps._replace(trust=0 * maps.trust + 50, **dark))
    light = StudioLight(at_m=(0.1, 0.2, 0.3))
    ((points, rgb),) = near(light).near_points(person.people.people[0].vertices_m.mean(0))
    lit = matt.shade(*DARK, [(points, rgb)])
    offsets = points.places_m[0, :, None, None] - view.person.maps.positions_m
    cosine = (offsets / offsets.norm(dim=0) * maps.normals[0]).sum(0).clamp_min(0)
    wanted = cosine * points.strength / offsets.square().sum(0)
    reached = lit.visibility[0, 0] > 0.999
    assert reached.float().mean() > 0.3 and wanted[reached].std() > 0.3
    torch.testing.assert_close(lit.shading[0, 0][reached], wanted[reached], rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("is_near", [True, False], ids=["at", "from"])
def test_large_lights_cast_soft_shadows(person: Shown, is_near: bool) -> None:
    """The slopes of the shadows on the skin are lower, the larger the light; the skin's share is the same."""
    x, y, z = azel_to_direction(60.0, 40.0).tolist()

    def reached(size: float) -> Tensor:
        if is_near:
            return person.reached_by(StudioLight(at_m=(x, y, z), size_m=size))
        directions, shares = far_samples(StudioLight(azel_deg=(60.0, 40.0), size_deg=60 * size))
        return (
            person.field.views[0].shade(directions, shares[None, :, None].expand(-1, -1, 3)).visibility[0, 0]
        )

    skin = person.field.person.classes[1] > 0.9
    found = [reached(size) for size in (0.0, 0.4, 0.8)]
    slopes = [float(x.diff(dim=0)[:, 1:].square()[skin[1:, 1:]].mean()) for x in found]
    assert slopes[1] < 0.8 * slopes[0] and slopes[2] < 0.85 * slopes[1]
    means = [float(x[skin].mean()) for x in found]
    assert means == pytest.approx([means[0]] * 3, abs=0.05)


def test_other_models_have_near_lights_too(person: Shown) -> None:
    """Their textures add up, and so does what surrounds the face where it follows the field."""
    models, photo, head = astronaut.models(), astronaut.photo(), astronaut.head()
    reflectance = reflectance_of(models, head, "diffuse-sh")
    people = Person(models, photo, head, reflectance).prepare(TARGET)

    def image(*lights: StudioLight) -> np.ndarray:
        return over_black(people, near(*lights))

    both, key, rim = image(KEY, RIM), image(KEY), image(RIM)
    np.testing.assert_allclose(
        both, key + rim, atol=2e-3 * both.max()
    )  # the surround's undershoot is clipped
    skin = person.field.person.segmentation.layer("skin")[:] > 0.9
    columns = np.flatnonzero(skin.any(0))
    middle = int(columns.mean())
    assert key[:, middle:][skin[:, middle:]].mean() > 1.2 * key[:, :middle][skin[:, :middle]].mean()


SIDE = 64


@cache
def vertices() -> Tensor:
    return load_face_model("builtin").mean + torch.tensor([0.0, 0.0, -1.0])


class WhiteClay:
    """A white Lambertian face without shadows: a `Reflectance`."""

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        normals = normal_map(vertices(), grid_triangles(), SIDE)
        cosine = torch.einsum("lc,cij->lij", directions, normals).clamp_min(0)
        return torch.einsum("mlc,lij->mcij", weights, cosine)


def positions() -> Tensor:
    return bake_attributes(vertices(), round(len(vertices()) ** 0.5), SIDE)


def points_of(light: StudioLight) -> PointLights:
    return PointLights.of(light, vertices().mean(0))


@pytest.mark.parametrize(
    "light",
    [
        StudioLight(at_m=(0.5, 0.3, 1.0)),
        StudioLight(at_m=(0.4, 0.0, 0.3), size_m=0.4),
        StudioLight(at_m=(0.0, 0.8, 0.8), size_m=0.8),
        StudioLight(at_m=(0.0, 0.0, 0.6), spot_deg=12),
    ],
)
def test_each_texel_sees_the_light_in_its_own_direction_and_distance(light: StudioLight) -> None:
    """Between the grid's directions the cosine is interpolated, which costs up to 2 %."""
    found = near_texture(WhiteClay(), points_of(light), vertices(), SIDE)
    directions, irradiance = points_of(light).arriving(positions())
    normals = normal_map(vertices(), grid_triangles(), SIDE)
    truth = (irradiance * torch.einsum("pijc,cij->pij", directions, normals).clamp_min(0)).sum(0)
    far = WhiteClay().relit(F.normalize(torch.tensor([light.at_m]), dim=1), torch.ones(1, 1, 3))[0, 0]
    assert (found[0] - truth).abs().mean() < 0.02 * truth.mean()
    assert (found[0] - truth).abs().mean() < 0.3 * (far - truth).abs().mean()
    torch.testing.assert_close(found[0], found[2])
