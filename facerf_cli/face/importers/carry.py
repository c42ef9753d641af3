"""The whole head of a model that has one, in the head frame and painted by the canonical chart.

A model in its own topology becomes one in the canonical (DESIGN, 'One topology inside').
"""

import numpy as np
import torch
import trimesh
from scipy.ndimage import binary_dilation
from scipy.sparse import csr_matrix
from scipy.spatial.distance import cdist

from facerf_cli.errors import InputError
from facerf_cli.face.importers.find_landmarks import (
    find_landmarks,
    nearest_on_mesh,
    register,
    rigid_alignment,
)
from facerf_cli.face.importers.source import SourceHead, SourceModel
from facerf_cli.face.morphable import HEAD_PARTS, HeadModel, MorphableModel, load_face_model
from facerf_cli.face.topology import (
    GRID,
    LANDMARKS_M,
    OUTER_EYE_CORNERS,
    cylinder_uv,
    grid_triangles,
    grid_uv,
)

_LIMBUS_M, _LIMBUS_DEG = 0.006, 29.0  # an iris's radius, and the angle at which eye textures show it


def carried_head(
    source: SourceModel,
    head: SourceHead,
    canonical: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> HeadModel:
    """The source's own head, turned to the head frame; its skin in the chart of the canonical mean [V, 3]."""
    mean = source.mean @ rotation.T + translation
    uv = cylinder_uv(mean)
    skin = np.flatnonzero(head.part == HEAD_PARTS.index("skin"))
    uv[skin] = skin_uv(mean[skin], canonical)
    for eye in head.eyes:
        uv[eye] = _eye_uv(mean[eye])
    used, triangles = np.unique(head.triangles, return_inverse=True)

    def kept(field: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(field[..., used, :].astype(np.float32))

    return HeadModel(
        mean=kept(mean),
        identity=kept(source.identity @ rotation.T),
        expression=kept(source.expression @ rotation.T),
        triangles=torch.from_numpy(triangles.reshape(-1, 3)),
        part=torch.from_numpy(head.part[used]),
        uv=kept(uv),
    )


def skin_uv(points: np.ndarray, canonical: np.ndarray) -> np.ndarray:
    """(u, v) [N, 2] of skin: that of the nearest canonical point, and around the chart its formula.

    What the formula is off by at the chart's border fades into what lies beyond, so that nothing jumps.
    """
    grid = grid_uv().double().numpy()
    mesh = trimesh.Trimesh(canonical, grid_triangles().numpy(), process=False)
    nearest, faces = nearest_on_mesh(mesh, points)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], nearest)
    inner = (weights[..., None] * grid[mesh.faces[faces]]).sum(1)
    formula = cylinder_uv(points)
    inside = ((inner > 1e-3) & (inner < 1 - 1e-3) & (np.abs(formula - 0.5) < 0.7)).all(-1)
    border = ((grid == 0) | (grid == 1)).any(-1)
    at = cylinder_uv(canonical[border])
    pull = 1 / (cdist(formula, at) ** 4 + 1e-12)  # inverse distance: exact at the border, smooth beyond
    beyond = formula + (pull @ (grid[border] - at)) / pull.sum(-1, keepdims=True)
    return np.where(inside[:, None], inner, beyond)


