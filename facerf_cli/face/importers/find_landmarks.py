"""The 68 landmarks of a face model whose publisher names few or none.

The built-in face is fitted to the mean by iterative closest points, with the built-in identities as a
Gaussian process that limits the deformation (Lüthi et al., 'Gaussian Process Morphable Models'). Each round
finds the nearest points of the other surface, and solves for the pose and the coefficients that bring both
together along the normals. Known landmarks take part with a small noise; the distances to them that remain
are interpolated to the others.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import trimesh
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from facerf_cli.errors import InputError
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import GRID, LANDMARKS_M, grid_triangles, landmark_weights
from facerf_cli.raster.camera import skew_matrix

_NOSE_TIP = 30
_STEP = 3  # every third row and column of the grid takes part
_ROUNDS = 24
_REACH_M = (0.030, 0.005)  # pairs further apart are left out: in the first round, in the last round
_NOISE_M = (0.010, 0.0007)  # of a pair's distance along the normal, likewise; that of a coefficient is 1
_SLIDE = 6.0  # factor of the noise along the surface, which keeps the face from drifting
_KNOWN_NOISE_M = 0.0005
_FACING = 0.6  # least cosine between the normals of a pair
_BEYOND_M = 0.004  # a landmark further from the surface lies beyond its border and is not moved onto it
_FEW = 4  # known landmarks that determine a pose
_CANDIDATES = 12  # the nearest point is searched in this many triangles, those with the nearest centres


def landmarks_of(source: SourceModel) -> np.ndarray:
    """The landmarks [68, 3] on the source's mean: the known ones, and the others found by shape."""
    if len(source.known) == 68:
        return np.stack([source.known[number] for number in range(68)])
    return find_landmarks(source.mean, source.triangles, source.known)


@dataclass(frozen=True, eq=False)
class _SparseFace:
    """The built-in model at the points that take part: mean [M, 3], basis [M, 3, K]; landmarks last."""

    mean: np.ndarray
    basis: np.ndarray
    rows: int  # number of points before the landmarks

    def points(self, alpha: np.ndarray) -> np.ndarray:
        """The points [M, 3] in the head frame."""
        return self.mean + self.basis @ alpha


