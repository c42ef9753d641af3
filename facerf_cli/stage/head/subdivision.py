"""Loop's subdivision of a triangle mesh (*Smooth Subdivision Surfaces Based on Triangles*, 1987)."""

import math

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix


def loop_step(triangles: np.ndarray, count: int) -> tuple[csr_matrix, np.ndarray]:
    """One step of Loop's subdivision [count + E, count], and its triangles [4 F, 3].

    Vertices of no triangle stay; a border is smoothed as a curve of its own.
    """
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    opposite = triangles[:, [2, 0, 1]].reshape(-1)
    edges, edge = np.unique(np.sort(sides, -1), axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    inner = np.bincount(edge, minlength=len(edges)) == 2
    rows, columns, weights = [], [], []

    def add(row: np.ndarray, column: np.ndarray, weight: np.ndarray | float) -> None:
        rows.append(row)
        columns.append(column)
        weights.append(np.broadcast_to(weight, row.shape))

    new = count + np.arange(len(edges))
    for end in (0, 1):
        add(new, edges[:, end], np.where(inner, 3 / 8, 1 / 2))
    add(new[edge[inner[edge]]], opposite[inner[edge]], 1 / 8)

    border = np.zeros(count, bool)
    border[edges[~inner]] = True
    both = np.concatenate([edges, edges[:, ::-1]])
    both_inner = np.concatenate([inner, inner])
    valence = np.bincount(both[:, 0], minlength=count)
    share = np.zeros(count)
    regular = valence > 0
    share[regular] = _loop_share(valence[regular])
    smooth = both[~border[both[:, 0]]]
    add(smooth[:, 0], smooth[:, 1], share[smooth[:, 0]])
    rim = both[~both_inner]
    rim_valence = np.bincount(rim[:, 0], minlength=count)
    add(rim[:, 0], rim[:, 1], np.where(rim_valence[rim[:, 0]] == 2, 1 / 8, 0.0))
    everyone = np.arange(count)
    own = np.where(border, np.where(rim_valence == 2, 3 / 4, 1.0), 1 - valence * share)
    add(everyone, everyone, own)
    step = coo_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))),
        shape=(count + len(edges), count),
    ).tocsr()
    ab, bc, ca = (count + edge.reshape(-1, 3)).T
    a, b, c = triangles.T
    divided = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
    return step, divided


def _loop_share(valence: np.ndarray) -> np.ndarray:
    """The weight of each neighbour of a vertex that stays."""
    return (5 / 8 - (3 / 8 + np.cos(2 * math.pi / valence) / 4) ** 2) / valence


def quartered(uv: np.ndarray) -> np.ndarray:
    """Corners [4 F, 3, 2] of the triangles that `loop_step` makes of each, in its order."""
    a, b, c = uv[:, 0], uv[:, 1], uv[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    corners = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1)
    return corners.reshape(-1, 3, 2)