def _eye_uv(points: np.ndarray) -> np.ndarray:
    """(u, v) [N, 2] of an eyeball: direction and angle about the axis through its cornea, as a disc.

    Angles are stretched so that an iris of `_LIMBUS_M` has the same place in every model's eyes, however
    large their balls.
    """
    centre = (points.min(0) + points.max(0)) / 2
    offset = points - centre
    radius = np.linalg.norm(offset, axis=-1)
    axis = offset[radius > np.percentile(radius[offset[:, 2] > 0], 90)]
    axis = axis[axis[:, 2] > 0].mean(0)
    axis /= np.linalg.norm(axis)
    along = offset @ axis
    side = np.cross([0.0, 1, 0], axis)
    side /= np.linalg.norm(side)
    across = np.stack([offset @ side, -(offset @ np.cross(axis, side))], -1)
    lateral = np.linalg.norm(across, axis=-1)
    angle_deg = np.degrees(np.arctan2(lateral, along))
    front = np.argsort(angle_deg)[: len(points) // 2]
    limbus_deg = np.interp(_LIMBUS_M, lateral[front], angle_deg[front])
    stretched = np.minimum(angle_deg * _LIMBUS_DEG / limbus_deg, 90)
    return 0.5 + 0.5 * across / np.maximum(lateral, 1e-9)[:, None] * (stretched / 90)[:, None]


_HEAD_M, _EYES_M = (0.12, 1.0), (0.06, 0.13)  # beyond these, a length is in another unit


def carry_over(source: SourceModel) -> MorphableModel:
    """Carry a model to the canonical topology: its landmarks warp the chart, rays find its surface.

    A model without expressions is given the built-in model's, whose vertices are the same; one whose surface
    ends inside the chart, as Basel's face12 does, goes on as the built-in face, and moves as its own border.
    """
    side_m = float(np.ptp(source.mean[np.unique(source.triangles)], 0).max())
    _require_size("its mean's largest side is", side_m, _HEAD_M)
    landmarks = landmarks_of(source)
    eyes_m = float(np.linalg.norm(landmarks[OUTER_EYE_CORNERS[0]] - landmarks[OUTER_EYE_CORNERS[1]]))
    _require_size("its eyes' outer corners lie apart", eyes_m, _EYES_M)
    rotation, translation = rigid_alignment(landmarks, LANDMARKS_M)
    mean = source.mean @ rotation.T + translation
    corners, weights, covered = register(mean, source.triangles, landmarks @ rotation.T + translation)
    rows = np.arange(0, corners.size + 1, 3)
    onto_grid = csr_matrix((weights.ravel(), corners.ravel(), rows), (len(corners), len(mean)))
    builtin, (border, weights_beyond) = load_face_model(), _beyond(covered)

    def carried(field: np.ndarray, otherwise: np.ndarray | float = 0.0) -> torch.Tensor:
        off = onto_grid @ field - otherwise
        off[~covered] = weights_beyond @ off[border]
        return torch.from_numpy((off + otherwise).astype(np.float32))

    def carried_basis(basis: np.ndarray) -> torch.Tensor:
        return torch.stack([carried(shape @ rotation.T) for shape in basis])

    has_expressions = len(source.expression) > 0
    on_grid = carried(mean, builtin.mean.double().numpy())
    return MorphableModel(
        name=source.name,
        licence=source.licence + ("" if has_expressions else f"; expressions: {builtin.licence}"),
        mean=on_grid,
        identity=carried_basis(source.identity),
        expression=carried_basis(source.expression) if has_expressions else builtin.expression,
        expression_names=source.expression_names if has_expressions else builtin.expression_names,
        head=None
        if source.head is None
        else carried_head(source, source.head, on_grid.numpy(), rotation, translation),
    )


def landmarks_of(source: SourceModel) -> np.ndarray:
    """The 68 points [68, 3] on the source's mean: those that are known, the rest by the shape of the face."""
    if len(source.known) == 68:
        return np.stack([source.known[number] for number in range(68)])
    return find_landmarks(source.mean, source.triangles, source.known)


def _beyond(covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of the covered vertices [V] are the border [V], and the weights [M, B] of those for the others.

    Inverse distance, as in `carried_head.skin_uv`: what leaves the border is exact there, and smooth beyond.
    """
    border = covered & binary_dilation(~covered.reshape(GRID, GRID)).ravel()
    grid = grid_uv().double().numpy()
    pull = 1 / (cdist(grid[~covered], grid[border]) ** 4 + 1e-12)
    return border, pull / pull.sum(-1, keepdims=True)


def _require_size(what: str, length_m: float, between_m: tuple[float, float]) -> None:
    if not between_m[0] < length_m < between_m[1]:
        raise InputError(f"{what} {1000 * length_m:.4g} mm; is it in the unit of its publication?")
