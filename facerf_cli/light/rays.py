"""Rays for baking light: an embree scene, and directions over a lamp's disc or a hemisphere."""

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh


def build_scene(vertices: np.ndarray, triangles: np.ndarray) -> rtcore_scene.EmbreeScene:
    """An embree scene of one triangle mesh."""
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices[triangles].astype(np.float32))
    return scene


def occluded(scene: rtcore_scene.EmbreeScene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Whether anything lies along each ray [N, 3]; bool [N]."""
    hits = scene.run(np.ascontiguousarray(origins), np.ascontiguousarray(directions), query="OCCLUDED")
    return np.asarray(hits) != -1


def on_disc(axis: np.ndarray, radius_deg: float, share: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Unit directions [N, 3] to points on a lamp's disc, by two numbers [N, 1] in 0..1."""
    axis = axis.astype(np.float32)
    tangent, bitangent = (side.astype(np.float32) for side in _tangents(axis[None]))
    radius = np.float32(np.tan(np.radians(radius_deg))) * np.sqrt(share)
    turn = 2 * np.pi * around
    rays = axis + radius * (np.cos(turn) * tangent + np.sin(turn) * bitangent)
    return (rays / np.sqrt((rays * rays).sum(-1, keepdims=True))).astype(np.float32)


def over_hemisphere(normals: np.ndarray, share: np.ndarray, around: np.ndarray) -> np.ndarray:
    """A direction [N, 3] about each normal by two numbers [N, 1] in 0..1; even ones give a cosine lobe."""
    tangent, bitangent = _tangents(normals)
    radius = np.sqrt(share)
    turn = 2 * np.pi * around
    rays = np.sqrt(1 - radius**2) * normals + radius * (np.cos(turn) * tangent + np.sin(turn) * bitangent)
    return rays.astype(np.float32)


def _tangents(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors [N, 3] each, orthogonal to unit normals [N, 3]."""
    helper = np.where(np.abs(normals[:, :1]) < 0.9, np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]]))
    tangent = np.cross(helper, normals)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    return tangent, np.cross(normals, tangent)
