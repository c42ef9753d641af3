"""The mesh of a head that the synthetic stage photographs, in named parts."""

from dataclasses import dataclass

import numpy as np

from facerf_cli.stage.head.vectors import unit

PARTS = ("skin", "eye", "mouth", "teeth", "cloth", "hair", "frame")  # of HeadMesh.part, by index


@dataclass(frozen=True, eq=False)
class HeadMesh:
    """A head with all that it wears; head frame (DESIGN), metres, float32.

    vertices, normals (unit) [V, 3]; triangles [F, 3] int64, counter-clockwise seen from outside, each within
    one part; part [V] uint8, an index into `PARTS`; uv [V, 2] in the part's own texture (skin: the chart of
    `face.topology`, which may be left on all sides; row v = 0 at the top); tangents [V, 3] unit along a
    strand of hair, zero elsewhere.
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    part: np.ndarray
    uv: np.ndarray
    tangents: np.ndarray


def joined(*meshes: HeadMesh) -> HeadMesh:
    """One mesh of several."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return HeadMesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        triangles=np.concatenate([m.triangles + offset for m, offset in zip(meshes, offsets, strict=True)]),
        part=np.concatenate([mesh.part for mesh in meshes]),
        uv=np.concatenate([mesh.uv for mesh in meshes]),
        tangents=np.concatenate([mesh.tangents for mesh in meshes]),
    )


def strandless(
    part: str, vertices: np.ndarray, normals: np.ndarray, triangles: np.ndarray, uv: np.ndarray
) -> HeadMesh:
    """One part without strands: vertices and normals [N, 3], of any length, triangles [F, 3], uv [N, 2]."""
    normals = unit(normals)
    return HeadMesh(
        vertices=vertices.astype(np.float32),
        normals=normals.astype(np.float32),
        triangles=triangles.astype(np.int64),
        part=np.full(len(vertices), PARTS.index(part), np.uint8),
        uv=uv.astype(np.float32),
        tangents=np.zeros((len(vertices), 3), np.float32),
    )
