"""A person of the stage who talks and turns: the same mesh and materials, moved from frame to frame."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from facerf_cli.face.morphable import MorphableModel
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.raster.texture import vertex_normals
from facerf_cli.synth.stage_cameras import StageCamera
from facerf_cli.synth.subjects import Subject

_NEAR = 4  # vertices of the face that carry a vertex of the mesh
_REACH_M = 0.012  # from the face, at which the mesh follows it by 1 / e


@dataclass(frozen=True, eq=False)
class Actor:
    """A subject and the face model that moves it; expressions are added to the subject's own."""

    subject: Subject
    model: MorphableModel

    def with_expression(self, strengths: dict[str, float]) -> Subject:
        """Move the face by expression shapes, by name, in standard deviations; hair and clothes stay."""
        beta = torch.tensor([strengths.get(name, 0.0) for name in self.model.expression_names])
        moved_m = torch.einsum("k,kvc->vc", beta, self.model.expression)
        near, weights = self._carriers
        offset = (weights[..., None] * moved_m.numpy()[near]).sum(1) @ self.subject.head_to_world.numpy().T
        mesh = self.subject.mesh
        vertices = (mesh.vertices + offset).astype(np.float32)
        before, after = (
            vertex_normals(torch.from_numpy(v), torch.from_numpy(mesh.triangles)).numpy()
            for v in (mesh.vertices, vertices)
        )
        normals = mesh.normals + after - before  # those of the mesh are smooth across its seams
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(min=1e-6)
        moved = replace(mesh, vertices=vertices, normals=normals.astype(np.float32))
        return replace(self.subject, mesh=moved, face_vertices=self.subject.face_vertices + moved_m)

    @cached_property
    def _carriers(self) -> tuple[np.ndarray, np.ndarray]:
        """Ids [N, 4] of vertices of the face, and weights [N, 4] by which the mesh's vertices follow them."""
        head = self.subject.mesh.vertices @ self.subject.head_to_world.numpy()
        distances, near = cKDTree(self.subject.face_vertices.numpy()).query(head, _NEAR)
        weights = 1 / (distances + 1e-4)
        weights /= weights.sum(1, keepdims=True)
        return near, weights * np.exp(-((distances.min(1) / _REACH_M) ** 2))[:, None]


def turned(camera: StageCamera, yaw_deg: float, pitch_deg: float) -> StageCamera:
    """The camera that sees a person turn by so much; its lights turn with it (`seen_from`)."""
    turn = pose_to_rotation(yaw_deg, pitch_deg, 0.0).to(camera.head_to_camera.dtype)
    return replace(camera, head_to_camera=turn @ camera.head_to_camera)


def seen_from(directions_camera: Tensor, camera: StageCamera) -> np.ndarray:
    """World-space directions [L, 3], float64, of lights that are fixed to a camera."""
    return (directions_camera.double() @ camera.head_to_camera.double()).numpy()
