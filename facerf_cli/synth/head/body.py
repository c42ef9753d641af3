"""Upper body below a synthetic head, and a garment on it: MakeHuman's shapes, fitted to the head's neck.

The body hangs below the head by the middle of its neck. Where it lies near the skin of the head it is drawn
to it, so that neck and shoulders are one surface; garments follow the same shift. Cloth is pushed out of the
skin, and skin under cloth is left out.
"""

import numpy as np
from scipy.spatial import cKDTree

from facerf_cli.face.topology import LANDMARK_UV, cylinder_uv
from facerf_cli.light.transport import build_scene, hits_within
from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.head.arms import bend_arms
from facerf_cli.synth.head.mesh import (
    GARMENTS,
    WHOLE,
    WHOLE_GARMENTS,
    HeadMesh,
    cloth_like,
    joined,
    kept_triangles,
    loop_step,
    packed_mesh,
    smooth_normals,
    smoothstep,
    strandless,
)
from facerf_cli.synth.head.worn import draw_neckwear
from facerf_cli.synth.random_fields import Random

_CHIN = 8  # landmark
_LOWEST_CHIN_M = -0.085  # limit of the chin's height, so that an open mouth does not move the body
_NECK_M = 0.025  # height of the chin above the middle of the neck
_LOW_M = 0.012  # skin of the head this far below the chin is neck
_DRAWN_M = 0.02  # standard deviation of the distance to the head's skin up to which the body is drawn to it
_NEAR = 4  # vertices of the body that carry a vertex of a garment
_OVERLAP_M = 0.0025  # larger than the gap between the skins of neck and body
_OFF_SKIN_M = 0.004  # distance of cloth from skin
_LIFTED_M = (0.15, 0.08)  # below the chin; lower down, cloth may lie in the skin, which is left out there
_UNDER_M = (0.08, 0.05)  # cloth outside of skin, and inside of it, within these distances hides it
_TOUCH_M = 0.003  # cloth this near to skin also hides it if it lies inside
_STRIP_M, _KEPT_M = 0.006, 0.016  # skin shows in places wider than a strip; this far around them it is kept
_STRAPLESS_SHARE, _STRAPLESS_M = 0.05, 0.13  # of people; upper edge of their top below the neck
_NECKWEAR_SHARE = 0.15  # of people
_SKIN_V = (1.02, 1.45)  # rows of the skin's texture, from the neck, that the body repeats


def draw_body(
    head: HeadMesh, random: Random, edge_m: float = 0.008, arms: bool = False
) -> tuple[HeadMesh, str]:
    """Draw the upper body and a garment for a bare head; return all as one mesh, and the garment's name.

    The meshes are subdivided until their edges are shorter than `edge_m` on average. They reach to the chest,
    or with whole `arms` to the hips.
    """
    packed = WHOLE if arms else ""
    chin = chin_height_m(head)
    grown = random.uniform(0.93, 1.06) * random.uniform([0.96, 1.0, 0.96], [1.08, 1.0, 1.06])
    at_neck = head.is_part("skin") & (np.abs(head.vertices[:, 1] - (chin - _NECK_M)) < 0.006)
    ring = head.vertices[at_neck, 2]
    origin = np.array([0, chin - _NECK_M, float(ring.min() + ring.max()) / 2])
    skin, faces = packed_mesh(packed + "body")
    skin = skin * grown + origin
    low = (head.is_part("skin")) & (head.vertices[:, 1] < chin - _LOW_M)
    distance, nearest = cKDTree(head.vertices[low].astype(float)).query(skin)
    near = np.exp(-((distance / _DRAWN_M) ** 2))[:, None]
    drawn = near * (head.vertices[low][nearest] - skin)  # to the head's skin
    body = _body_skin(*_refined(skin + drawn, faces, edge_m), head, low)
    strapless = random.random() < _STRAPLESS_SHARE
    name = "tee" if strapless else str(random.choice(WHOLE_GARMENTS if arms else GARMENTS))
    cloth, cloth_faces = packed_mesh(packed + name)
    if strapless:
        cloth_faces = cloth_faces[(cloth[cloth_faces, 1] < -_STRAPLESS_M).all(-1)]
    cloth = cloth * grown + origin
    cloth = cloth + _carried(cloth, skin, drawn)
    garment = _garment(*_refined(cloth, cloth_faces, edge_m), body, head, low, chin)
    dressed = joined(_without_hidden(joined(head, body), garment, chin), garment)
    dressed = bend_arms(dressed, origin, grown, random) if arms else dressed
    if random.random() < _NECKWEAR_SHARE and not strapless:
        dressed = joined(dressed, draw_neckwear(head, chin, random))
    return dressed, "strapless" if strapless else name


