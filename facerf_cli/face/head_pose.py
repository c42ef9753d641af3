"""The pose of heads of known shape from their landmarks in a picture, without derivatives."""

import torch
from torch import Tensor

from facerf_cli.raster.camera import Camera, pixel_rays

_ROUNDS = 6


def pose_from_landmarks(
    points: Tensor, px: Tensor, camera: Camera, rotation: Tensor, translation_m: Tensor
) -> tuple[Tensor, Tensor]:
    """Rotations [B, 3, 3] and translations [B, 3] that lay points [B, N, 3] (head frame) on pixels [B, N, 2].

    One scaled orthographic fit at the depths of the pose that is given (DeMenthon and Davis, *Model-based
    object pose in 25 lines of code*, 1995), then a few rounds of orthogonal iteration (Lu, Hager and
    Mjolsness, *Fast and globally convergent pose estimation from video images*, 2000). float64.
    """
    depth_m = -(points @ rotation.mT + translation_m[:, None])[..., 2:]
    rays = pixel_rays(px, camera)
    rotation = _orthographic(points, rays[..., :2] * depth_m)
    line = rays[..., :, None] * rays[..., None, :] / (rays * rays).sum(-1)[..., None, None]  # [B, N, 3, 3]
    off_line = line - torch.eye(3, dtype=rays.dtype)
    middle = torch.linalg.inv(-off_line.mean(1))

    def best_translation(rotation: Tensor) -> Tensor:
        turned = (points @ rotation.mT)[..., None]
        return (middle @ (off_line @ turned).mean(1))[..., 0]

    for _ in range(_ROUNDS):
        seen = points @ rotation.mT + best_translation(rotation)[:, None]
        rotation = _closest_rotation((line @ seen[..., None])[..., 0], points)
    return rotation, best_translation(rotation)


def _orthographic(points: Tensor, picture: Tensor) -> Tensor:
    """Rotations [B, 3, 3] of a scaled orthographic fit of points [B, N, 3] to positions [B, N, 2], y up."""
    centred, flat = points - points.mean(1, keepdim=True), picture - picture.mean(1, keepdim=True)
    u, _, vh = torch.linalg.svd(torch.linalg.lstsq(centred, flat).solution.mT, full_matrices=False)
    rows = u @ vh
    return torch.cat([rows, torch.linalg.cross(rows[:, :1], rows[:, 1:])], 1)


def _closest_rotation(wanted: Tensor, points: Tensor) -> Tensor:
    """Rotations [B, 3, 3] from points to others [B, N, 3], both about their middles (Kabsch, 1976)."""
    moment = (wanted - wanted.mean(1, keepdim=True)).mT @ (points - points.mean(1, keepdim=True))
    u, _, vh = torch.linalg.svd(moment)
    signs = torch.ones(len(points), 3, dtype=points.dtype)
    signs[:, 2] = torch.det(u @ vh).sign()
    return u @ (signs[..., None] * vh)
