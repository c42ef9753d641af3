"""Normals of a mean face laid onto a camera's frames: what photometric stereo should find there."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.errors import InputError
from facerf_cli.face.joint_fit import PosedCamera, fit_views
from facerf_cli.face.landmarks import choose_face, detect_landmarks, to_display
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import grid_triangles
from facerf_cli.stage.checks.frames import CameraFrames

_FACING = 0.3  # cosine: vertices seen more obliquely are hidden behind the nose or are not skin


@dataclass(frozen=True, eq=False)
class FaceNormals:
    """Pixels [N] of a camera's small frames, laid flat, where a vertex is seen, and its normal [N, 3]."""

    pixels: np.ndarray
    normals: np.ndarray  # unit, camera space


def find_face_normals(frames: CameraFrames, posed: PosedCamera) -> FaceNormals | None:
    """A mean face fitted to the landmarks found on the mean of all frames; None where there is no face."""
    rgb = np.repeat(frames.lit[..., None], 3, -1).clip(0)
    faces = detect_landmarks(to_display(rgb)) if rgb.max() > 0 else []
    if not faces:
        return None
    landmarks_px = choose_face(faces, "largest", frames.camera)[0].landmarks_px * frames.lit_scale
    try:
        joint = fit_views(_mean_face(), [posed], [landmarks_px])
    except InputError:
        return None
    return _on_pixels(frames, posed, joint.vertices_world(_mean_face()))


@cache
def _mean_face() -> MorphableModel:
    return load_face_model()


def _on_pixels(frames: CameraFrames, posed: PosedCamera, vertices: torch.Tensor) -> FaceNormals:
    """Vertices [V, 3] of the world, and their normals, where the camera sees them."""
    corners = vertices[grid_triangles().long()]  # [F, 3, 3]
    flat = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = torch.zeros_like(vertices).index_add(
        0, grid_triangles().long().flatten(), flat.repeat_interleave(3, 0)
    )
    normals = (F.normalize(summed, dim=-1) @ posed.rotation.double().mT).numpy()
    px = np.floor(posed.project(vertices).numpy() / frames.scale).astype(int)
    height, width = frames.grey.shape[1:]
    seen = ((px >= 0) & (px < [width, height])).all(1) & (normals[:, 2] > _FACING)
    return FaceNormals(px[seen, 1] * width + px[seen, 0], normals[seen])
