import numpy as np
import pytest
import torch
import trimesh

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import GRID, grid_triangles
from facerf_cli.light.mesh_transport import MeshTransport, bake_mesh
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings, bake_transport, build_scene
from facerf_cli.light.transport import occluded as embree_occluded
from facerf_cli.raster.camera import Camera, project
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.raster.texture import bake_attributes, normal_map
from tests.oracles import visibility as oracle

POINT_LIGHT = BakeSettings(light_samples=1, light_radius_deg=0, bounce_samples=0)
SIDE = 48


@pytest.fixture(scope="module")
def head() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [V, 3], texel positions and normals [T, T, 3] of the built-in mean face."""
    vertices = load_face_model().mean
    positions = bake_attributes(vertices, GRID, SIDE).permute(1, 2, 0)
    normals = normal_map(vertices, grid_triangles(), SIDE).permute(1, 2, 0)
    return vertices.numpy(), positions.numpy(), normals.numpy()


def test_occlusion_agrees_with_the_brute_force_oracle() -> None:
    random = np.random.default_rng(0)
    triangles = random.normal(size=(40, 3, 3))
    origins = random.normal(size=(300, 3)).astype(np.float32)
    direction = np.array([0.36, 0.48, 0.8])
    scene = build_scene(triangles.reshape(-1, 3), np.arange(120).reshape(-1, 3))
    found = embree_occluded(scene, origins, np.repeat(direction[None], 300, 0).astype(np.float32))
    assert (found == oracle.occluded(origins, direction, triangles)).mean() > 0.995
    assert 0.2 < found.mean() < 0.9


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (-0.5, 0.7, 0.51)])
def test_shadows_agree_with_the_rasterizer_seen_from_the_light(
    head: tuple[np.ndarray, ...], direction: tuple
) -> None:
    vertices, positions, normals = head
    light = np.array(direction) / np.linalg.norm(direction)
    baked = bake_transport(positions, normals, vertices, grid_triangles().numpy(), light[None], POINT_LIGHT)
    facing = normals @ light
    seen = _seen_from(light, vertices, positions)
    clear = np.abs(facing) > 0.25  # grazing texels lie within the depth map's own error
    assert (seen[clear & (facing > 0)] == (baked.visibility[0][clear & (facing > 0)] > 0.5)).mean() > 0.97
    assert (baked.visibility[0][facing < 0] == 0).all()


def _seen_from(light: np.ndarray, vertices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Visibility [T, T] by the z-buffer of a far camera that looks along the light."""
    right = np.cross([0, 1, 0], light) / np.linalg.norm(np.cross([0, 1, 0], light))
    head_to_camera = np.stack([right, np.cross(light, right), light])
    camera, distance_m = Camera(1000 * 1500.0, 700, 700, 350, 350), 1000.0

    def to_camera(points: np.ndarray) -> torch.Tensor:
        moved = points.reshape(-1, 3) @ head_to_camera.T - [0, 0.0, distance_m]
        return torch.from_numpy(moved.astype(np.float64))

    fragments = rasterize(to_camera(vertices - [0, 0, 0.1]), grid_triangles(), camera)
    texels = to_camera(positions - [0, 0, 0.1])
    px = project(texels, camera).floor().long().clamp(0, 699)
    in_front = fragments.depth_m[px[:, 1], px[:, 0]] < -texels[:, 2] - 0.002
    return ~in_front.reshape(positions.shape[:2]).numpy()


def test_a_sphere_gets_no_bounce_from_itself() -> None:
    azimuth, height = np.meshgrid(np.linspace(-1, 1, 20), np.linspace(0.8, -0.8, 20))
    radius = np.sqrt(1 - height**2)
    points = np.stack([radius * np.sin(azimuth), height, radius * np.cos(azimuth)], -1)
    cells = np.arange(19 * 20).reshape(19, 20)[:, :19].ravel()
    triangles = np.concatenate(
        [np.stack([cells, cells + 20, cells + 21], -1), np.stack([cells, cells + 21, cells + 1], -1)]
    )
    settings = BakeSettings(light_samples=1, bounce_samples=8)
    baked = bake_transport(
        points, points, points.reshape(-1, 3), triangles, np.array([[0.0, 0, 1]]), settings
    )
    assert baked.bounce.max() < 0.02
    assert baked.visibility[0][points[..., 2] > 0.1].mean() > 0.95


