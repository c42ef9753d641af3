"""A head around the built-in face, sampled with as many vertices as another model has."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from facerf_cli.face.importers.resample import nearest_on_mesh, rigid_alignment
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import LANDMARK_UV, grid_triangles, locate

MARGIN = 0.06  # of UV space, by which the mesh extends beyond it


@dataclass(frozen=True, eq=False)
class Head:
    """mean [N, 3] in metres, triangles [F, 3], shapes [K, N, 3] in metres a deviation, landmarks [68, 3]."""

    mean: np.ndarray
    triangles: np.ndarray
    shapes: np.ndarray
    landmarks: np.ndarray
    face: np.ndarray  # [V, 3] the canonical vertices that all of it was sampled from


@cache
def head(rows: int, columns: int, loose: int = 0, shapes: int = 4, turn_deg: float = 0) -> Head:
    """The built-in mean as a grid of rows x columns, `loose` vertices without triangles, turned and moved."""
    model = load_face_model()
    # A person of its own, so that what is found is not simply what was built in.
    own = model.mean + torch.einsum("k,kvc->vc", torch.tensor([0.8, -0.6, 0.7, -0.5]), model.identity[4:8])
    v, u = np.meshgrid(np.linspace(-MARGIN, 1 + MARGIN, rows), np.linspace(-MARGIN, 1 + MARGIN, columns))
    uv = np.stack([u.T, v.T], -1).reshape(-1, 2)
    fields = [_sampled(field.double().numpy(), uv) for field in (own, *model.identity[:shapes])]
    fields = [np.concatenate([field, np.zeros((loose, 3))]) for field in fields]
    fields[0][len(uv) :] = fields[0][: len(uv)].mean(0)
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    turn = Rotation.from_euler("xyz", [turn_deg, -turn_deg / 2, turn_deg / 3], degrees=True).as_matrix()
    landmarks = _sampled(own.double().numpy(), LANDMARK_UV)
    mean, landmarks, face = (field @ turn.T + 0.02 for field in (fields[0], landmarks, own.double().numpy()))
    return Head(mean, triangles, np.stack(fields[1:]) @ turn.T, landmarks, face)


def _sampled(field: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """A field [V, 3] of the canonical vertices at (u, v) [N, 2]; extrapolated beyond the grid."""
    inside = uv.clip(0, 1)
    values = _at(field, inside)
    beyond = np.linalg.norm(uv - inside, axis=-1) > 0
    deeper = inside + (inside - uv)  # mirrored inward: the slope at the border is kept
    values[beyond] = 2 * values[beyond] - _at(field, deeper[beyond].clip(0, 1))
    return values


def _at(field: np.ndarray, uv: np.ndarray) -> np.ndarray:
    corners, weights = locate(uv)
    return (field[corners.numpy()] * weights.numpy()[..., None]).sum(1)


def off_mm(model: MorphableModel, head: Head) -> np.ndarray:
    """How far the head's own canonical vertices [V, 3] lie from an imported model's surface."""
    rotation, translation = rigid_alignment(head.face, model.mean.double().numpy())
    points = head.face @ rotation.T + translation
    mesh = trimesh.Trimesh(model.mean.double().numpy(), grid_triangles().numpy(), process=False)
    nearest, _ = nearest_on_mesh(mesh, points)
    return 1000 * np.linalg.norm(nearest - points, axis=-1)


def arrays_here(reader: Callable[[Path], dict[str, np.ndarray]], path: Path) -> dict[str, np.ndarray]:
    """`read_in_subprocess` without its process."""
    try:
        return reader(path)
    except Exception as error:
        raise ValueError(str(error)) from None
