"""Images from baked light transport, under any lights and materials."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from facerf_cli.light.mesh_transport import MeshTransport, bake_mesh
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.portrait.parse import MORE_LANDMARKS, class_index
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, joined, strandless
from facerf_cli.synth.person import SyntheticPerson
from facerf_cli.synth.renderer import (
    BakedView,
    albedo_of,
    bake_light,
    images_under,
    light_of,
    materials_of,
    view_of,
)
from tests.synth.shapes import appearance, ball, camera, material, person_of, photograph, square

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
    images, coverage = photograph(head, appearance(material()), bake(head, lights), camera(), highlights=0)
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


def test_each_channel_shows_its_own_albedo() -> None:
    head = board()
    one = replace(material(), albedo=torch.tensor([0.8, 0.4, 0.1]).view(3, 1, 1).expand(3, 8, 8))
    images, _ = photograph(head, appearance(one), bake(head, AHEAD), camera(), highlights=0)
    assert torch.allclose(images[0, :, 32, 32], torch.tensor([0.8, 0.4, 0.1]), atol=1e-5)


def test_scattering_keeps_even_light_and_softens_an_edge_by_channel() -> None:
    head, side, field_m = board(count=81), 64, 0.12
    transport, person = bake(head, AHEAD), appearance(material(1.0), (6.0, 3.0, 1.0))
    even, coverage = photograph(head, person, transport, camera(side, field_m), highlights=0)
    assert (even[0][:, coverage > 0.99] - 1).abs().max() < 1e-4
    half = replace(transport, visibility=transport.visibility * (head.vertices[:, 0] > 0))
    edge, _ = photograph(head, person, half, camera(side, field_m), highlights=0)
    red, green, blue = edge[0, :, 32, 31]  # a pixel just beyond the edge
    assert 0.5 > red > green > blue
    x_mm = ((torch.arange(side) + 0.5) / side - 0.5) * 1000 * field_m
    expected = norm.cdf((x_mm[20:44].numpy() - 0.6) / 6)  # lit from half a cell on
    assert np.abs(edge[0, 0, 32, 20:44].numpy() - expected).max() < 0.05


def test_scattering_stays_within_the_skin() -> None:
    """Cloth on the right is lit, and the skin on the left is not."""
    right = replace(board("cloth"), vertices=board().vertices + np.float32([0.05, 0, 1e-4]))
    head = joined(right, board("skin"))
    transport = bake(head, AHEAD)
    cloth = head.part == PARTS.index("cloth")
    lit = replace(transport, visibility=transport.visibility * cloth)
    images, _ = photograph(head, appearance(material(), (6.0, 6.0, 6.0)), lit, camera(), highlights=0)
    assert (images[0, :, 20:44, 8:31] == 0).all() and torch.allclose(
        images[0, :, 20:44, 34:56], torch.tensor(0.5)
    )


def test_bounces_add_up() -> None:
    floor = board(side_m=0.2)
    wall = replace(
        floor,
        vertices=floor.vertices[:, [2, 1, 0]] + np.array([0.1, 0, 0.1], np.float32),  # mirrored: faces -x
        normals=floor.normals[:, [2, 1, 0]] * np.float32(-1),
    )
    head = joined(floor, wall)
    transport = bake_mesh(head.vertices, head.normals, head.triangles, AHEAD, BakeSettings(bounce_samples=64))
    on_wall = head.normals[:, 0] < -0.5
    on_floor = ~on_wall & (head.vertices[:, 0] < 0.09)
    dim, bright = (
        light_of(person_of(head, appearance(material(albedo))), transport).bounced[:, 0]
        for albedo in (0.25, 0.5)
    )
    assert 0.05 < bright[on_wall].mean() < 0.25
    assert (bright >= 2 * dim - 1e-6).all() and (bright[on_wall] < 2.3 * dim[on_wall] + 1e-6).all()
    assert (bright[on_floor] - 4 * dim[on_floor]).std() < 1e-6 < 0.005 < bright[on_floor].mean()  # two


def test_a_highlight_lies_at_the_mirrored_light_and_dark_skin_has_it_too() -> None:
    head = ball()
    light = np.array([[0.6, 0.0, 0.8]], np.float32)
    transport = bake(head, light)
    shine = []
    for albedo in (0.6, 0.05):
        person = appearance(material(albedo))
        glossy, _ = photograph(head, person, transport, camera())
        matte, _ = photograph(head, person, transport, camera(), highlights=0)
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
    transport = bake(head, lights)

    def at_centre(relief: tuple[float, float]) -> list[float]:
        images, _ = photograph(head, appearance(material(relief=relief)), transport, camera(), 0)
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
    matte, _ = photograph(head, appearance(material(0.2)), transport, camera(), highlights=0)
    shine = (images - matte)[:, 0, 32, 32]
    assert shine[1] > 5 * shine[2]  # strands hang down: they mirror what comes from the side, not from above
    assert shine[0] > 0.02
    # Kajiya's sine, wrapped: toward the normal 1, and nothing is left at 0.25 + 0.75 n.l < 0.
    assert matte[0, 0, 32, 32] == pytest.approx(0.2, abs=1e-4)
    assert matte[1, 0, 32, 32] == pytest.approx(0.2 * 0.7, abs=1e-4)
    assert matte[3, 0, 32, 32] == 0
    grazing = np.array([[0.98, 0, -0.199]], np.float32)
    behind, _ = photograph(head, appearance(material(0.2)), bake(head, grazing), camera(), highlights=0)
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


EAR = "left ear top"
SIDE_PX = 48


@pytest.fixture(scope="module")
def subject() -> SyntheticPerson:
    """A ball of skin beside a board of hair, turned a little."""
    skin, (u, v, faces) = ball(), square(25)
    wall = np.stack([0.12 * u - 0.06, 0.06 - 0.12 * v, 0 * u - 0.055], -1).reshape(-1, 3)
    hair = strandless("hair", wall, np.broadcast_to([0, 0, 1.0], wall.shape), faces, np.full((625, 2), 0.5))
    hair = replace(hair, tangents=np.broadcast_to(np.float32([0, -1, 0]), wall.shape).copy())
    person = person_of(joined(skin, hair), appearance(material((0.5, 0.4, 0.3), roughness=0.45)))
    return replace(person, head_to_world=pose_to_rotation(10, 5, 0), more_landmarks_world={EAR: [0, 0.02, 0]})


@pytest.fixture(scope="module")
def view(subject: SyntheticPerson) -> BakedView:
    lights = rig_directions(24).numpy().astype(np.float64)
    one = camera(SIDE_PX, 0.14, yaw_deg=-15)
    return view_of(subject, bake_light(subject, [one], lights, BakeSettings(bounce_samples=8), 0), one)[0]


def test_images_are_sums_over_lights_and_files_keep_them(subject: SyntheticPerson, view: BakedView) -> None:
    weights = torch.rand(1, 24, 3, generator=torch.Generator().manual_seed(0)) ** 4 / 6
    surface, single = materials_of(view, subject.appearance), torch.eye(24)[..., None].expand(-1, -1, 3)
    olats = images_under(view, surface, single)
    (image,) = images_under(view, surface, weights, highlights=24)
    summed = torch.einsum("lchw,lc->chw", olats, weights[0])
    torch.testing.assert_close(image, summed, rtol=1e-3, atol=3e-3)  # harmonics of a bounce are clamped at 0
    restored = BakedView.unpacked(view.packed())
    assert {getattr(restored, one.name).dtype for one in fields(view)} == {
        getattr(view, one.name).dtype for one in fields(view)
    }
    off = (images_under(restored, surface, weights, 24)[0] - image).abs()
    assert off.mean() < 0.01 * image.mean()


def test_truth_lies_beside_the_photo(subject: SyntheticPerson, view: BakedView) -> None:
    surface = materials_of(view, subject.appearance)
    photo, alpha = images_under(view, surface, torch.full((1, 24, 3), 0.1))[0], view.alpha
    albedo, normals = albedo_of(view, surface)
    assert photo.shape == albedo.shape == normals.shape == (3, SIDE_PX, SIDE_PX)
    background = view.classes[..., class_index("background")]
    assert torch.equal(alpha, 1 - background)
    assert torch.allclose(albedo[0][alpha > 0.99], torch.tensor(0.5), atol=2e-3)
    assert (photo[:, alpha == 0] == 0).all()


def test_landmarks_and_pose_are_those_of_the_camera(subject: SyntheticPerson, view: BakedView) -> None:
    assert torch.allclose(view.landmarks_px[:68], torch.tensor([SIDE_PX / 2, SIDE_PX / 2]), atol=1e-3)
    ear = view.landmarks_px[68 + MORE_LANDMARKS.index(EAR)]
    assert view.landmarks_px[68:].isnan().all(1).sum() == len(MORE_LANDMARKS) - 1
    assert float(ear[1]) == pytest.approx(SIDE_PX / 2 - 0.02 / 0.14 * SIDE_PX, abs=0.05)
    assert torch.allclose(view.rotation, pose_to_rotation(-15, 0, 0) @ subject.head_to_world, atol=1e-6)