def test_a_corner_returns_the_form_factor_of_its_other_wall() -> None:
    # Two walls at a right angle: a point at distance d from the edge sees a strip of height h with the
    # form factor (1 - 1 / sqrt(1 + (h / d)^2)) / 2, if the strip is long (Howell, C-9 in the limit).
    depth, long = 1.0, 20.0
    wall = np.array([[-long, 0, 0], [long, 0, 0], [long, depth, 0], [-long, depth, 0]])
    floor = np.array([[-long, 0, 0], [long, 0, 0], [long, 0, depth], [-long, 0, depth]])
    vertices = np.concatenate([floor, wall])
    triangles = np.array([[0, 3, 2], [0, 2, 1], [4, 5, 6], [4, 6, 7]])
    across = (np.arange(24) + 0.5) / 24
    along = np.linspace(-1.5, 1.5, 24)
    floor_texels = np.stack(np.broadcast_arrays(along[None], 0, across[:, None]), -1)
    wall_texels = np.stack(np.broadcast_arrays(along[None], across[:, None], 0), -1)
    positions = np.concatenate([floor_texels, wall_texels], 1)[:, :, :].astype(float)
    normals = np.zeros_like(positions)
    normals[:, :24, 1], normals[:, 24:, 2] = 1, 1
    light = np.array([[0.0, 0.0, 1.0]])  # lights the wall alone, head on
    settings = BakeSettings(light_samples=1, light_radius_deg=0, bounce_samples=600, bounce_blur_texels=0)
    baked = bake_transport(positions, normals, vertices, triangles, light, settings)
    expected = (1 - 1 / np.sqrt(1 + (depth / across) ** 2)) / 2
    middle = baked.bounce[0][:, 10:14].mean(1)
    assert np.abs(middle - expected).max() < 0.04


def test_the_same_seed_gives_the_same_bake(head: tuple[np.ndarray, ...]) -> None:
    vertices, positions, normals = head
    settings = BakeSettings(light_samples=1, bounce_samples=2)
    lights = rig_directions(3).numpy()
    first, second = (
        bake_transport(positions, normals, vertices, grid_triangles().numpy(), lights, settings, seed=4)
        for _ in "ab"
    )
    assert (first.visibility == second.visibility).all() and (first.bounce == second.bounce).all()


def _tessellated(corner: np.ndarray, along: np.ndarray, across: np.ndarray, count: int) -> tuple:
    """Vertices and counter-clockwise triangles of a parallelogram, and its normal."""
    a, b = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count))
    vertices = corner + a.reshape(-1, 1) * along + b.reshape(-1, 1) * across
    cells = np.arange(count * count).reshape(count, count)[:-1, :-1].ravel()
    first = np.stack([cells, cells + 1, cells + count + 1], -1)
    second = np.stack([cells, cells + count + 1, cells + count], -1)
    normal = np.cross(along, across)
    return vertices, np.concatenate([first, second]), normal / np.linalg.norm(normal)


def _joined(*pieces: tuple) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, normals, triangles of several flat pieces."""
    offsets = np.cumsum([0, *(len(vertices) for vertices, _, _ in pieces)])
    return (
        np.concatenate([vertices for vertices, _, _ in pieces]),
        np.concatenate([np.repeat(normal[None], len(vertices), 0) for vertices, _, normal in pieces]),
        np.concatenate([piece[1] + offset for piece, offset in zip(pieces, offsets, strict=False)]),
    )


def _table() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A floor of 1 m, facing up, and 0.3 m above its middle a small board that faces up too."""
    x, z = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    floor = _tessellated(np.array([-0.5, 0, -0.5]), z, x, 41)
    board = _tessellated(np.array([-0.1, 0.3, -0.1]), 0.2 * z, 0.2 * x, 9)
    return _joined(floor, board)


def _cover(bake: MeshTransport) -> np.ndarray:
    """The share [V] of the hemisphere that other surfaces cover."""
    return bake.gathered(np.ones(len(bake.sites)))[bake.site_of]


