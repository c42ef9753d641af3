"""Loop's subdivision of a triangle mesh (*Smooth Subdivision Surfaces Based on Triangles*, 1987).

The bare head of a person: skin, eyes that look somewhere, mouth and teeth.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from facerf_cli.face.importers.source import EXPRESSION_STD
from facerf_cli.face.morphable import HEAD_PARTS, HeadModel, MorphableModel
from facerf_cli.face.topology import HALF_ANGLE_DEG
from facerf_cli.raster.texture import vertex_normals
from facerf_cli.synth.head.eyes import Slit, eye_slit, lip_slit
from facerf_cli.synth.head.mesh import PARTS, HeadMesh


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


_TURN = 360 / (2 * HALF_ANGLE_DEG)  # of u, once around the head
_LOOK_DEG = 30.0  # the gaze that a full eyeLook shape goes with
_LID_GAP_M = 0.0002  # lids stay this far off the ball;
_LID_REACH_M = 0.0008  # those nearer than this yield
_SLIDE_UV = 0.03  # a vertex's shift in the texture by subdivision; more is a seam
_SKIN, _EYE, _MOUTH = (HEAD_PARTS.index(name) for name in ("skin", "eye", "mouth"))


def build_head(
    model: MorphableModel,
    alpha: Tensor,
    beta: Tensor,
    gaze_deg: tuple[float, float] = (0.0, 0.0),
    subdivisions: int = 1,
) -> HeadMesh:
    """The head of a person alpha [Ki] with the expression beta [Ke], looking along `gaze_deg`.

    The gaze is (azimuth to the picture's right, elevation up) in the head frame, and the lids go with it.
    Skin and eyes are subdivided (Loop, 1987); at one subdivision the face's vertices are about 1 mm apart.
    """
    if model.head is None:
        from facerf_cli.synth.head.shell import shell_head

        return shell_head(model.vertices(alpha[None], beta[None])[0], gaze_deg, subdivisions)
    plan = _plan(model.head, model.expression_names, subdivisions)
    moved = beta + _lids(model.expression_names, beta, gaze_deg)
    coarse = model.head.vertices(alpha, moved).double().numpy()
    coarse[:, 1] += _closings(model.head, plan, alpha, moved, coarse)
    for eye in plan.eyes:
        coarse[eye.coarse] = _looking(coarse[eye.coarse], gaze_deg)
    vertices = plan.refine @ coarse
    for eye in plan.eyes:
        _clear_of_ball(vertices, plan.skin, vertices[eye.fine])
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(plan.triangles)).numpy()
    return HeadMesh(
        vertices=vertices[plan.source].astype(np.float32),
        normals=normals[plan.source].astype(np.float32),
        triangles=plan.split_triangles,
        part=plan.part,
        uv=plan.uv,
        tangents=np.zeros((len(plan.source), 3), np.float32),
    )


def _lids(names: tuple[str, ...], beta: Tensor, gaze_deg: tuple[float, float]) -> Tensor:
    """Coefficients [Ke] of ICT's eyeLook shapes that carry the lids along; zero where a model has none."""
    azimuth, elevation = gaze_deg
    right, up = azimuth / _LOOK_DEG, elevation / _LOOK_DEG
    share = {"Up_L": up, "Up_R": up, "Down_L": -up, "Down_R": -up}
    share |= {"Out_L": right, "In_R": right, "In_L": -right, "Out_R": -right}  # L: the person's, +x
    moved = torch.zeros_like(beta)
    for index, name in enumerate(names):
        if name.startswith("eyeLook"):
            blink = names.index(f"eyeBlink{name[-2:]}") if f"eyeBlink{name[-2:]}" in names else None
            closed = 0.0 if blink is None else float(beta[blink]) * EXPRESSION_STD
            full = max(share.get(name.removeprefix("eyeLook"), 0.0), 0.0) * min(max(1 - closed, 0.0), 1.0)
            moved[index] = full / EXPRESSION_STD
    return moved


def _closings(head: HeadModel, plan: "_Plan", alpha: Tensor, beta: Tensor, shape: np.ndarray) -> np.ndarray:
    """Offsets along y [N]: lips that rest on each other when nothing moves them, lids that a blink shuts."""
    offset = np.zeros(len(shape))
    if plan.lips is not None:
        neutral = head.vertices(alpha, torch.zeros_like(beta)).double().numpy()
        offset += plan.lips.closing(neutral)
    for index, lids in plan.lids.items():
        closed = min(max(float(beta[index]) * EXPRESSION_STD, 0.0), 1.0)
        blink = head.expression[index].double().numpy() / EXPRESSION_STD
        if closed:
            offset += closed * lids.closing(shape + (1 - closed) * blink)
    return offset


def _looking(ball: np.ndarray, gaze_deg: tuple[float, float]) -> np.ndarray:
    """An eyeball [N, 3] turned about its centre."""
    centre = (ball.min(0) + ball.max(0)) / 2
    turn = Rotation.from_euler("YX", [gaze_deg[0], -gaze_deg[1]], degrees=True)
    return centre + turn.apply(ball - centre)


def _clear_of_ball(vertices: np.ndarray, skin: np.ndarray, ball: np.ndarray) -> None:
    """Push skin that an eyeball pokes through out of it, in place; what lies off the ball stays.

    A blendshape moves a lid along a straight line, through the ball that it should slide over.
    """
    centre = (ball.min(0) + ball.max(0)) / 2
    radii = np.linalg.norm(ball - centre, axis=-1)
    near = skin[np.abs(vertices[skin] - centre).max(-1) < radii.max() + _LID_REACH_M]
    offset = vertices[near] - centre
    distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-6)
    direction = offset / distance[:, None]
    apart, nearest = cKDTree((ball - centre) / radii[:, None]).query(direction, 4)
    weights = 1 / (apart + 1e-3)
    surface = (weights * radii[nearest]).sum(-1) / weights.sum(-1)
    gap = distance - surface - _LID_GAP_M
    kept = np.where(gap > _LID_REACH_M, gap, _LID_REACH_M * np.exp(np.minimum(gap / _LID_REACH_M - 1, 0)))
    vertices[near] = centre + direction * (surface + _LID_GAP_M + kept)[:, None]


