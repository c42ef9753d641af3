"""Loop's subdivision of a triangle mesh (*Smooth Subdivision Surfaces Based on Triangles*, 1987).

As a matrix from old to new vertices, which serves all shapes, colours and labels of a mesh at once; trimesh's
`subdivide_loop` gives the vertices of one shape.
"""

import math

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix


def loop_step(triangles: np.ndarray, count: int) -> tuple[csr_matrix, np.ndarray]:
    """One step of Loop's subdivision for triangles [F, 3] of `count` vertices.

    Returns the matrix [count + E, count] from old to new vertices (the old ones first, then one per edge)
    and the new triangles [4 F, 3]. Vertices of no triangle stay; a border is smoothed as a separate curve.
    """
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    opposite = triangles[:, [2, 0, 1]].reshape(-1)
    edges, edge = np.unique(np.sort(sides, -1), axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    inner = np.bincount(edge, minlength=len(edges)) == 2

    new = count + np.arange(len(edges))
    entries = [(new, edges[:, end], np.where(inner, 3 / 8, 1 / 2)) for end in (0, 1)]
    entries.append((new[edge[inner[edge]]], opposite[inner[edge]], np.array(1 / 8)))
    entries += _old_vertices(edges, inner, count)
    rows, columns, weights = zip(*entries, strict=True)
    weights = [np.broadcast_to(weight, row.shape) for row, weight in zip(rows, weights, strict=True)]
    step = coo_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))),
        shape=(count + len(edges), count),
    ).tocsr()

    ab, bc, ca = (count + edge.reshape(-1, 3)).T
    a, b, c = triangles.T
    divided = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
    return step, divided


def _old_vertices(
    edges: np.ndarray, inner: np.ndarray, count: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Matrix entries (rows, columns, weights) of the old vertices; edges [E, 2], inner [E] bool."""
    border = np.zeros(count, bool)
    border[edges[~inner]] = True
    both = np.concatenate([edges, edges[:, ::-1]])
    both_inner = np.concatenate([inner, inner])
    valence = np.bincount(both[:, 0], minlength=count)
    share = np.zeros(count)
    regular = valence > 0
    share[regular] = _neighbour_weight(valence[regular])
    smooth = both[~border[both[:, 0]]]
    rim = both[~both_inner]
    rim_valence = np.bincount(rim[:, 0], minlength=count)
    every = np.arange(count)
    own = np.where(border, np.where(rim_valence == 2, 3 / 4, 1.0), 1 - valence * share)
    return [
        (smooth[:, 0], smooth[:, 1], share[smooth[:, 0]]),
        (rim[:, 0], rim[:, 1], np.where(rim_valence[rim[:, 0]] == 2, 1 / 8, 0.0)),
        (every, every, own),
    ]


def _neighbour_weight(valence: np.ndarray) -> np.ndarray:
    """Weight of each neighbour of an old vertex inside the surface, by its number of neighbours."""
    return (5 / 8 - (3 / 8 + np.cos(2 * math.pi / valence) / 4) ** 2) / valence


def quartered(uv: np.ndarray) -> np.ndarray:
    """Corners [4 F, 3, 2] of the four triangles that `loop_step` makes of each triangle, in its order."""
    a, b, c = uv[:, 0], uv[:, 1], uv[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    corners = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1)
    return corners.reshape(-1, 3, 2)