def test_a_mesh_shadow_lies_where_the_light_throws_it() -> None:
    vertices, normals, triangles = _table()
    light = np.array([1.0, 3.0, 0.0]) / np.sqrt(10)  # moves the board's shadow by 0.1 m to -x
    baked = bake_mesh(vertices, normals, triangles, light[None], POINT_LIGHT)
    floor = vertices[:, 1] == 0
    shadow = (np.abs(vertices[:, 0] + 0.1) < 0.1 - 1e-3) & (np.abs(vertices[:, 2]) < 0.1 - 1e-3)
    clear = (np.abs(vertices[:, 0] + 0.1) > 0.1 + 1e-3) | (np.abs(vertices[:, 2]) > 0.1 + 1e-3)
    assert (baked.visibility[0][floor & shadow] == 0).all() and (floor & shadow).sum() > 20
    assert (baked.visibility[0][~floor | clear] == 1).all()
    assert (bake_mesh(vertices, normals, triangles, -light[None], POINT_LIGHT).visibility == 0).all()


def test_a_wide_light_has_a_penumbra_of_its_own_width() -> None:
    vertices, normals, triangles = _table()
    light, settings = np.array([[0.0, 1.0, 0.0]]), BakeSettings(64, 10.0, 0)
    share = bake_mesh(vertices, normals, triangles, light, settings).visibility[0]
    row = (vertices[:, 1] == 0) & (np.abs(vertices[:, 2]) < 1e-6)
    x, found = vertices[row, 0], share[row]
    half_m = 0.3 * np.tan(np.radians(10))  # of the penumbra about the board's edge at 0.1 m
    offset = np.clip((np.abs(x) - 0.1) / half_m, -1, 1)
    expected = 0.5 + (offset * np.sqrt(1 - offset**2) + np.arcsin(offset)) / np.pi  # of a disc beyond a chord
    assert np.abs(found - expected).max() < 0.12  # smoothed over a vertex's neighbours
    assert np.abs(found - expected).mean() < 0.03


def test_smooth_normals_of_a_sphere_throw_no_shadow_on_it() -> None:
    sphere = trimesh.creation.icosphere(3, 0.1)
    lights = rig_directions(20).numpy()
    baked = bake_mesh(sphere.vertices, sphere.vertex_normals, sphere.faces, lights, POINT_LIGHT)
    facing = lights @ sphere.vertex_normals.T
    assert (baked.visibility[facing > 0.02] == 1).all()
    assert (baked.visibility[facing <= 0] == 0).all()
    inside_out = -sphere.vertex_normals  # a hollow: its facets rise above every tangent plane
    hollow = bake_mesh(sphere.vertices, inside_out, sphere.faces[:, ::-1], lights, BakeSettings())
    assert np.allclose(_cover(hollow), 1, atol=1e-5)  # nothing but the hollow to be seen from within


def test_a_mesh_gathers_the_form_factor_of_a_wall() -> None:
    x, y, z = np.eye(3)
    floor = _tessellated(np.array([-4.0, 0, 0]), z, 8 * x, 81)
    wall = _tessellated(np.array([-4.0, 0, 0]), 8 * x, y, 81)
    vertices, normals, triangles = _joined(floor, wall)
    settings = BakeSettings(bounce_samples=300, bounce_blur_m=0.0)
    middle = np.flatnonzero((np.abs(vertices[:, 0]) < 0.2) & (vertices[:, 1] == 0) & (normals[:, 1] == 1))
    wanted = np.isin(np.arange(len(vertices)), middle)
    baked = bake_mesh(vertices, normals, triangles, z[None], settings, wanted=wanted)
    expected = (1 - 1 / np.sqrt(1 + (1 / np.maximum(vertices[middle, 2], 1e-9)) ** 2)) / 2
    seen = _cover(baked)[middle]
    away = vertices[middle, 2] > 0.02  # on the edge itself half of all rays run along the wall
    assert np.abs(seen - expected)[away].mean() < 0.01
    bounced = baked.gathered(baked.visibility[0][baked.sites])[baked.site_of[middle]]  # it is lit head on
    assert np.abs(bounced - expected)[away].mean() < 0.01
    assert np.unique(baked.hits.nonzero()[0]).size <= wanted.sum() and (baked.baked == wanted).all()
    assert baked.visibility[0][~wanted].max() == 1  # the wall was not asked for, yet light bounces off it