@dataclass(frozen=True, eq=False)
class _Eye:
    """One ball's vertices, before and after subdivision."""

    coarse: np.ndarray
    fine: np.ndarray


@dataclass(frozen=True, eq=False)
class _Plan:
    """All about a head's mesh that is the same for every person."""

    refine: csr_matrix  # [V, N]: vertices of the model to those of the fine mesh
    triangles: np.ndarray  # [F, 3] of the fine mesh, before it is cut into parts and at the back of the chart
    skin: np.ndarray  # ids of the fine mesh's skin vertices
    eyes: tuple[_Eye, ...]
    lips: Slit | None
    lids: dict[int, Slit]  # by the index of the blink that shuts them
    source: np.ndarray  # [W] vertex of the fine mesh that each vertex of the cut mesh is
    split_triangles: np.ndarray  # [F, 3] of the cut mesh
    part: np.ndarray  # [W] index into stage.head.mesh.PARTS
    uv: np.ndarray  # [W, 2]


@lru_cache(maxsize=4)
def _plan(head: HeadModel, names: tuple[str, ...], subdivisions: int) -> _Plan:
    triangles = head.triangles.numpy()
    part = head.part.numpy()
    owner = part[triangles].max(1)  # [F]
    uv = _unwrapped(head.uv.double().numpy()[triangles])  # [F, 3, 2]
    count = len(head.mean)
    refine = csr_matrix(
        (np.ones(count), (np.arange(count), np.arange(count))), shape=(count, count)
    )  # the identity
    for _ in range(subdivisions):
        fine = (owner == _SKIN) | (owner == _EYE)
        step, divided = loop_step(triangles[fine], refine.shape[0])
        refine = step @ refine
        flat_uv = np.zeros((step.shape[1], 2))
        flat_uv[triangles.reshape(-1)] = uv.reshape(-1, 2)
        triangles = np.concatenate([divided, triangles[~fine]])
        owner = np.concatenate([np.repeat(owner[fine], 4), owner[~fine]])
        divided_uv = quartered(uv[fine]) + _slide(step, flat_uv, divided, quartered(uv[fine]))
        uv = np.concatenate([divided_uv, uv[~fine]])
    eyes = _eyes(head, triangles[owner == _EYE], refine)
    source, split, kinds, flat = _cut(triangles, owner, uv)
    parts = np.array([PARTS.index(name) for name in HEAD_PARTS], np.uint8)
    return _Plan(
        refine=refine,
        triangles=triangles,
        skin=np.unique(triangles[owner == _SKIN]),
        eyes=eyes,
        lips=_lip_slit(head, names),
        lids=_lid_slits(head, names),
        source=source,
        split_triangles=split,
        part=parts[kinds],
        uv=flat.astype(np.float32),
    )


