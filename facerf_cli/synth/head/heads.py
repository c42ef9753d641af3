"""The bare head of a person: skin, eyes with a gaze, mouth and teeth.

A face model that has a whole head (`HeadModel`) gives its mesh; around any other face a head is built
(`shell.py`). A linear model leaves closed lips and lids open or lets them cross, by another width for each
person: a `Slit` closes them.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from facerf_cli.face.morphable import EXPRESSION_STD, HEAD_PARTS, HeadModel, MorphableModel
from facerf_cli.face.topology import HALF_ANGLE_DEG, LANDMARK_UV
from facerf_cli.portrait.classes import class_index
from facerf_cli.synth.head.mesh import (
    PARTS,
    HeadMesh,
    ears_of,
    loop_step,
    part_class,
    quartered,
    skin_classes,
    smooth_normals,
)
from facerf_cli.synth.head.shell import shell_head

_COLUMNS = 33  # positions across a slit at which its width is measured
_LIP_OVERLAP_M, _LID_OVERLAP_M = 0.0004, 0.0008  # of closed edges, which subdivision rounds off
_LIP_REACH_M, _SLIT_REACH_M = 0.006, 0.004  # standard deviation of the area around a slit that moves along
_LIP_MARGIN_UV = np.array([0, 0.04])  # margin around the inner lip landmarks in which lip edges are searched
_LID_RINGS = 5  # rings of vertices from the inner border of the lids that are searched for their edges
_INNER_LIPS_UV = LANDMARK_UV[60:68]


@dataclass(frozen=True, eq=False)
class Slit:
    """A slit between an upper and a lower edge.

    upper, lower: vertex ids of the edges from left to right; weight [N] in [-1, 1]: displacement of each
    vertex when the slit opens by 1, positive (up) on the upper side; overlap_m: overlap of closed edges.
    """

    upper: np.ndarray
    lower: np.ndarray
    weight: np.ndarray
    overlap_m: float

    def closing(self, shape: np.ndarray) -> np.ndarray:
        """Offsets along y [N] that bring the edges of a head [N, 3] together, whether they gape or cross."""
        ends = [shape[edge][[0, -1], 0] for edge in (self.upper, self.lower)]
        columns = np.linspace(max(ends[0][0], ends[1][0]), min(ends[0][1], ends[1][1]), _COLUMNS)
        rising = (edge[np.argsort(shape[edge, 0])] for edge in (self.upper, self.lower))
        upper, lower = (np.interp(columns, shape[edge, 0], shape[edge, 1]) for edge in rising)
        width = upper - lower + self.overlap_m
        width = np.convolve(np.pad(width, 2, mode="edge"), [0.1, 0.2, 0.4, 0.2, 0.1], "valid")
        width *= np.minimum(1, np.minimum(np.arange(_COLUMNS), np.arange(_COLUMNS)[::-1]) / 2)
        return -self.weight * np.interp(shape[:, 0], columns, width, left=0, right=0)


def eye_slit(mean: np.ndarray, shut: np.ndarray, loop: np.ndarray, triangles: np.ndarray) -> Slit:
    """Find the slit between the lids around a loop [K] of the skin's border.

    mean [N, 3] has open eyes, shut [N, 3] is the mean with a blink. Of the rings of vertices around the loop,
    the lid edges are those that come nearest to each other when shut.
    """
    corners = loop[[mean[loop, 0].argmin(), mean[loop, 0].argmax()]]
    above = mean[:, 1] > np.interp(mean[:, 0], *mean[corners, :2].T)
    middle = np.abs(mean[:, 0] - mean[corners, 0].mean()) < np.ptp(mean[corners, 0]) / 4
    rings = _rings(loop, triangles)
    upper = min((ring[above[ring]] for ring in rings), key=lambda ids: shut[ids[middle[ids]], 1].mean())
    lower = max((ring[~above[ring]] for ring in rings), key=lambda ids: shut[ids[middle[ids]], 1].mean())
    edges = upper[np.argsort(mean[upper, 0])], lower[np.argsort(mean[lower, 0])]
    return Slit(
        *edges, _weight(mean, *edges, np.unique(triangles), above, _SLIT_REACH_M, 0.7), _LID_OVERLAP_M
    )


def _rings(loop: np.ndarray, triangles: np.ndarray) -> list[np.ndarray]:
    """A loop [K] of vertices, then its neighbours, then their neighbours and so on."""
    rings, seen = [loop], np.zeros(triangles.max() + 1, bool)
    for _ in range(_LID_RINGS):
        seen[rings[-1]] = True
        around = np.unique(triangles[seen[triangles].any(-1)])
        rings.append(around[~seen[around]])
    return rings


def lip_slit(mean: np.ndarray, uv: np.ndarray, skin: np.ndarray, soft: np.ndarray, jaw: np.ndarray) -> Slit:
    """Find the slit between the lips; jaw [N, 3]: the shape that opens it, soft: ids of skin and mouth."""
    low, high = _INNER_LIPS_UV.min(0) - _LIP_MARGIN_UV, _INNER_LIPS_UV.max(0) + _LIP_MARGIN_UV
    lips = skin[((uv[skin] > low) & (uv[skin] < high)).all(-1)]
    fall = np.linalg.norm(jaw, axis=-1)
    above = fall < fall[lips].max() / 2
    edges = _edges(mean, lips, above, mean[lips, 0].min(), mean[lips, 0].max())
    return Slit(*edges, _weight(mean, *edges, soft, above, _LIP_REACH_M, 0.5), _LIP_OVERLAP_M)


def _edges(
    mean: np.ndarray, ids: np.ndarray, above: np.ndarray, left: float, right: float
) -> tuple[np.ndarray, np.ndarray]:
    """The lowest vertex above the slit and the highest below it, in columns from left to right."""
    column = np.digitize(mean[ids, 0], np.linspace(left, right, _COLUMNS))
    upper, lower = [], []
    for index in range(1, _COLUMNS):
        over, under = (ids[(column == index) & side] for side in (above[ids], ~above[ids]))
        upper += [over[mean[over, 1].argmin()]] if len(over) else []
        lower += [under[mean[under, 1].argmax()]] if len(under) else []
    return np.array(upper), np.array(lower)


def _weight(
    mean: np.ndarray,
    upper: np.ndarray,
    lower: np.ndarray,
    movable: np.ndarray,
    above: np.ndarray,
    reach_m: float,
    share: float,
) -> np.ndarray:
    """Weights [N] of `Slit`, which fall with the distance from the edge; `share`: part of the upper side."""
    weight = np.zeros(len(mean))
    for edge, side, part in ((upper, above, share), (lower, ~above, share - 1)):
        own = movable[side[movable]]
        away, _ = cKDTree(mean[edge]).query(mean[own])
        weight[own] = part * np.exp(-((away / reach_m) ** 2) / 2)
    return weight


_TURN = 360 / (2 * HALF_ANGLE_DEG)  # of u, once around the head
_LOOK_DEG = 30.0  # gaze at which an eyeLook shape has its full strength
_LID_GAP_M = 0.0002  # minimal gap between lids and eyeball
_LID_REACH_M = 0.0008  # lids nearer to the ball than this are moved
_SLIDE_UV = 0.03  # largest shift of a vertex in the texture by subdivision; a larger one is a seam
_SKIN, _EYE, _MOUTH = (HEAD_PARTS.index(name) for name in ("skin", "eye", "mouth"))


def build_head(
    model: MorphableModel,
    alpha: Tensor,
    beta: Tensor,
    gaze_deg: tuple[float, float] = (0.0, 0.0),
    subdivisions: int = 1,
) -> HeadMesh:
    """Build the head of a person alpha [Ki] with the expression beta [Ke] and the gaze `gaze_deg`.

    The gaze is (azimuth to the right of the image, elevation up) in the head frame; the lids follow it. Skin
    and eyes are subdivided (Loop, 1987); at one subdivision the vertices of the face are about 1 mm apart.
    """
    if model.head is None:
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
    normals = smooth_normals(vertices, plan.triangles)
    return HeadMesh(
        vertices=vertices[plan.source].astype(np.float32),
        normals=normals[plan.source].astype(np.float32),
        triangles=plan.split_triangles,
        part=plan.part,
        uv=plan.uv,
        tangents=np.zeros((len(plan.source), 3), np.float32),
        label=plan.label,
    )


def _lids(names: tuple[str, ...], beta: Tensor, gaze_deg: tuple[float, float]) -> Tensor:
    """Coefficients [Ke] of ICT's eyeLook shapes that move the lids with the gaze, zero for all others."""
    azimuth, elevation = gaze_deg
    right, up = azimuth / _LOOK_DEG, elevation / _LOOK_DEG
    strength = {"Up_L": up, "Up_R": up, "Down_L": -up, "Down_R": -up}
    strength |= {"Out_L": right, "In_R": right, "In_L": -right, "Out_R": -right}  # L: the person's left, +x
    moved = torch.zeros_like(beta)
    for index, name in enumerate(names):
        if name.startswith("eyeLook"):
            blink = names.index(f"eyeBlink{name[-2:]}") if f"eyeBlink{name[-2:]}" in names else None
            closed = 0.0 if blink is None else float(beta[blink]) * EXPRESSION_STD
            full = max(strength.get(name.removeprefix("eyeLook"), 0.0), 0.0) * min(max(1 - closed, 0.0), 1.0)
            moved[index] = full / EXPRESSION_STD
    return moved