def test_light_bounces_off_outsides_only() -> None:
    x, y, z = np.eye(3)
    vertices, normals, triangles = _joined(
        _tessellated(np.zeros(3), z, x, 9), _tessellated(np.array([0, 0.1, 0.0]), z, x, 9)
    )
    bake = bake_mesh(vertices, normals, triangles, y[None], BakeSettings())
    assert bake.hits.nnz == 0  # the ceiling turns its back
    flipped = triangles.copy()
    flipped[len(flipped) // 2 :] = flipped[len(flipped) // 2 :, ::-1]
    below = np.arange(len(vertices)) < 81
    facing = bake_mesh(vertices, np.where(below[:, None], normals, -normals), flipped, y[None])
    assert _cover(facing).mean() > 0.5


def test_the_same_seed_gives_the_same_mesh_bake() -> None:
    vertices, normals, triangles = _table()
    lights = rig_directions(6).numpy()
    first, second, third = (bake_mesh(vertices, normals, triangles, lights, seed=seed) for seed in (3, 3, 4))
    assert (first.visibility == second.visibility).all() and (first.hits != second.hits).nnz == 0
    assert (first.visibility != third.visibility).any()
    x, y, z = np.eye(3)
    vertices, normals, triangles = _joined(_tessellated(np.zeros(3), 0.1 * z, 0.01 * x, 5))
    lights = np.stack([y, -y])
    plain = bake_mesh(vertices, normals, triangles, lights)
    hair = bake_mesh(vertices, normals, triangles, lights, two_sided=np.ones(len(vertices), bool))
    assert (plain.visibility[0] == 1).all() and (plain.visibility[1] == 0).all()
    assert (hair.visibility == 1).all()


def test_strands_share_the_light_and_surroundings_of_those_near() -> None:
    """Only every fifth vertex is traced, and half of the strip lies in the shadow of a roof."""
    x, y, z = np.eye(3)
    strip = _tessellated(np.zeros(3), z, 0.002 * x, 101)
    roof = _tessellated(np.array([-0.5, 0.1, 0.5]), z, x, 3)
    vertices, normals, triangles = _joined(strip, roof)
    hair = vertices[:, 1] == 0
    bake = bake_mesh(vertices, normals, triangles, y[None], BakeSettings(light_radius_deg=0), two_sided=hair)
    share, along = bake.visibility[0][hair], vertices[hair, 2]
    assert (share[along < 0.49] == 1).all() and (share[along > 0.51] == 0).all()
    sites = bake.site_of[hair]
    assert len(np.unique(sites)) < 0.25 * hair.sum()
    assert np.abs(vertices[bake.sites[sites]] - vertices[hair]).max() < 0.03


def test_hair_lets_some_light_through_and_rays_clear_what_lies_close() -> None:
    x, y, z = np.eye(3)
    floor = _tessellated(np.zeros(3), z, x, 5)
    for lifted, hair_roof, expected in ((0.1, True, 0.12), (0.1, False, 0.0)):
        roof = _tessellated(np.array([-0.5, lifted, -0.5]), 2 * z, 2 * x, 3)
        vertices, normals, triangles = _joined(floor, roof)
        hair = (vertices[:, 1] > 0) & hair_roof
        bake = bake_mesh(
            vertices, normals, triangles, y[None], BakeSettings(light_radius_deg=0), two_sided=hair
        )
        np.testing.assert_allclose(bake.visibility[0][vertices[:, 1] == 0], expected, atol=1e-6)
    vertices, normals, triangles = _joined(
        _tessellated(np.zeros(3), z, x, 5), _tessellated(np.array([-0.5, 0.001, -0.5]), 2 * z, 2 * x, 3)
    )
    low = vertices[:, 1] == 0
    for clearance_m, expected in ((None, 0.0), (np.full(len(vertices), 0.0025), 1.0)):
        bake = bake_mesh(
            vertices, normals, triangles, y[None], BakeSettings(light_radius_deg=0), clearance_m=clearance_m
        )
        assert (bake.visibility[0][low] == expected).all()
