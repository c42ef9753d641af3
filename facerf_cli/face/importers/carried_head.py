"""The whole head of a model that has one, in the head frame and painted by the canonical chart."""

import numpy as np
import torch
import trimesh
from scipy.spatial.distance import cdist

from facerf_cli.face.head_model import HEAD_PARTS, HeadModel
from facerf_cli.face.importers.registration import nearest_on_mesh
from facerf_cli.face.importers.source import SourceHead, SourceModel
from facerf_cli.face.topology import chart_uv, grid_triangles, grid_uv

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
    uv = chart_uv(mean)
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
    formula = chart_uv(points)
    inside = ((inner > 1e-3) & (inner < 1 - 1e-3) & (np.abs(formula - 0.5) < 0.7)).all(-1)
    border = ((grid == 0) | (grid == 1)).any(-1)
    at = chart_uv(canonical[border])
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