def _closings(head: HeadModel, plan: "_Plan", alpha: Tensor, beta: Tensor, shape: np.ndarray) -> np.ndarray:
    """Offsets along y [N] that close the lips of a neutral face, and the lids in proportion to a blink."""
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
    """Vertices of an eyeball [N, 3] turned around its centre to the gaze."""
    centre = (ball.min(0) + ball.max(0)) / 2
    turn = Rotation.from_euler("YX", [gaze_deg[0], -gaze_deg[1]], degrees=True)
    return centre + turn.apply(ball - centre)


def _clear_of_ball(vertices: np.ndarray, skin: np.ndarray, ball: np.ndarray) -> None:
    """Push skin out of an eyeball, in place; skin away from the ball stays.

    A blendshape moves a lid along a straight line, which leads through the ball instead of over it.
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
    """Vertex ids of one eyeball, before and after subdivision."""

    coarse: np.ndarray
    fine: np.ndarray


@dataclass(frozen=True, eq=False)
class _Plan:
    """The properties of a head's mesh that are the same for every person."""

    refine: csr_matrix  # [V, N]: from vertices of the model to those of the fine mesh
    triangles: np.ndarray  # [F, 3] of the fine mesh, before it is cut into parts and at the UV seam
    skin: np.ndarray  # ids of the skin vertices of the fine mesh
    eyes: tuple[_Eye, ...]
    lips: Slit | None
    lids: dict[int, Slit]  # by the index of the blink shape that shuts them
    source: np.ndarray  # [W] vertex of the fine mesh for each vertex of the cut mesh
    split_triangles: np.ndarray  # [F, 3] of the cut mesh
    part: np.ndarray  # [W] index into `PARTS`
    uv: np.ndarray  # [W, 2]
    label: np.ndarray  # [W] index into `labels.CLASSES`


