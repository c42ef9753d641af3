"""Images from baked light transport, and lenses over them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from facerf_cli.light.mesh_transport import MeshTransport, bake_mesh
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.raster.camera import Camera
from facerf_cli.synth import renderer
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, joined, strandless
from facerf_cli.synth.renderer import (
    Lenses,
    RenderSettings,
    lenses_in,
    over_lenses,
    photograph,
    reflections,
    scattered_irradiance,
)
from facerf_cli.synth.shading import LOBES
from facerf_cli.synth.views import StageCamera
from tests.synth.shapes import appearance, ball, camera, material, square

DIFFUSE = RenderSettings(bounces=0, scattering=False, gloss=False, relief=False)
POINT_LIGHT = BakeSettings(light_radius_deg=0, bounce_samples=0)
AHEAD = np.array([[0.0, 0, 1]], np.float32)


def board(part: str = "skin", side_m: float = 0.1, count: int = 21, z: float = 0.0) -> HeadMesh:
    """A square facing +z with u to the right and v down, tangents (of hair) down."""
    u, v, triangles = square(count)
    vertices = np.stack([(u - 0.5) * side_m, (0.5 - v) * side_m, 0 * u + z], -1).reshape(-1, 3)
    ahead, uv = np.broadcast_to([0, 0, 1.0], vertices.shape), np.stack([u, v], -1).reshape(-1, 2)
    mesh = strandless(part, vertices, ahead, triangles, uv)
    mesh.tangents[:, 1] = -1 if part == "hair" else 0
    return mesh


def bake(head: HeadMesh, lights: np.ndarray, settings: BakeSettings = POINT_LIGHT) -> MeshTransport:
    hair = head.part == PARTS.index("hair")
    return bake_mesh(head.vertices, head.normals, head.triangles, lights, settings, two_sided=hair)


def test_a_diffuse_ball_has_the_radiance_of_lambert_and_the_coverage_of_its_disc() -> None:
    head, lights = ball(), rig_directions(7).numpy()
    images, coverage = photograph(head, appearance(material()), bake(head, lights), camera(), DIFFUSE)
    assert abs(float(coverage.sum()) - np.pi * (0.05 / 0.12 * 64) ** 2) < 0.01 * float(coverage.sum())
    assert ((coverage > 0) & (coverage < 1)).sum() > 60  # antialiased
    centre = (np.arange(64) + 0.5 - 32) / 64 * 0.12
    x, y = np.meshgrid(centre, -centre)
    z = np.sqrt(np.clip(0.05**2 - x**2 - y**2, 0, None))
    normals = np.stack([x, y, z], -1) / 0.05
    inside = np.hypot(x, y) < 0.045
    for light, image in zip(lights, images, strict=True):
        expected = 0.5 * np.clip(normals @ light, 0, None)
        assert np.abs(image[0].numpy() - expected)[inside].max() < 0.02
        assert np.abs(image[0].numpy() - expected)[inside].mean() < 0.002
    assert (images[:, :, coverage == 0] == 0).all()


def test_even_light_shows_reflectance_and_each_channel_its_own_albedo() -> None:
    head = board()
    one = replace(material(), albedo=torch.tensor([0.8, 0.4, 0.1]).view(3, 1, 1).expand(3, 8, 8))
    images, _ = photograph(head, appearance(one), bake(head, AHEAD), camera(), DIFFUSE)
    assert torch.allclose(images[0, :, 32, 32], torch.tensor([0.8, 0.4, 0.1]), atol=1e-5)
    seen, transmitted = reflections(lens(), RIG)
    even = torch.full((150,), 4 / 150)
    two_surfaces = 2 * 0.04 / 1.04  # of refractive index 1.5, with the light that goes back and forth
    assert float(seen @ even) == pytest.approx(two_surfaces, rel=1e-5)
    assert float(transmitted) == pytest.approx(1 - two_surfaces, rel=1e-5)


def test_pictures_do_not_depend_on_the_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    head, lights = joined(ball(), board("hair", z=-0.01)), rig_directions(9).numpy()
    transport, person = bake(head, lights, BakeSettings()), appearance(material(), (2.0, 1.0, 0.5))
    irradiance = scattered_irradiance(head, person, transport)

    def images(chunk: int, settings: RenderSettings) -> torch.Tensor:
        monkeypatch.setattr(renderer, "_CHUNK", chunk)
        return photograph(head, person, transport, camera(32), settings, irradiance)[0]

    diffuse, full = RenderSettings(gloss=False, relief=False), RenderSettings()
    assert torch.equal(images(1 << 19, diffuse), images(1, diffuse))  # sparse products: row by row
    # A matrix product of one row may round differently from one of many: n.h by about 4 epsilon. GGX is
    # proportional to 1 / q^2 with q = (n.h)^2 (alpha^2 - 1) + 1 >= alpha^2, so its relative error is at most
    # 4 / alpha^2 times as large. A strand's highlight (at most 0.1) has the factor sqrt(1 + cos phi), whose
    # error near 0 is the square root of the cosine's.
    cosine_error = 4 * torch.finfo(torch.float32).eps
    alpha_squared = (0.4 * min(factor for factor, _ in LOBES)) ** 4  # 0.4: the material's roughness
    tolerance = {"rtol": 4 * cosine_error / alpha_squared, "atol": 0.1 * math.sqrt(cosine_error)}
    assert torch.allclose(images(1 << 19, full), images(1, full), **tolerance)


def test_scattering_keeps_even_light_and_softens_an_edge_by_channel() -> None:
    head = board(count=81)
    transport = bake(head, AHEAD)
    person = appearance(material(), (4.0, 2.0, 0.5))
    settings = replace(DIFFUSE, scattering=True)
    even = scattered_irradiance(head, person, transport, settings)
    assert np.allclose(even, 1, atol=1e-4)
    half = replace(transport, visibility=transport.visibility * (head.vertices[:, 0] > 0))
    dark = np.flatnonzero(np.abs(head.vertices[:, 0] + 0.00125) < 1e-5)  # a column just beyond the edge
    red, green, blue = scattered_irradiance(head, person, half, settings)[:, dark, 0].mean(1)
    assert 0.5 > red > green > blue
    at = head.vertices[:, 0], np.abs(head.vertices[:, 1]) < 0.02
    profile = scattered_irradiance(head, person, half, settings)[0, :, 0]
    slope = [float(profile[at[1] & (np.abs(at[0] - x) < 1e-5)].mean()) for x in (-0.005, -0.0025, 0.0, 0.005)]
    expected = norm.cdf((np.array([-5, -2.5, 0, 5]) - 0.6) / 4)  # lit from half a cell on
    assert np.abs(np.array(slope) - expected).max() < 0.05


def test_scattering_stays_within_the_skin() -> None:
    head = joined(board("cloth", z=1e-4), board("skin"))
    transport = bake(head, AHEAD, POINT_LIGHT)
    person = appearance(material(), (6.0, 6.0, 6.0))
    spread = scattered_irradiance(head, person, transport, replace(DIFFUSE, scattering=True))
    skin = head.part == PARTS.index("skin")
    assert (spread[:, skin] == 0).all() and (spread[:, ~skin] == 1).all()  # the cloth covers it


def test_bounces_add_up() -> None:
    floor = board(side_m=0.2)
    wall = replace(
        floor,
        vertices=floor.vertices[:, [2, 1, 0]] + np.array([0.1, 0, 0.1], np.float32),  # mirrored: faces -x
        normals=floor.normals[:, [2, 1, 0]] * np.float32(-1),
    )
    head = joined(floor, wall)
    transport = bake_mesh(head.vertices, head.normals, head.triangles, AHEAD, BakeSettings(bounce_samples=64))
    person = appearance(material(0.5))
    levels = [
        scattered_irradiance(head, person, transport, replace(DIFFUSE, bounces=bounces))[0, :, 0]
        for bounces in range(3)
    ]
    on_wall = head.normals[:, 0] < -0.5
    assert np.allclose(levels[0][on_wall], 0) and 0.05 < levels[1][on_wall].mean() < 0.25
    on_floor = ~on_wall & (head.vertices[:, 0] < 0.09)
    assert np.allclose(levels[1][on_floor], levels[0][on_floor])  # it sees the wall, which is dark
    assert (levels[2][on_floor] - levels[1][on_floor]).mean() > 0.005


def test_a_highlight_lies_at_the_mirrored_light_and_dark_skin_has_it_too() -> None:
    head = ball()
    light = np.array([[0.6, 0.0, 0.8]], np.float32)
    transport = bake(head, light)
    shine = []
    for albedo in (0.6, 0.05):
        person = appearance(material(albedo))
        glossy, _ = photograph(head, person, transport, camera(), replace(DIFFUSE, gloss=True))
        matte, _ = photograph(head, person, transport, camera(), DIFFUSE)
        shine.append((glossy - matte)[0, 1])
    assert torch.allclose(shine[0], shine[1], atol=1e-6)
    peak = np.unravel_index(int(shine[0].argmax()), (64, 64))
    half = np.array([0.6, 0, 1.8]) / np.linalg.norm([0.6, 0, 1.8])
    expected = 32 + half[0] * 0.05 / 0.12 * 64
    assert abs(peak[1] + 0.5 - expected) < 2 and abs(peak[0] + 0.5 - 32) < 2
    assert shine[0].max() > 0.05


def test_relief_turns_the_surface_as_its_slopes_say() -> None:
    head = board()
    lights = np.array([[0.6, 0, 0.8], [-0.6, 0, 0.8], [0, 0.6, 0.8], [0, -0.6, 0.8]], np.float32)
    transport, settings = bake(head, lights), replace(DIFFUSE, relief=True)

    def at_centre(relief: tuple[float, float]) -> list[float]:
        images, _ = photograph(head, appearance(material(relief=relief)), transport, camera(), settings)
        return images[:, 0, 32, 32].tolist()

    right, left, above, below = at_centre((0.3, 0.0))  # rises to the right, so it faces left
    assert left > 1.1 * above and right < 0.9 * below and above == pytest.approx(below, rel=1e-3)
    right, left, above, below = at_centre((0.0, 0.3))  # rises downward, so it faces up
    assert above > 1.1 * left and below < 0.9 * right and left == pytest.approx(right, rel=1e-3)


def test_hair_shines_across_its_strands_and_is_lit_from_behind() -> None:
    head = board("hair")
    lights = np.array([[0, 0, 1], [0.8, 0, 0.6], [0, 0.8, 0.6], [0.6, 0, -0.8]], np.float32)
    transport = bake(head, lights)
    images, _ = photograph(head, appearance(material(0.2)), transport, camera())
    matte, _ = photograph(head, appearance(material(0.2)), transport, camera(), DIFFUSE)
    shine = (images - matte)[:, 0, 32, 32]
    assert shine[1] > 5 * shine[2]  # strands hang down: they mirror what comes from the side, not from above
    assert shine[0] > 0.02
    # Kajiya's sine, wrapped: toward the normal 1, and nothing is left at 0.25 + 0.75 n.l < 0.
    assert matte[0, 0, 32, 32] == pytest.approx(0.2, abs=1e-4)
    assert matte[1, 0, 32, 32] == pytest.approx(0.2 * 0.7, abs=1e-4)
    assert matte[3, 0, 32, 32] == 0
    grazing = np.array([[0.98, 0, -0.199]], np.float32)
    behind, _ = photograph(head, appearance(material(0.2)), bake(head, grazing), camera(), DIFFUSE)
    assert behind[0, 0, 32, 32] > 0.01


def test_an_eye_keeps_its_highlight_in_a_coarse_image() -> None:
    """Where a pixel holds a wide range of normals the lobe widens, and the light of all pixels stays."""
    head = ball(0.012)
    head = replace(head, part=np.full(len(head.part), PARTS.index("eye"), np.uint8))
    light = np.array([[0.3, 0.3, 0.9]], np.float32)
    light /= np.linalg.norm(light)
    wet = replace(material(0.0), roughness=torch.full((1, 8, 8), 0.15))
    transport = bake(head, light)
    means = []
    for side in (12, 256):
        images, coverage = photograph(head, appearance(wet), transport, camera(side, 0.03))
        means.append(float(images.sum() / coverage.sum()))
    assert means[0] == pytest.approx(means[1], rel=0.35)


RIG = rig_directions(150)
SIDE = 32


def lens(tilt: float = 0.0) -> Lenses:
    """One pixel of a lens seen from +z, turned about the vertical axis."""
    normal = torch.tensor([[np.sin(tilt), 0.0, np.cos(tilt)]]).float()
    return Lenses(torch.tensor([0]), normal, torch.tensor([[0.0, 0.0, 1.0]]))


@pytest.mark.parametrize("tilt_deg", [0, 20, -35])
def test_it_mirrors_the_light_at_twice_its_tilt(tilt_deg: float) -> None:
    seen, _ = reflections(lens(np.radians(tilt_deg)), RIG)
    mirrored = torch.tensor([np.sin(2 * np.radians(tilt_deg)), 0.0, np.cos(2 * np.radians(tilt_deg))]).float()
    assert int(seen[0].argmax()) == int((RIG @ mirrored).argmax())


def test_glasses_mirror_grazing_views_and_hide_what_is_behind() -> None:
    _, steep = reflections(lens(np.radians(85)), RIG)
    _, front = reflections(lens(), RIG)
    assert float(steep) < 0.6 < 0.9 < float(front)
    camera = StageCamera(Camera(SIDE * 5.0, SIDE, SIDE, SIDE / 2, SIDE / 2), torch.eye(3), torch.zeros(3))
    depth_m = np.zeros((SIDE, SIDE), np.float32)
    depth_m[: SIDE // 2] = 0.5  # something nearer than the pane above,
    depth_m[SIDE // 2 :, : SIDE // 2] = 2.0  # farther below on the left, and nothing on the right
    found = lenses_in(pane(1.0), camera, depth_m)
    shown = torch.zeros(SIDE * SIDE)
    shown[found.pixels] = 1
    shown = shown.view(SIDE, SIDE)
    assert not shown[: SIDE // 2].any()
    assert shown[SIDE // 2 + 1 : SIDE // 2 + 7, 9:23].all()  # eight pixels around the middle
    assert torch.allclose(found.normals, torch.tensor([0.0, 0, 1]).expand_as(found.normals))
    images = torch.rand(150, 3, 1, 2)
    covered = over_lenses(images, lens(), RIG)
    seen, transmitted = reflections(lens(), RIG)
    assert torch.equal(covered[..., 1], images[..., 1])
    assert torch.allclose(covered[:, 1, 0, 0], images[:, 1, 0, 0] * transmitted + seen[0])


def pane(depth_m: float) -> HeadMesh:
    """A square of 10 cm before the camera."""
    corners = np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]])
    points = np.column_stack([corners, np.full(4, -depth_m)])
    normals = np.broadcast_to([0.0, 0, 1], points.shape)
    return strandless("frame", points, normals, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros((4, 2)))
