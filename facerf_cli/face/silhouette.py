"""The face's outline along the jaw, on which contour landmarks slide (paper, 'Landmark loss')."""

from functools import cache

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.topology import CONTOUR, GRID, LANDMARK_UV, LANDMARKS_M

_NOSE = (28, 33)  # the rays to the jaw begin midway between these landmarks
_RAYS_PER_LANDMARK, _POINTS_PER_RAY = 8, 10
_BAND = (0.6, 1.0)  # from the nose (0) to the jaw line (1): where the outline may wander as the head turns


@cache
def contour_rays() -> Tensor:
    """Vertices of the grid [R, P] along rays across the jaw's band, outermost last, right ear to left ear."""
    ends = _between_landmarks(LANDMARK_UV)
    centre = np.array([0.5, LANDMARK_UV[list(_NOSE), 1].mean()])
    share = np.linspace(*_BAND, _POINTS_PER_RAY)[:, None]
    column_row = np.round((centre + share * (ends - centre)[:, None]) * (GRID - 1)).astype(np.int64)
    column_row = column_row.clip(0, GRID - 1)
    return torch.from_numpy(column_row[..., 1] * GRID + column_row[..., 0])


@cache
def _outward() -> Tensor:
    """Unit directions [R, 3] in the head frame in which each ray leaves the face seen from before it."""
    away = (_between_landmarks(LANDMARKS_M) - LANDMARKS_M[list(_NOSE)].mean(0)) * [1, 1, 0]
    return torch.from_numpy(away / np.linalg.norm(away, axis=-1, keepdims=True)).float()


def _between_landmarks(values: np.ndarray) -> np.ndarray:
    """Contour landmarks' values [68, C] at the rays' outer ends [R, C], linear between landmarks."""
    along = np.arange((len(CONTOUR) - 1) * _RAYS_PER_LANDMARK + 1) / _RAYS_PER_LANDMARK
    contour = values[list(CONTOUR)]
    return np.stack([np.interp(along, CONTOUR, column) for column in contour.T], -1)


@torch.no_grad()
def silhouette_ids(vertices_px: Tensor, head_to_camera: Tensor) -> Tensor:
    """The vertices [B, R] of the outline: of each ray the one that reaches furthest out in the picture.

    vertices_px [B, V, 2] are the mesh's pixels, head_to_camera [B, 3, 3] the poses. A constant: no gradient.
    """
    rays = contour_rays().to(vertices_px.device)
    outward = _outward().to(head_to_camera) @ head_to_camera.mT  # [B, R, 3]
    px = vertices_px[:, rays]  # [B, R, P, 2]
    reach = px[..., 0] * outward[..., None, 0] - px[..., 1] * outward[..., None, 1]
    furthest = reach.argmax(-1, keepdim=True)
    return rays.expand(len(px), -1, -1).gather(2, furthest)[..., 0]
