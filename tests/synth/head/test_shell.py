"""A whole head around any face: closed skin, open eyes and mouth, and the order of the parts in depth."""

import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
import torch
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import TOP_M, UV_SIZE_MM, grid_triangles, grid_uv, inside_mm
from facerf_cli.raster.camera import crop_camera, pose_to_rotation
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.synth.bank.heads import HeadBakeSettings, draw_coefficients
from facerf_cli.synth.head.mesh import PARTS, HeadMesh
from facerf_cli.synth.head.openings import lips
from facerf_cli.synth.head.shell import EYEBALL_RADIUS_MM, shell_head

FACES = ("mean", "jaw_open", "blink", "half_blink", *range(2))
AWAY_FROM_CUTS_MM = 2.5


@cache
def model() -> MorphableModel:
    return load_face_model()


@cache
def face(which: str | int) -> torch.Tensor:
    """Canonical vertices of the mean with an expression, or of a random person."""
    alpha, beta = torch.zeros(len(model().identity)), torch.zeros(len(model().expression))
    if isinstance(which, int):
        alpha, beta = draw_coefficients(model(), np.random.default_rng([7, which]), HeadBakeSettings())
    strength = {"jaw_open": 2.0, "blink": 2.0, "half_blink": 1.0}.get(str(which), 0.0)
    stem = "eye_close" if "blink" in str(which) else str(which)
    for index, name in enumerate(model().expression_names):
        if name.startswith(stem):
            beta[index] = strength
    return model().vertices(alpha[None], beta[None])[0]


@cache
def head(which: str | int) -> HeadMesh:
    return shell_head(face(which), (0.0, 0.0), 0 if isinstance(which, int) else 1)


def of_part(mesh: HeadMesh, name: str) -> np.ndarray:
    return mesh.triangles[mesh.part[mesh.triangles[:, 0]] == PARTS.index(name)]


def welded(mesh: HeadMesh) -> np.ndarray:
    """A number [V] for each place of a vertex."""
    bits = (mesh.vertices + np.float32(0)).view(np.uint32).astype(np.uint64)
    hashed = bits @ np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    return np.unique(hashed, return_inverse=True)[1]


def border(mesh: HeadMesh, triangles: np.ndarray) -> np.ndarray:
    """Edges [E, 2] that only one triangle has, by welded number."""
    corners = welded(mesh)[triangles]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    count = len(mesh.vertices)
    forward, backward = edges @ [count, 1], edges @ [1, count]
    return edges[~np.isin(forward, backward)]


def loops(edges: np.ndarray) -> list[np.ndarray]:
    """The closed loops that edges make, as numbers of places."""
    places, ends = np.unique(edges, return_inverse=True)
    ends = ends.reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(places),) * 2)
    count, label = connected_components(graph, directed=False)
    assert (np.bincount(ends.ravel()) == 2).all(), "a border that forks or ends"
    return [places[label == number] for number in range(count)]


@pytest.mark.parametrize("which", FACES)
def test_the_skin_is_closed_with_normals_turned_outward(which: str | int) -> None:
    mesh = head(which)
    found = loops(border(mesh, of_part(mesh, "skin")))
    heights = np.empty(len(mesh.vertices))
    heights[welded(mesh)] = mesh.vertices[:, 1]
    widths = np.empty(len(mesh.vertices))
    widths[welded(mesh)] = mesh.vertices[:, 0]
    necks = [loop for loop in found if heights[loop].max() < -0.13]
    assert len(necks) == 1 and np.ptp(widths[necks[0]]) > 0.1
    rims = [loop for loop in found if heights[loop].max() >= -0.13]
    assert all(np.ptp(widths[loop]) < 0.08 for loop in rims)
    expected = {"mean": 2, "jaw_open": 3, "blink": 0, "half_blink": 2}
    assert len(rims) == expected.get(str(which), len(rims)) <= 3
    assert mesh.vertices.dtype == mesh.normals.dtype == mesh.uv.dtype == np.float32
    assert mesh.triangles.dtype == np.int64
    for values in (mesh.vertices, mesh.normals, mesh.uv):
        assert np.isfinite(values).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-5)
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    facing = np.cross(b - a, c - a)
    agree = (facing * mesh.normals[mesh.triangles].sum(1)).sum(-1) >= 0
    assert agree.mean() > 0.995
    assert (mesh.part[mesh.triangles] == mesh.part[mesh.triangles[:, :1]]).all()
    for name in ("skin", "eye", "teeth"):
        inside = mesh.part[mesh.triangles[:, 0]] == PARTS.index(name)
        if inside.any():
            middle = (a[inside] if name == "skin" else a[inside] - a[inside].mean(0)) - (0, 0, 0)
            assert (facing[inside] * middle).sum() > 0, name
    away = np.abs(mesh.normals[:, 1]) < 0.5
    outside = away & (np.abs(mesh.vertices[:, 2] + 0.06) < 0.02) & (mesh.part == 0)
    assert (mesh.normals[outside] * mesh.vertices[outside])[:, [0, 2]].sum(-1).min() > 0


