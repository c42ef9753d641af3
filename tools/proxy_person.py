"""Make the person whose mesh is fitted to photos as a proxy (`portrait/proxy.py`): head, ears, neck and bust.

`python -m tools.proxy_person FILE` writes the asset: the mean head of the built-in face model on a
body with a shirt, coarse, and for each vertex the vertices of the face that carry it along.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from facerf_cli.face.morphable import BUILTIN, load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION, grid_uv, region_mask
from facerf_cli.network.checkpoint import save_checkpoint
from facerf_cli.portrait.parse import class_index
from facerf_cli.portrait.proxy import ASSET
from facerf_cli.raster.texture import sample_texture
from facerf_cli.synth.head.body import chin_height_m, draw_body
from facerf_cli.synth.head.mesh import HeadMesh, smoothstep
from facerf_cli.synth.head.shell import shell_head

_CELL_M = {"ears": 0.0025, "skin": 0.004, "neck": 0.006}  # of the grid whose vertices are joined; others:
_OTHER_CELL_M = 0.003
_BODY_EDGE_M = 0.02
_CARRIERS = 4  # vertices of the face that carry a vertex
_REACH_M = 0.03  # standard deviation of the distance to the face up to which a vertex follows it
_HAIRLINE_M, _BARE_M = (
    0.045,
    0.02,
)  # distance from the face, and height, over which hair grows to its thickness
_NAPE_M = -0.045  # lowest hair
_TEMPLES_M = 0.05, -0.01  # depths between which hair comes down from above the forehead to the nape
# A head is wider at its ears than where its cheeks end, which would hide them: by so much on each side,
_WIDER_M = 0.008
_WIDENS_M = 0.06, -0.005  # from the first depth to the second,
_JAW_M, _TEMPLE_M = (-0.075, -0.03), (0.03, 0.07)  # and from the jaw up to the temples.


def proxy_tensors() -> dict[str, torch.Tensor]:
    """Build the person: see `portrait.proxy._MeanPerson`."""
    model = load_face_model(BUILTIN)
    face = model.vertices(torch.zeros(1, len(model.identity)), torch.zeros(1, len(model.expression)))[0]
    head = shell_head(face, (0.0, 0.0), 0)
    person, _ = draw_body(head, np.random.default_rng(0), _BODY_EDGE_M)
    vertices, triangles, label = _joined_cells(person)
    vertices[:, 0] += _widened(vertices) * np.isin(label, [class_index("skin"), class_index("ears")])
    distance, near = cKDTree(face.numpy()).query(vertices, _CARRIERS)
    weights = 1 / (distance + 1e-4)
    return {
        "vertices_m": torch.from_numpy(vertices).float(),
        "triangles": torch.from_numpy(triangles).int(),
        "carriers": torch.from_numpy(near).int(),
        "weights": torch.from_numpy(weights / weights.sum(1, keepdims=True)).float(),
        "follows": torch.from_numpy(np.exp(-0.5 * (distance[:, 0] / _REACH_M) ** 2)).float(),
        "hair": torch.from_numpy(_hair(vertices, label, face.numpy(), chin_height_m(head))).float(),
    }


def _joined_cells(person: HeadMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [N, 3], triangles [F, 3] and classes [N] of a mesh whose near vertices are joined."""
    cell = np.full(len(person.vertices), _OTHER_CELL_M)
    for name, size_m in _CELL_M.items():
        cell[person.label == class_index(name)] = size_m
    cell[person.label == class_index("garment")] = 1e-6
    key = np.c_[person.label, np.floor(person.vertices / cell[:, None])].astype(np.int64)
    _, first, owner = np.unique(key, axis=0, return_index=True, return_inverse=True)
    owner = owner.ravel()
    count = np.bincount(owner).astype(float)
    vertices = np.stack([np.bincount(owner, person.vertices[:, k]) / count for k in range(3)], -1)
    triangles = owner[person.triangles]
    a, b, c = triangles.T
    triangles = np.unique(triangles[(a != b) & (b != c) & (c != a)], axis=0)
    return vertices, triangles, person.label[first]


def _widened(vertices: np.ndarray) -> np.ndarray:
    """Moves [N] of a head's vertices to the right, by which it widens toward its ears."""
    x, y, z = vertices.T
    height = smoothstep(y, *_JAW_M) * (1 - smoothstep(y, *_TEMPLE_M))
    return _WIDER_M * np.clip(x / 0.03, -1, 1) * smoothstep(z, *_WIDENS_M) * height


def _hair(vertices: np.ndarray, label: np.ndarray, face: np.ndarray, chin_m: float) -> np.ndarray:
    """Share [N] of the hair's thickness that a vertex is pushed out by: 1 on the scalp, 0 on the face."""
    inside = sample_texture(region_mask("face", 256)[None], grid_uv()[None])[0, :, 0].numpy() > 0.5
    off, _ = cKDTree(face[inside]).query(vertices)
    scalp = (label == class_index("skin")) & (vertices[:, 1] > chin_m + 0.02)
    front, back = (  # before the ears hair grows only above the forehead
        ((vertices[:, 1] - low) / _BARE_M).clip(0, 1) for low in (face[inside][:, 1].max() - 0.01, _NAPE_M)
    )
    above = front + smoothstep(vertices[:, 2], *_TEMPLES_M) * (back - front)
    return scalp * above * smoothstep(off, 0.002, _HAIRLINE_M)


def main(path: Path) -> None:
    """Write the asset to `path`."""
    made = {
        "made_by": "tools.proxy_person",
        "layout_version": LAYOUT_VERSION,
        "licence": "MIT; CC0",
    }
    save_checkpoint(path, proxy_tensors(), made)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ASSET)
