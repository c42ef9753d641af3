"""A mesh as rays are cast from it and at it."""

from dataclasses import dataclass

import numpy as np
from embreex import rtcore_scene
from scipy.sparse import csr_matrix

from facerf_cli.light.rays import build_scene
from facerf_cli.light.transport import OFFSET_M

_MESH_OFFSET_M = 3e-5  # rays start so far off a vertex, where no facet has to be cleared, and
_RISE_SHARE = 0.5  # this share of its neighbours' rise, up to as much again as from a texel


@dataclass(frozen=True, eq=False)
class MeshSurface:
    """Vertices and unit normals [V, 3], triangles [F, 3]; `all_round` [V] bool are strands of hair."""

    scene: rtcore_scene.EmbreeScene
    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    all_round: np.ndarray
    edges: np.ndarray  # [E, 2], each once, strands' left out,
    beside: csr_matrix  # and as a matrix [V, V] of ones
    offset_m: np.ndarray  # [V, 1] of ray origins off the surface

    @classmethod
    def of(
        cls, vertices: np.ndarray, normals: np.ndarray, triangles: np.ndarray, all_round: np.ndarray
    ) -> "MeshSurface":
        """The surface of a mesh, its edges found and its scene built."""
        vertices, normals = vertices.astype(np.float32), normals.astype(np.float32)
        edges = _edges(triangles, len(vertices))
        offset_m = _mesh_offset_m(vertices, normals, edges)[:, None]
        edges = edges[~all_round[edges[:, 0]]]
        both_ways = np.concatenate([edges, edges[:, ::-1]]).T
        ones = np.ones(2 * len(edges), np.float32)
        return cls(
            build_scene(vertices, triangles),
            vertices,
            normals,
            triangles,
            all_round,
            edges,
            csr_matrix((ones, tuple(both_ways)), shape=(len(vertices), len(vertices))),
            offset_m,
        )


def _edges(triangles: np.ndarray, count: int) -> np.ndarray:
    """The edges [E, 2] of triangles among so many vertices, each once."""
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    keys = np.sort(pairs[:, 0].astype(np.int64) * count + pairs[:, 1])
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return np.stack([keys // count, keys % count], -1)


def _mesh_offset_m(vertices: np.ndarray, normals: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """How far [V] rays start off the surface: beyond what its facets stand out of their smooth surface.

    Where a vertex lies in a hollow, its neighbours rise above its tangent plane, and flat facets between them
    would shadow grazing light that the smooth surface, with these normals, lets through.
    """
    span = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    rise = np.zeros(len(vertices), np.float32)
    np.maximum.at(rise, edges[:, 0], np.einsum("ec,ec->e", span, normals[edges[:, 0]]))
    np.maximum.at(rise, edges[:, 1], -np.einsum("ec,ec->e", span, normals[edges[:, 1]]))
    return _MESH_OFFSET_M + np.minimum(_RISE_SHARE * rise, OFFSET_M)