@lru_cache(maxsize=4)  # all heads of a model share it
def _plan(head: HeadModel, names: tuple[str, ...], subdivisions: int) -> _Plan:
    """Subdivide a head model's mesh, cut it into parts and find its slits; names: of the expressions."""
    triangles = head.triangles.numpy()
    part = head.part.numpy()
    owner = part[triangles].max(1)  # [F] part of each triangle
    uv = _unwrapped(head.uv.double().numpy()[triangles])  # [F, 3, 2]
    count = len(head.mean)
    every = np.arange(count)
    refine = csr_matrix((np.ones(count), (every, every)), shape=(count, count))  # the identity
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
    balls = _pieces(triangles[owner == _EYE], refine.shape[0])  # the connected components
    source, split, kinds, flat = _cut(triangles, owner, uv)
    parts = np.array([PARTS.index(name) for name in HEAD_PARTS], np.uint8)
    return _Plan(
        refine=refine,
        triangles=triangles,
        skin=np.unique(triangles[owner == _SKIN]),
        eyes=tuple(_Eye(ball[ball < count], ball) for ball in balls),
        lips=_lip_slit(head, names),
        lids=_lid_slits(head, names),
        source=source,
        split_triangles=split,
        part=parts[kinds],
        uv=flat.astype(np.float32),
        label=_labels(refine @ head.mean.double().numpy(), source, kinds, flat),
    )