@pytest.mark.parametrize("which", FACES)
def test_the_face_is_kept_away_from_the_cuts(which: str | int) -> None:
    mesh, vertices = head(which), face(which).numpy()
    skin = np.unique(of_part(mesh, "skin"))
    uv = mesh.uv[skin].astype(np.float64)
    on_chart = ((uv > 0) & (uv < 1)).all(-1) & (np.abs(mesh.vertices[skin, 0]) < 0.074)
    on_chart = np.flatnonzero(on_chart)
    assert len(on_chart) > 8000
    on_chart = on_chart[:: len(on_chart) // 3000]
    left = np.stack([np.minimum(uv[on_chart, 0], 1 - uv[on_chart, 0]), uv[on_chart, 1]], -1)
    inside = np.maximum(inside_mm("eyes", left), inside_mm("mouth", uv[on_chart]))
    sample = skin[on_chart[inside < -AWAY_FROM_CUTS_MM]]
    chart = trimesh.Trimesh(vertices, grid_triangles().numpy(), process=False)
    _, nearby = cKDTree(chart.triangles_center).query(mesh.vertices[sample], 12)
    points = mesh.vertices[sample].astype(np.float64)
    closest = [trimesh.triangles.closest_point(chart.triangles[faces], points) for faces in nearby.T]
    distance = np.linalg.norm(np.stack(closest) - points, axis=-1).min(0)
    assert np.quantile(distance, 0.99) < 1e-4
    assert distance.max() < 6e-4  # a spline instead of facets, in the creases of nose and lips


@pytest.mark.parametrize("which", FACES)
def test_the_surface_is_smooth_across_the_border_of_the_face(which: str | int) -> None:
    mesh = head(which)
    skin = of_part(mesh, "skin")
    corners = mesh.vertices[skin].astype(np.float64)
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing /= np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-20)
    middle = mesh.uv[skin].mean(1)
    worst = []
    for inside, outside in ((0.998, 1.004), (0.002, -0.004)):
        tree = cKDTree(middle[(np.abs(middle[:, 0] - outside) < 0.003)])
        beyond = facing[np.abs(middle[:, 0] - outside) < 0.003]
        near = (np.abs(middle[:, 0] - inside) < 0.002) & (middle[:, 1] > 0.02) & (middle[:, 1] < 0.8)
        _, match = tree.query(middle[near])
        worst.append(np.quantile((facing[near] * beyond[match]).sum(-1), 0.05))
    assert min(worst) > np.cos(np.radians(8))


@pytest.mark.parametrize("which", FACES)
def test_eyeballs_stay_behind_the_lids(which: str | int) -> None:
    mesh = head(which)
    balls = of_part(mesh, "eye")
    skin = mesh.vertices[np.unique(of_part(mesh, "skin"))].astype(np.float64) * 1000
    uv = mesh.uv[np.unique(of_part(mesh, "skin"))]
    for side in (-1, 1):
        points = mesh.vertices[np.unique(balls[mesh.vertices[balls[:, 0], 0] * side > 0])] * 1000.0
        centre = (points.min(0) + points.max(0)) / 2
        centre[2] = points[:, 2].min() + EYEBALL_RADIUS_MM
        assert abs(np.linalg.norm(points - centre, axis=-1).min() - EYEBALL_RADIUS_MM) < 0.01
        around = np.linalg.norm(skin[:, :2] - centre[:2], axis=-1) < 16
        ahead = around & (skin[:, 2] > centre[2])
        outer = np.minimum(uv[:, 0], 1 - uv[:, 0])
        near = np.flatnonzero(ahead)
        near = near[inside_mm("eyes", np.stack([outer, uv[:, 1]], -1)[near]) < -0.3]
        assert np.linalg.norm(skin[near] - centre, axis=-1).min() > EYEBALL_RADIUS_MM + 0.3


def seen_parts(mesh: HeadMesh, yaw: float = 0, pitch: float = 0) -> dict[str, int]:
    turned = torch.from_numpy(mesh.vertices) @ pose_to_rotation(yaw, pitch, 0).T - torch.tensor([0, 0, 1.1])
    seen = rasterize(turned, torch.from_numpy(mesh.triangles), crop_camera(256)).triangle
    part = mesh.part[mesh.triangles[:, 0]][seen[seen >= 0].numpy()]
    return {name: int((part == number).sum()) for number, name in enumerate(PARTS)}


