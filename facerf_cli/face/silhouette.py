"""The outline of the face along the jaw, on which the contour landmarks slide (paper, 'Landmark loss').

Rays in UV space run from the nose to the jaw line. On each ray only the outer band can be the silhouette; the
silhouette is the point of the band that lies furthest out in the image.
"""

from functools import cache

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.topology import CONTOUR, GRID, LANDMARK_UV, LANDMARKS_M

RAYS_PER_LANDMARK, POINTS_PER_RAY = 8, 10
CONTOUR_RAYS = (len(CONTOUR) - 1) * RAYS_PER_LANDMARK + 1
NOSE = (28, 33)  # the rays begin midway between these landmarks
_BAND = (0.6, 1.0)  # part of a ray, 0 at the nose and 1 at the jaw line, where the silhouette can lie


@cache
def band_uv() -> np.ndarray:
    """The (u, v) [R, P, 2] of the points of the band, outermost last, right ear to left ear."""
    ends = _between_landmarks(LANDMARK_UV)
    centre = np.array([0.5, LANDMARK_UV[list(NOSE), 1].mean()])
    share = np.linspace(*_BAND, POINTS_PER_RAY)[:, None]
    return centre + share * (ends - centre)[:, None]


@cache
def contour_rays() -> Tensor:
    """The grid's vertices [R, P] closest to the points of the band."""
    column_row = np.round(band_uv() * (GRID - 1)).astype(np.int64)
    column_row = column_row.clip(0, GRID - 1)
    return torch.from_numpy(column_row[..., 1] * GRID + column_row[..., 0])


@torch.no_grad()
def silhouette_ids(vertices_px: Tensor, head_to_camera: Tensor) -> Tensor:
    """The vertices [B, R] of the outline: for each ray the one that lies furthest out in the image.

    vertices_px [B, V, 2] are the mesh's pixels, head_to_camera [B, 3, 3] the poses. Indices have no gradient.
    """
    rays = contour_rays().to(vertices_px.device)
    outward = _outward().to(head_to_camera) @ head_to_camera.mT  # [B, R, 3]
    furthest = outermost(vertices_px[:, rays], outward)
    return rays.expand(len(vertices_px), -1, -1).gather(2, furthest[..., None])[..., 0]


def outermost(px: Tensor, outward: Tensor) -> Tensor:
    """The index [B, R] of each ray's outermost point among P pixels [B, R, P, 2].

    outward [B, R, 3] are the rays' directions out of the face in camera space.
    """
    reach = px[..., 0] * outward[..., None, 0] - px[..., 1] * outward[..., None, 1]
    return reach.argmax(-1)


@cache
def _outward() -> Tensor:
    """Unit directions [R, 3] in the head frame in which the rays leave a face seen from the front."""
    away = (_between_landmarks(LANDMARKS_M) - LANDMARKS_M[list(NOSE)].mean(0)) * [1, 1, 0]
    return torch.from_numpy(away / np.linalg.norm(away, axis=-1, keepdims=True)).float()


def _between_landmarks(values: np.ndarray) -> np.ndarray:
    """Interpolate landmark values [68, C] linearly to the outer ends of the rays [R, C]."""
    along = np.arange(CONTOUR_RAYS) / RAYS_PER_LANDMARK
    contour = values[list(CONTOUR)]
    return np.stack([np.interp(along, CONTOUR, column) for column in contour.T], -1)