def _labels(mean: np.ndarray, source: np.ndarray, kinds: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Classes [W] of the vertices `source` of the fine mean head; kinds [W]: their parts of `HEAD_PARTS`."""
    labels = np.array([part_class(name) for name in HEAD_PARTS], np.uint8)[kinds]
    skin = kinds == _SKIN
    labels[skin] = np.where(ears_of(mean[source[skin]]), class_index("ears"), skin_classes(uv[skin]))
    return labels


def _lip_slit(head: HeadModel, names: tuple[str, ...]) -> Slit | None:
    """The slit between the lips, if the model has a shape that opens the jaw."""
    if "jawOpen" not in names:
        return None
    part = head.part.numpy()
    jaw = head.expression[names.index("jawOpen")].double().numpy()
    skin, soft = np.flatnonzero(part == _SKIN), np.flatnonzero((part == _SKIN) | (part == _MOUTH))
    return lip_slit(head.mean.double().numpy(), head.uv.double().numpy(), skin, soft, jaw)


def _lid_slits(head: HeadModel, names: tuple[str, ...]) -> dict[int, Slit]:
    """The lids of each eye, by the index of its blink: the border of the skin that the blink moves most."""
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
    """Vertex ids of each connected border of a surface."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), -1)
    edges, used = np.unique(sides, axis=0, return_counts=True)
    return _pieces(edges[used == 1], count)


def _pieces(cells: np.ndarray, count: int) -> list[np.ndarray]:
    """Vertex ids of each connected component of edges or triangles [F, K]."""
    ends = cells[:, :-1].ravel(), cells[:, 1:].ravel()
    links = coo_matrix((np.ones(len(ends[0])), ends), (count, count))
    _, piece = connected_components(links, directed=False)
    used = np.unique(cells)
    return [used[piece[used] == label] for label in np.unique(piece[used])]


def _unwrapped(uv: np.ndarray) -> np.ndarray:
    """Corners [F, 3, 2] with u shifted by whole turns, so that it is continuous within each triangle."""
    out = uv.copy()
    out[:, 1:, 0] -= _TURN * np.round((uv[:, 1:, 0] - uv[:, :1, 0]) / _TURN)
    return out


def _slide(step: csr_matrix, flat_uv: np.ndarray, triangles: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Shifts [F, 3, 2] of corners in the texture that follow the vertices as subdivision moves them.

    The shift is zero at the seam at the back of the head and at the back of an eyeball.
    """
    moved = (step @ flat_uv)[triangles] - uv
    moved[..., 0] -= _TURN * np.round(moved[..., 0] / _TURN)
    return np.where(np.abs(moved).max(-1, keepdims=True) < _SLIDE_UV, moved, 0.0)


def _cut(
    triangles: np.ndarray, owner: np.ndarray, uv: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Split vertices by part and place in the texture: source [W], triangles [F, 3], part [W], uv [W, 2]."""
    corners = triangles.reshape(-1)
    kinds = np.repeat(owner, 3)
    turn = np.round(uv[..., 0].reshape(-1) * 1e4).astype(np.int64)
    keys = np.stack([corners, kinds.astype(np.int64), turn], -1)
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return corners[first], index.reshape(-1, 3), kinds[first], uv.reshape(-1, 2)[first]