def find_landmarks(mean: np.ndarray, triangles: np.ndarray, known: dict[int, np.ndarray]) -> np.ndarray:
    """Find the landmarks [68, 3] on a mean [N, 3] in metres, y up, z out of the face; `known` ones are kept.

    With fewer than four known landmarks the foremost point is taken for the tip of the nose. Raises
    InputError where no face is found.
    """
    mesh = trimesh.Trimesh(mean, _outward(mean, triangles), process=False)
    rotation, translation = _start(mean[np.unique(triangles)], known)
    alpha = np.zeros(_sparse_face().basis.shape[-1])
    # Faces away from the border: points beyond the border would all pair with it.
    border = mesh.edges_sorted[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    inner = np.logical_not(np.isin(mesh.faces, border).any(1))
    for share in np.linspace(0, 1, _ROUNDS):
        rotation, translation, alpha = _round(mesh, inner, known, rotation, translation, alpha, share)
    found = (_sparse_face().points(alpha) @ rotation.T + translation)[_sparse_face().rows :]
    found = found if len(known) < _FEW else found + _correction(found, known)
    onto, _ = nearest_on_mesh(mesh, found)
    there = np.linalg.norm(onto - found, axis=-1) < _BEYOND_M
    found[there] = onto[there]
    for index, point in known.items():
        found[index] = point
    return found


def _outward(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return triangles [F, 3] that are counter-clockwise from outside, whichever way they were wound.

    A point nearest to an edge is equally near to two faces, and rounding, which depends on the order of the
    corners, chooses one of their normals. Over all rounds this moves a landmark by up to 0.05 mm.
    """
    centred = points - points[np.unique(triangles)].mean(0)
    a, b, c = centred[triangles].swapaxes(0, 1)
    six_volumes = np.einsum("fc,fc->", a, np.cross(b, c))
    return triangles if six_volumes >= 0 else triangles[:, [0, 2, 1]]


@cache  # all steps of a search share it
def _sparse_face() -> _SparseFace:
    model, (corners, weights) = load_face_model(), landmark_weights()
    grid = np.arange(GRID * GRID).reshape(GRID, GRID)[2:-2:_STEP, 2:-2:_STEP].ravel()

    def taken(field: np.ndarray) -> np.ndarray:
        landmarks = (field[..., corners.numpy(), :] * weights.numpy()[..., None]).sum(-2)
        return np.concatenate([field[..., grid, :], landmarks], -2)

    mean, basis = (taken(field.double().numpy()) for field in (model.mean, model.identity))
    return _SparseFace(mean, np.moveaxis(basis, 0, -1), len(grid))


def _normals() -> np.ndarray:
    """Normals [M, 3] of the built-in mean at the points; the deformation changes them little."""
    mesh = trimesh.Trimesh(load_face_model().mean.double().numpy(), grid_triangles().numpy(), process=False)
    return mesh.vertex_normals.reshape(GRID, GRID, 3)[2:-2:_STEP, 2:-2:_STEP].reshape(-1, 3)


def _start(points: np.ndarray, known: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The first rotation [3, 3] and translation [3]."""
    if len(known) >= _FEW:
        indices = list(known)
        return rigid_alignment(LANDMARKS_M[indices], np.stack([known[index] for index in indices]))
    tip = known.get(_NOSE_TIP, points[points[:, 2].argmax()])
    return np.eye(3), tip - LANDMARKS_M[_NOSE_TIP]


def _round(
    mesh: trimesh.Trimesh,
    inner: np.ndarray,
    known: dict[int, np.ndarray],
    rotation: np.ndarray,
    translation: np.ndarray,
    alpha: np.ndarray,
    share: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Do a round of least squares on the nearest points; `share` runs from 0 to 1 over the rounds."""
    face = _sparse_face()
    turned = face.points(alpha) @ rotation.T
    points, count = turned + translation, face.rows
    nearest, faces = nearest_on_mesh(mesh, points[:count])
    off = nearest - points[:count]
    reach, noise = (low ** (1 - share) * high**share for low, high in (_REACH_M, _NOISE_M))
    normals = mesh.face_normals[faces]
    facing = np.abs((normals * (_normals() @ rotation.T)).sum(-1)) > _FACING  # abs: the winding may be either
    used = facing & inner[faces] & (np.linalg.norm(off, axis=-1) < reach)
    if used.sum() < count // 3:
        raise InputError("no face is found on its mean; turn it so that y is up and z points out of the face")
    along = normals[:, :, None] * normals[:, None]  # [M, 3, 3] projections onto the normals
    weights = (along + (np.eye(3) - along) / _SLIDE) / noise * used[:, None, None]
    by_turn = skew_matrix(torch.from_numpy(-turned)).numpy()
    by_pose = np.concatenate([by_turn, np.broadcast_to(np.eye(3), by_turn.shape)], -1)
    jacobian = np.concatenate([by_pose, rotation @ face.basis], -1)  # [M, 3, 6 + K]
    rows, right = weights @ jacobian[:count], (weights @ off[..., None])[..., 0]
    if known:
        indices = count + np.array(list(known))
        rows = np.concatenate([rows, jacobian[indices] / _KNOWN_NOISE_M])
        right = np.concatenate([right, (np.stack(list(known.values())) - points[indices]) / _KNOWN_NOISE_M])
    rows = rows.reshape(-1, rows.shape[-1])
    prior = np.concatenate([np.zeros(6), np.ones(len(alpha))])
    gradient = rows.T @ right.ravel() - prior * np.concatenate([np.zeros(6), alpha])
    step = np.linalg.solve(rows.T @ rows + np.diag(prior + 1e-9), gradient)
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    return turn @ rotation, translation + step[3:6], alpha + step[6:]


def _correction(found: np.ndarray, known: dict[int, np.ndarray]) -> np.ndarray:
    """Displacements [68, 3] that bring found landmarks to the known ones and move the others with them."""
    indices = list(known)
    off = np.stack([known[index] for index in indices]) - found[indices]
    return RBFInterpolator(found[indices], off, kernel="linear")(found)


def nearest_on_mesh(mesh: trimesh.Trimesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points [N, 3] of a mesh nearest to `points` [N, 3], and their faces [N]."""
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