def chin_height_m(head: HeadMesh) -> float:
    """Return the height of the underside of the chin, not below `_LOWEST_CHIN_M`."""
    skin = head.is_part("skin")
    nearest = np.linalg.norm(head.uv[skin] - LANDMARK_UV[_CHIN], axis=-1).argmin()
    return max(float(head.vertices[skin][nearest, 1]) - 0.003, _LOWEST_CHIN_M)


def clearance_m(person: HeadMesh) -> np.ndarray:
    """Return how far [V] off the surface rays must start, since neck and body lie closely over each other."""
    return _OVERLAP_M * (person.label == class_index("neck"))


def _carried(points: np.ndarray, body: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Return shifts [N, 3] of points near a body [V, 3] whose vertices are shifted by [V, 3]."""
    distance, near = cKDTree(body).query(points, _NEAR)
    weights = 1 / (distance + 1e-4)
    return ((weights / weights.sum(1, keepdims=True))[..., None] * shifts[near]).sum(1)


def _refined(vertices: np.ndarray, faces: np.ndarray, edge_m: float) -> tuple[np.ndarray, np.ndarray]:
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    while np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=-1).mean() > edge_m:
        step, faces = loop_step(faces, len(vertices))
        vertices = step @ vertices
    return vertices, faces


def _body_skin(vertices: np.ndarray, faces: np.ndarray, head: HeadMesh, low: np.ndarray) -> HeadMesh:
    """Build the body's skin, which takes the head's normals and lies just under it near `low` [V]."""
    tree = cKDTree(head.vertices[low].astype(float))
    distance, nearest = tree.query(vertices)
    share = np.exp(-((distance / 0.006) ** 2))[:, None]
    outward = head.normals[low][nearest]
    normals = smooth_normals(vertices, faces) * (1 - share) + outward * share
    uv = cylinder_uv(vertices)
    period = 2 * (_SKIN_V[1] - _SKIN_V[0])
    folded = np.abs((uv[:, 1] - _SKIN_V[0] + period / 2) % period - period / 2)
    uv[:, 1] = np.where(uv[:, 1] < _SKIN_V[0], uv[:, 1], _SKIN_V[0] + folded)
    mesh = strandless("skin", vertices - 0.0012 * share * outward, normals, faces, uv)
    mesh.label[:] = class_index("neck")
    return mesh


def _garment(
    vertices: np.ndarray, faces: np.ndarray, body: HeadMesh, head: HeadMesh, low: np.ndarray, chin_m: float
) -> HeadMesh:
    """Lift cloth off the skin where it may show."""
    points = np.concatenate([body.vertices, head.vertices[low]]).astype(float)
    outward = np.concatenate([body.normals, head.normals[low]]).astype(float)
    tree = cKDTree(points)
    for _ in range(3):
        normals = smooth_normals(vertices, faces)
        distance, near = tree.query(vertices)
        off = ((vertices - points[near]) * outward[near]).sum(-1)
        aside = np.sqrt(np.maximum(distance**2 - off**2, 0))
        facing = (normals * outward[near]).sum(-1) > 0
        lift = smoothstep(vertices[:, 1] - chin_m, *(-level for level in _LIFTED_M))
        short = lift * np.where(facing & (aside < 0.012), np.maximum(_OFF_SKIN_M - off, 0), 0)
        vertices = vertices + short[:, None] * outward[near]
    return cloth_like("cloth", vertices, faces)


def _without_hidden(skin: HeadMesh, garment: HeadMesh, chin: float) -> HeadMesh:
    """Return the person without the triangles of low skin that the garment hides."""
    scene = build_scene(garment.vertices, garment.triangles)
    low = np.flatnonzero((skin.is_part("skin")) & (skin.vertices[:, 1] < chin - _LOW_M))
    points, normals = skin.vertices[low], skin.normals[low]
    hidden = np.zeros(len(skin.vertices), bool)
    over, under = (
        hits_within(scene, points - side * _TOUCH_M * normals, side * normals, reach_m)
        for side, reach_m in zip((1, -1), _UNDER_M, strict=True)
    )
    covered = over | under
    if covered.any() and not covered.all():
        shows = cKDTree(points[covered]).query(points)[0] > _STRIP_M
        if shows.any():
            hidden[low] = cKDTree(points[shows]).query(points)[0] > _STRIP_M + _KEPT_M
    return kept_triangles(skin, ~hidden[skin.triangles].all(-1))