def _lip_slit(head: HeadModel, names: tuple[str, ...]) -> Slit | None:
    if "jawOpen" not in names:
        return None
    part = head.part.numpy()
    jaw = head.expression[names.index("jawOpen")].double().numpy()
    skin, soft = np.flatnonzero(part == _SKIN), np.flatnonzero((part == _SKIN) | (part == _MOUTH))
    return lip_slit(head.mean.double().numpy(), head.uv.double().numpy(), skin, soft, jaw)


def _lid_slits(head: HeadModel, names: tuple[str, ...]) -> dict[int, Slit]:
    """The lids of each eye: a border of the skin that its blink moves more than any other."""
    mean, part, triangles = head.mean.double().numpy(), head.part.numpy(), head.triangles.numpy()
    skin = triangles[(part[triangles] == _SKIN).all(-1)]
    border = _borders(skin, len(mean))
    slits = {}
    for index, name in enumerate(names):
        if name.startswith("eyeBlink"):
            blink = head.expression[index].double().numpy() / EXPRESSION_STD
            loop = max(border, key=lambda loop: np.abs(blink[loop]).max())
            slits[index] = eye_slit(mean, mean + blink, loop, skin)
    return slits


def _borders(triangles: np.ndarray, count: int) -> list[np.ndarray]:
    """The vertices of each connected border of a surface."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), -1)
    edges, used = np.unique(sides, axis=0, return_counts=True)
    return _pieces(edges[used == 1], count)


def _pieces(cells: np.ndarray, count: int) -> list[np.ndarray]:
    """The vertices of each connected piece of edges or triangles [F, K]."""
    ends = cells[:, :-1].ravel(), cells[:, 1:].ravel()
    links = coo_matrix((np.ones(len(ends[0])), ends), (count, count))
    _, piece = connected_components(links, directed=False)
    used = np.unique(cells)
    return [used[piece[used] == label] for label in np.unique(piece[used])]


def _unwrapped(uv: np.ndarray) -> np.ndarray:
    """Corners [F, 3, 2] whose u differ by less than half a turn within each triangle."""
    out = uv.copy()
    out[:, 1:, 0] -= _TURN * np.round((uv[:, 1:, 0] - uv[:, :1, 0]) / _TURN)
    return out


def _slide(step: csr_matrix, flat_uv: np.ndarray, triangles: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """How far subdivision moves corners [F, 3, 2] in the texture, as it moves the vertices on the surface.

    Where neighbours lie on both sides of the seam at the back (or around an eyeball's back), it is zero.
    """
    moved = (step @ flat_uv)[triangles] - uv
    moved[..., 0] -= _TURN * np.round(moved[..., 0] / _TURN)
    return np.where(np.abs(moved).max(-1, keepdims=True) < _SLIDE_UV, moved, 0.0)


def _eyes(head: HeadModel, triangles: np.ndarray, refine: csr_matrix) -> tuple[_Eye, ...]:
    """Each eyeball, as a connected piece of the eyes' triangles."""
    old = len(head.mean)
    return tuple(_Eye(ball[ball < old], ball) for ball in _pieces(triangles, refine.shape[0]))


def _cut(
    triangles: np.ndarray, owner: np.ndarray, uv: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A vertex for every part and place in the texture: source [W], triangles [F, 3], part [W], uv [W, 2]."""
    corners = triangles.reshape(-1)
    kinds = np.repeat(owner, 3)
    turn = np.round(uv[..., 0].reshape(-1) * 1e4).astype(np.int64)
    keys = np.stack([corners, kinds.astype(np.int64), turn], -1)
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return corners[first], index.reshape(-1, 3), kinds[first], uv.reshape(-1, 2)[first]
