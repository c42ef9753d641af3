"""Where the canonical grid lies on another mesh: its landmarks warp the chart, rays find its surface.

The 68 landmarks of a model that names few of them, or none: the built-in face is laid onto its mean.

The built-in model's identities bend it (iterative closest points, with a Gaussian process for the stiffness:
Lüthi et al., 'Gaussian Process Morphable Models'): each round looks up the nearest point of the other
surface, and solves for the pose and the coefficients that bring the two together along the normals.
Landmarks that are known hold it in place; what it still misses them by is spread over the others.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import trimesh
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import median_filter
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import (
    GRID,
    LANDMARK_UV,
    LANDMARKS_M,
    cylinder_rays,
    cylinder_uv,
    grid_triangles,
    grid_uv,
    landmark_weights,
)

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
    warp = RBFInterpolator(LANDMARK_UV, cylinder_uv(landmarks) - LANDMARK_UV, kernel="thin_plate_spline")
    uv = grid_uv().double().numpy()
    mesh = trimesh.Trimesh(mean, triangles, process=False)
    points, covered = _cast(mesh, *cylinder_rays(uv + warp(uv)))
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


_NOSE_TIP = 30
_STEP = 3  # every third vertex of the grid each way takes part
_ROUNDS = 24
_REACH_M = (0.030, 0.005)  # pairs further apart are left out: in the first round, and in the last
_NOISE_M = (0.010, 0.0007)  # of a pair's distance along the normal, likewise; a coefficient's is 1
_SLIDE = 6.0  # times as much noise along the surface, which keeps the face from drifting
_KNOWN_NOISE_M = 0.0005
_FACING = 0.6  # cosine between the normals of a pair, at least
_BESIDE_M = 0.004  # further from the surface, a landmark lies beyond its border, and stays there
_FEW = 4  # known landmarks that fix a pose


@dataclass(frozen=True, eq=False)
class _Face:
    """The built-in model where it takes part: mean [M, 3], basis [M, 3, K]; the landmarks come last."""

    mean: np.ndarray
    basis: np.ndarray
    rows: int  # how many of the points are of the surface; the landmarks follow

    def points(self, alpha: np.ndarray) -> np.ndarray:
        """[M, 3] in the head frame."""
        return self.mean + self.basis @ alpha


def find_landmarks(mean: np.ndarray, triangles: np.ndarray, known: dict[int, np.ndarray]) -> np.ndarray:
    """The 68 points [68, 3] on a mean [N, 3], in metres, y up, z out of the face; `known` ones are kept.

    Where fewer than four are known, the tip of the nose is taken to lie furthest forward of all. An
    InputError where no face is found.
    """
    mesh = trimesh.Trimesh(mean, triangles, process=False)
    rotation, translation = _start(mean[np.unique(triangles)], known)
    alpha = np.zeros(_face().basis.shape[-1])
    inner = _inner(mesh)
    for share in np.linspace(0, 1, _ROUNDS):
        rotation, translation, alpha = _round(mesh, inner, known, rotation, translation, alpha, share)
    found = (_face().points(alpha) @ rotation.T + translation)[_face().rows :]
    found = found if len(known) < _FEW else found + _missed(found, known)
    onto, _ = nearest_on_mesh(mesh, found)
    there = np.linalg.norm(onto - found, axis=-1) < _BESIDE_M
    found[there] = onto[there]
    for index, point in known.items():
        found[index] = point
    return found


@cache
def _face() -> _Face:
    model, (corners, weights) = load_face_model(), landmark_weights()
    grid = np.arange(GRID * GRID).reshape(GRID, GRID)[2:-2:_STEP, 2:-2:_STEP].ravel()

    def taken(field: np.ndarray) -> np.ndarray:
        landmarks = (field[..., corners.numpy(), :] * weights.numpy()[..., None]).sum(-2)
        return np.concatenate([field[..., grid, :], landmarks], -2)

    mean, basis = (taken(field.double().numpy()) for field in (model.mean, model.identity))
    return _Face(mean, np.moveaxis(basis, 0, -1), len(grid))


@cache
def _normals() -> np.ndarray:
    """Of the built-in mean where it takes part [M, 3]; little of them changes as it bends."""
    mesh = trimesh.Trimesh(load_face_model().mean.double().numpy(), grid_triangles().numpy(), process=False)
    return mesh.vertex_normals.reshape(GRID, GRID, 3)[2:-2:_STEP, 2:-2:_STEP].reshape(-1, 3)


def _start(points: np.ndarray, known: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    if len(known) >= _FEW:
        indices = list(known)
        return rigid_alignment(LANDMARKS_M[indices], np.stack([known[index] for index in indices]))
    tip = known.get(_NOSE_TIP, points[points[:, 2].argmax()])
    return np.eye(3), tip - LANDMARKS_M[_NOSE_TIP]


def _inner(mesh: trimesh.Trimesh) -> np.ndarray:
    """The faces [F] away from any border, which all that lies beyond it would be drawn to."""
    border = mesh.edges_sorted[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    return np.logical_not(np.isin(mesh.faces, border).any(1))


def _round(
    mesh: trimesh.Trimesh,
    inner: np.ndarray,
    known: dict[int, np.ndarray],
    rotation: np.ndarray,
    translation: np.ndarray,
    alpha: np.ndarray,
    share: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A step of least squares from the nearest points, `share` of the way through the rounds."""
    face = _face()
    turned = face.points(alpha) @ rotation.T
    points, count = turned + translation, face.rows
    nearest, faces = nearest_on_mesh(mesh, points[:count])
    off = nearest - points[:count]
    reach, noise = (low ** (1 - share) * high**share for low, high in (_REACH_M, _NOISE_M))
    normals = mesh.face_normals[faces]
    facing = np.abs((normals * (_normals() @ rotation.T)).sum(-1)) > _FACING  # of either winding
    used = facing & inner[faces] & (np.linalg.norm(off, axis=-1) < reach)
    if used.sum() < count // 3:
        raise InputError("no face is found on its mean; y should be up, and z out of the face")
    along = normals[:, :, None] * normals[:, None]  # [M, 3, 3] projections onto the normals
    weigh = (along + (np.eye(3) - along) / _SLIDE) / noise * used[:, None, None]
    by_pose = np.concatenate([_skew(-turned), np.broadcast_to(np.eye(3), (*turned.shape, 3))], -1)
    jacobian = np.concatenate([by_pose, rotation @ face.basis], -1)  # [M, 3, 6 + K]
    rows, right = weigh @ jacobian[:count], (weigh @ off[..., None])[..., 0]
    if known:
        indices = count + np.array(list(known))
        rows = np.concatenate([rows, jacobian[indices] / _KNOWN_NOISE_M])
        right = np.concatenate([right, (np.stack(list(known.values())) - points[indices]) / _KNOWN_NOISE_M])
    return _solved(rows.reshape(-1, rows.shape[-1]), right.ravel(), rotation, translation, alpha)


def _solved(
    rows: np.ndarray, right: np.ndarray, rotation: np.ndarray, translation: np.ndarray, alpha: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    prior = np.concatenate([np.zeros(6), np.ones(len(alpha))])
    gradient = rows.T @ right - prior * np.concatenate([np.zeros(6), alpha])
    step = np.linalg.solve(rows.T @ rows + np.diag(prior + 1e-9), gradient)
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    return turn @ rotation, translation + step[3:6], alpha + step[6:]


def _skew(vectors: np.ndarray) -> np.ndarray:
    """[..., 3, 3] whose product with w is the cross product of vectors [..., 3] and w."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vectors.shape, 3)


def _missed(found: np.ndarray, known: dict[int, np.ndarray]) -> np.ndarray:
    """What [68, 3] brings landmarks to the known ones, and moves the others with them."""
    indices = list(known)
    off = np.stack([known[index] for index in indices]) - found[indices]
    return RBFInterpolator(found[indices], off, kernel="linear")(found)
