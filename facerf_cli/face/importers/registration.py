"""Where the canonical grid lies on another mesh: its landmarks warp the chart, rays find its surface."""

import numpy as np
import trimesh
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import median_filter
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from facerf_cli.errors import InputError
from facerf_cli.face.topology import GRID, LANDMARK_UV, chart_rays, chart_uv, grid_uv, landmark_weights

_SLIP_M = 0.006  # a ray this far behind its neighbours slipped between the lips or lids
_PULL_M = 0.005  # how far around a landmark the grid is pulled onto it
_COVERED = 0.75  # of the chart, by a model's surface
_CANDIDATES = 12  # triangles by their centres, among which the nearest point is sought


def register(
    mean: np.ndarray, triangles: np.ndarray, landmarks: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the canonical vertices lie on a mesh: ids and barycentric weights [V, 3], and if they do [V].

    The displacement of the landmarks [68, 3] from their canonical (u, v) bends the whole grid (thin plate).
    """
    warp = RBFInterpolator(LANDMARK_UV, chart_uv(landmarks) - LANDMARK_UV, kernel="thin_plate_spline")
    uv = grid_uv().double().numpy()
    mesh = trimesh.Trimesh(mean, triangles, process=False)
    points, covered = _cast(mesh, *chart_rays(uv + warp(uv)))
    points, faces = nearest_on_mesh(mesh, _pulled(points, landmarks))
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
    weights = np.clip(weights, 0, None)
    return triangles[faces], weights / weights.sum(-1, keepdims=True), covered


def _cast(
    mesh: trimesh.Trimesh, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the grid's rays meet the mesh [V, 3], and if they do [V].

    One that slips into a slit ends where its neighbours do.
    """
    points, rays, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    if len(rays) < len(origins) * _COVERED:
        raise InputError(
            f"its surface covers {100 * len(rays) / len(origins):.0f} % of the face, from the forehead to "
            f"below the chin; {100 * _COVERED:.0f} % are needed, so give the model's larger mesh"
        )
    travelled = np.full(len(origins), np.inf)
    travelled[rays] = np.linalg.norm(points - origins[rays], axis=-1)
    filled = np.where(np.isfinite(travelled), travelled, travelled[rays].max())
    usual = median_filter(filled.reshape(GRID, GRID), 5).ravel()
    ends = origins + directions * np.where(travelled < usual + _SLIP_M, travelled, usual)[:, None]
    return ends, np.isfinite(travelled)


def _pulled(points: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Points [V, 3] moved, smoothly and near landmarks alone, so that the grid's come to lie on the model's.

    Rays cannot do that where a landmark hides from them, as the inner corners of the mouth behind the lips.
    """
    corners, weights = (tensor.numpy() for tensor in landmark_weights())
    reached = (points[corners] * weights[..., None]).sum(1)
    kernel = np.exp(-((cdist(reached, reached) / _PULL_M) ** 2))
    strength = np.linalg.solve(kernel + 1e-3 * np.eye(len(reached)), landmarks - reached)
    return points + np.exp(-((cdist(points, reached) / _PULL_M) ** 2)) @ strength


def nearest_on_mesh(mesh: trimesh.Trimesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh's points [N, 3] nearest to `points` [N, 3], and their faces [N]."""
    _, nearby = cKDTree(mesh.triangles_center).query(points, _CANDIDATES)
    closest = np.stack(
        [trimesh.triangles.closest_point(mesh.triangles[faces], points) for faces in nearby.T]
    )  # [candidates, N, 3]
    best = np.linalg.norm(closest - points, axis=-1).argmin(0)
    rows = np.arange(len(points))
    return closest[best, rows], nearby[rows, best]


def rigid_alignment(points: np.ndarray, onto: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and translation [3] that bring points [N, 3] nearest to `onto` [N, 3] (Kabsch)."""
    centre, target = points.mean(0), onto.mean(0)
    u, _, vt = np.linalg.svd((points - centre).T @ (onto - target))
    flip = np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ flip @ u.T
    return rotation, target - rotation @ centre
