#!/usr/bin/env python
"""Pack the upper body, garments, hat and hand of MakeHuman that synthetic people wear.

    python tools/pack_makehuman.py makehuman_hair_clothes.tar.xz facerf_cli/assets/makehuman.safetensors

The shapes are CC0 (github makehumancommunity/makehuman-assets and makehuman). MakeHuman's unit is the
decimetre. The packed meshes are in metres with the middle of the neck at the origin, x to the image's right,
y up, z forward, arms lowered, cut below the chest, and stored as whole numbers of `STEP_M`. Those whose
names begin with `WHOLE` reach to the hips and have whole arms, as MakeHuman holds them:
`synth/head/arms.py` bends them.
"""

import sys
import tarfile
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

from facerf_cli.synth.head.arms import NECK_DM
from facerf_cli.synth.head.mesh import STEP_M, WHOLE, WHOLE_GARMENTS

MESHES = {
    "body": "base/3dobjs/base.obj",
    "hand": "base/3dobjs/base.obj",
    "fedora": "base/clothes/fedora01/fedora.obj",
    "tee": "base/clothes/male_casualsuit04/male_casualsuit04.obj",
    "loose tee": "base/clothes/male_casualsuit06/male_casualsuit06.obj",
    "v-neck": "base/clothes/female_sportsuit01/female_sportsuit01.obj",
    "round neck": "base/clothes/female_casualsuit02/female_casualsuit02.obj",
    "blouse": "base/clothes/female_elegantsuit01/female_elegantsuit01.obj",
    "sweater": "base/clothes/male_casualsuit02/male_casualsuit02.obj",
    "polo": "base/clothes/male_casualsuit03/male_casualsuit03.obj",
    "shirt": "base/clothes/male_casualsuit01/male_casualsuit01.obj",
    "jacket": "base/clothes/male_casualsuit05/male_casualsuit05.obj",
    "suit": "base/clothes/male_elegantsuit01/male_elegantsuit01.obj",
}
LOWEST_DM, WIDEST_DM = 1.9, 3.4  # of what is kept of body and garments
LOWEST_WHOLE_DM = -0.5  # of whole ones: the hips
HEAD_DM = 6.0  # height above which the body's own head begins, in front and at the nape
SHOULDER_DM = np.array([1.55, 5.0])  # x and y of the joint of the left shoulder
LOWERED_DEG, BEGIN_DM, END_DM = 32.0, 1.2, 2.6  # the arms turn fully beyond END_DM
SHOULDER_TOP_DM = (1.3, 1.7)  # range of |x| in which the tops of the shoulders are compared
BODY_TOP_DM, CLOTH_DM = 5.74, 0.08  # height of the body's shoulders there, and of cloth over them
CROPPED_DM, STRETCHED = 4.6, 1.8  # the v-neck ends at the waist: it is stretched below this height
HAND_DM = 4.15  # |x| beyond which the left arm is the hand
NOTICE = "MakeHuman base mesh, clothes and hat (CC0 1.0): Data Collection AB, Joel Palmius, Jonas Hauquier"


def read_obj(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and triangles [F, 3] of an OBJ file without MakeHuman's joints and helpers."""
    vertices, triangles, group = [], [], ""
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == ["g"]:
            group = words[1]
        elif words[:1] == ["f"] and not group.startswith(("joint", "helper")):
            ids = [int(word.split("/")[0]) - 1 for word in words[1:]]
            triangles += [(ids[0], ids[k], ids[k + 1]) for k in range(1, len(ids) - 1)]
    return np.array(vertices), np.array(triangles)


def hung(vertices: np.ndarray) -> np.ndarray:
    """Shift a garment, which may be cut for another body, up or down until it lies on the shoulders."""
    x = np.abs(vertices[:, 0])
    top = vertices[(x > SHOULDER_TOP_DM[0]) & (x < SHOULDER_TOP_DM[1]), 1].max()
    return vertices + np.array([0, BODY_TOP_DM + CLOTH_DM - top, 0])


def lowered(vertices: np.ndarray) -> np.ndarray:
    """Turn the arms down about the shoulders, from nothing at BEGIN_DM to LOWERED_DEG at END_DM."""
    side = np.sign(vertices[:, 0])
    share = np.clip((np.abs(vertices[:, 0]) - BEGIN_DM) / (END_DM - BEGIN_DM), 0, 1)
    angle = np.radians(LOWERED_DEG) * share * share * (3 - 2 * share) * (vertices[:, 1] < 6.2)
    x, y = np.abs(vertices[:, 0]) - SHOULDER_DM[0], vertices[:, 1] - SHOULDER_DM[1]
    turned_x = x * np.cos(angle) + y * np.sin(angle) + SHOULDER_DM[0]
    turned_y = y * np.cos(angle) - x * np.sin(angle) + SHOULDER_DM[1]
    return np.stack([side * turned_x, turned_y, vertices[:, 2]], -1)


def chosen(name: str, vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What of a mesh is kept, in decimetres about the mesh's own origin."""
    centre = vertices[triangles].mean(1)
    if name == "hand":
        kept = centre[:, 0] > HAND_DM
        origin = vertices[np.unique(triangles[kept])].mean(0)
        return vertices - origin, triangles[kept]
    if name == "fedora":
        return vertices - NECK_DM, triangles
    whole, kind = name.startswith(WHOLE), name.removeprefix(WHOLE)
    bent = vertices if kind == "body" else hung(vertices)
    bent = bent if whole else lowered(bent)
    if kind == "v-neck":
        bent[:, 1] -= (STRETCHED - 1) * np.maximum(CROPPED_DM - bent[:, 1], 0)
    centre = bent[triangles].mean(1)
    if whole:
        kept = bent[triangles, 1].min(1) > LOWEST_WHOLE_DM
    else:
        kept = (centre[:, 1] > LOWEST_DM) & (np.abs(centre[:, 0]) < WIDEST_DM)
    if kind == "body":
        nape = HEAD_DM - 0.25 * (centre[:, 2] - NECK_DM[2])  # the cut rises toward the nape
        kept &= centre[:, 1] < nape
    return bent - NECK_DM, triangles[kept]


def main(archive: Path, out: Path) -> None:
    """Write the packed meshes."""
    tensors = {}
    names = [*MESHES, *(WHOLE + name for name in ("body", *WHOLE_GARMENTS))]
    with tarfile.open(archive) as files:
        for name in names:
            stream = files.extractfile(MESHES[name.removeprefix(WHOLE)])
            assert stream is not None
            vertices, triangles = chosen(name, *read_obj(stream.read().decode("utf-8", "replace")))
            used, corners = np.unique(triangles, return_inverse=True)
            steps = np.round(vertices[used] / 10 / STEP_M)
            assert np.abs(steps).max() < 2**15, name
            tensors[f"{name}.vertices"] = steps.astype(np.int16)
            tensors[f"{name}.triangles"] = corners.reshape(-1, 3).astype(np.uint16)
            print(f"{name}: {len(used)} vertices, {len(triangles)} triangles")
    save_file(tensors, out, metadata={"credit": NOTICE})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