def test_eyes_and_teeth_are_seen_where_they_are_open() -> None:
    for yaw, pitch in ((0, 0), (40, 0), (0, -30)):
        assert seen_parts(head("mean"), yaw, pitch)["teeth"] == 0
        assert seen_parts(head("jaw_open"), yaw, pitch)["teeth"] > 60
    assert seen_parts(head("jaw_open"))["mouth"] > 60
    assert seen_parts(head("jaw_open"), 150)["teeth"] == seen_parts(head("jaw_open"), 150)["mouth"] == 0
    opened, half, shut = (seen_parts(head(which))["eye"] for which in ("mean", "half_blink", "blink"))
    assert opened > 1.5 * half > 0 == shut

    def rows(which: str) -> tuple[float, float]:
        points = head(which).vertices[np.unique(of_part(head(which), "teeth"))]
        half = len(points) // 2
        return float(points[:half, 1].mean()), float(points[half:, 1].mean())

    vertices = (face("mean") + face("jaw_open")) / 2
    half_open = shell_head(vertices, (0.0, 0.0), 1)
    points = half_open.vertices[np.unique(of_part(half_open, "teeth"))]
    upper, lower = rows("jaw_open")
    assert abs(points[: len(points) // 2, 1].mean() - upper) < 1e-3
    assert points[len(points) // 2 :, 1].mean() - lower > 6e-3


def test_a_symmetric_face_gives_a_symmetric_head_of_known_measures() -> None:
    for which in ("mean", "jaw_open"):
        points = head(which).vertices.astype(np.float64)
        distance, _ = cKDTree(points).query(points * [-1, 1, 1])
        assert distance.max() < 5e-5
    mesh = head("mean")
    skull = mesh.vertices[(mesh.part == 0) & (mesh.vertices[:, 1] > 0.05)] * 1000
    assert 145 < np.ptp(skull[:, 0]) < 165  # breadth; adults: 135 to 165
    assert 185 < np.ptp(skull[:, 2]) < 205  # length from the glabella
    assert 80 < skull[:, 1].max() - 60 < 105  # above the brows
    assert mesh.vertices[:, 1].min() == pytest.approx(-0.17, abs=0.01)


def test_the_gaze_turns_the_eyes() -> None:
    ahead = head("mean")
    turned = shell_head(face("mean"), (20.0, 10.0), 1)
    eye = np.flatnonzero(ahead.part == PARTS.index("eye"))
    np.testing.assert_allclose(ahead.uv[eye], turned.uv[eye])
    pupil = eye[np.linalg.norm(ahead.uv[eye] - 0.5, axis=-1) < 1e-6]
    assert len(pupil) == 2
    np.testing.assert_allclose(ahead.normals[pupil], [[0, 0, 1]] * 2, atol=1e-3)
    moved = turned.vertices[pupil] - ahead.vertices[pupil]
    assert (moved[:, 0] > 3e-3).all() and (moved[:, 1] > 1.5e-3).all()
    right = eye[(np.abs(ahead.uv[eye, 0] - 0.75) < 0.15) & (np.abs(ahead.uv[eye, 1] - 0.5) < 0.02)]
    assert (ahead.normals[right, 0] > 0.3).all()
    above = eye[(np.abs(ahead.uv[eye, 1] - 0.25) < 0.15) & (np.abs(ahead.uv[eye, 0] - 0.5) < 0.02)]
    assert (ahead.normals[above, 1] > 0.3).all()


def test_uv_continues_that_of_the_face() -> None:
    mesh = head("mean")
    skin = mesh.part == 0
    grid, points = grid_uv().numpy(), face("mean").numpy()
    distance, nearest = cKDTree(mesh.vertices[skin]).query(points[::37])
    close = distance < 3e-4
    assert close.sum() > 100
    wrong_mm = np.abs(mesh.uv[skin][nearest[close]] - grid[::37][close]) * UV_SIZE_MM
    assert wrong_mm.max() < 1
    u, v = mesh.uv[skin].T
    assert -1 < u.min() < -0.95 and 1.95 < u.max() < 2
    assert -0.4 < v.min() < -0.25 and v.max() == pytest.approx((TOP_M + 0.17) / 0.174, abs=0.01)


def test_a_head_does_not_depend_on_the_number_of_threads() -> None:
    """A process of --jobs 2 has fewer of them than one of --jobs 1."""
    threads = "4" if torch.get_num_threads() == 1 else "1"
    done = subprocess.run(
        [sys.executable, "-c", "from tests.synth.head.test_shell import numbers; print(numbers())"],
        env=os.environ | {"OMP_NUM_THREADS": threads, "PYTHONPATH": str(Path(__file__).parents[3])},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == numbers()


def numbers() -> str:
    """Checksums of lips and of a head."""
    arrays = [lip.weights for name in ("eye_left", "mouth") for lip in lips(name)]
    arrays.append(shell_head(model().mean, (0.0, 0.0), 0).vertices)
    return " ".join(str(crc32(one.tobytes())) for one in arrays)
