"""Whole bare head around the face of any face model: shell, ears, eyeballs, mouth and teeth.

The surface of the face is sampled finely and continued over skull, sides and neck (`cranium.py`). Where eyes
and mouth are open, they are cut out between the lids and between the lips (`openings.py`) and filled. The ear
is modelled in its own plane: `a` back from the mouth of the ear canal, `b` up, in millimetres.
"""

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.interpolate import CubicSpline
from torch import Tensor

from facerf_cli.face.topology import BOTTOM_M, HALF_ANGLE_DEG, TOP_M, UV_SIZE_MM, landmark_weights
from facerf_cli.portrait.parse import class_index
from facerf_cli.synth import tables_of
from facerf_cli.synth.head import mouth
from facerf_cli.synth.head.cranium import Surroundings, average_head_mm, face_surface
from facerf_cli.synth.head.mesh import (
    HeadMesh,
    arc_lengths,
    capped,
    joined,
    skin_classes,
    smooth_normals,
    smoothstep,
    strandless,
    unit,
)
from facerf_cli.synth.head.openings import Sheet, lips, outline, skin_sheet

EYEBALL_RADIUS_MM = 12.0
_CORNEA_RISE_MM, _CORNEA_HALF_DEG = 0.9, 30.0  # bulge of the cornea over the ball, and its half angle
_LID_MM = 1.5  # from the ball to the outer edge of the lid
_CLEARANCE_MM = 0.5  # minimal gap between the ball, without its cornea, and the skin
_PRIOR_MM = np.array([4.0, 4.0, 8.0])  # standard deviation of the centre around its usual place
_USUAL_MM = np.array([0.0, 1.0, -9.0])  # usual centre from the middle between the corners of the lids
_ITERATIONS = 8
_RINGS_DEG = np.array([0, 2, *range(4, 92, 3), 96, 103, 112, 125, 140, 160, 180.0])  # from the gaze axis
_SEGMENTS = 64  # of a ring
_CENTRE_MM = np.array([6.0, 2.0])  # rings of vertices shrink from the outline to this point
_RINGS, _SPOKES = 34, 112
_OUT_DEG, _BACK_TILT_DEG, _IN_DEG = 27.0, 10.0, 4.0  # orientation of the ear's plane against the head
_THICKNESS_MM = 3.2
_SINK_MM = 6.0  # depth of the front rim inside the cheek, so that no gap shows
_HOLLOW_MM, _HOLLOW_HALF_MM = np.array([7.0, 1.0]), np.array([9.0, 11.0])  # centre and half size
_BEND_MM = 3.0  # bend of the upper and lower end toward the head
_ROOT_MM = 20.0  # depth of the ear's back inside the head
_LIDS = {"eye_left": ((37, 41), (38, 40)), "eye_right": ((43, 47), (44, 46))}  # upper and lower landmarks
_LIPS = ((61, 67), (62, 66), (63, 65))
_SHUT_LIDS_MM, _SHUT_LIPS_MM = 2.0, 3.2  # gaps between landmarks up to which an opening is not cut
_OVERSHUT_LIDS_MM = 0.5  # lids that overlap more than this are cut apart, because the skin would fold
_AROUND_EYE_MM, _AROUND_EAR_MM = 9.0, 40.0  # reach of the skin that counts as near an eye, near an ear
_EAR_AZIMUTH_DEG, _EAR_Y_MM = 79.0, 8.0  # place of the ear canal
_EAR_OUT_MM = 1.5  # of the ear canal from the skin


def fitted_centre(margin: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """Fit the centre [3] of an eyeball to the margin of its lids [N, 3] (in the order of the outline).

    The ball keeps a clearance to all points of `skin` [M, 3] around the eye.
    """
    corners = margin[[0, len(margin) // 2]]
    usual = corners.mean(0) + _USUAL_MM
    along = corners[1] - corners[0]
    share = (margin - corners[0]) @ along / (along @ along)
    middle = margin[(share > 0.2) & (share < 0.8)]
    centre = usual.copy()
    for _ in range(_ITERATIONS):
        offset = centre - middle
        distance = np.linalg.norm(offset, axis=-1)
        slope = offset / distance[:, None]
        trust = len(middle) / _PRIOR_MM**2
        step = slope.T @ (distance - EYEBALL_RADIUS_MM - _LID_MM) + trust * (centre - usual)
        centre = centre - np.linalg.solve(slope.T @ slope + np.diag(trust), step)
    for _ in range(_ITERATIONS):
        depth = EYEBALL_RADIUS_MM + _CLEARANCE_MM - np.linalg.norm(skin - centre, axis=-1)
        if depth.max() <= 0:
            break
        centre = centre - [0, 0, depth.max()]
    return centre


def eyeball(centre: np.ndarray, gaze_deg: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices [V, 3], triangles [F, 3] and uv [V, 2] of an eyeball that looks along the gaze."""
    angle, turn = np.meshgrid(
        np.radians(_RINGS_DEG), np.arange(_SEGMENTS) / _SEGMENTS * 2 * np.pi, indexing="ij"
    )
    share = np.clip(angle / np.radians(_CORNEA_HALF_DEG), 0, 1)
    radius = EYEBALL_RADIUS_MM + _CORNEA_RISE_MM * (1 - share**2) ** 2
    local = (
        np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], -1)
        * radius[..., None]
    )
    azimuth, elevation = np.radians(gaze_deg)
    forward = np.array(
        [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    )
    side = np.array([np.cos(azimuth), 0, -np.sin(azimuth)])
    up = np.cross(forward, side)
    vertices = centre + local.reshape(-1, 3) @ np.stack([side, up, forward])
    reach = np.minimum(angle / (np.pi / 2), 1)
    uv = 0.5 + 0.5 * np.stack([reach * np.cos(turn), -reach * np.sin(turn)], -1).reshape(-1, 2)
    return vertices, capped(len(_RINGS_DEG), _SEGMENTS), uv


def ear_surface() -> tuple[np.ndarray, np.ndarray]:
    """Closed surface of the ear on the right side of the image: vertices [V, 3] and triangles [F, 3].

    Vertices are in millimetres from the mouth of the ear canal: x out of the head, y up, z forward.
    """
    rho = np.concatenate([np.linspace(0, 0.8, _RINGS // 2, endpoint=False), np.linspace(0.8, 1, _RINGS // 2)])
    turn = np.arange(_SPOKES) / _SPOKES
    rim = _outline(turn)  # [S, 2]
    plane = _CENTRE_MM + rho[:, None, None] * (rim - _CENTRE_MM)  # [R, S, 2]
    front = _relief(rho[:, None], plane)
    edge = np.sqrt(np.clip(1 - ((rho[:, None] - 0.86) / 0.14).clip(0, 1) ** 2, 0, 1))
    thickness = _THICKNESS_MM * edge
    attached = smoothstep(-rho[:, None], -0.92, -0.25)
    forward = smoothstep(-plane[..., 0], -12, 5)
    back = front - thickness - _ROOT_MM * np.maximum(attached, 0) * np.ones_like(front)
    front = front - _SINK_MM * forward * smoothstep(rho[:, None], 0.7, 1.0)
    back = back - _SINK_MM * forward
    sheet = np.concatenate([_placed(plane, front), _placed(plane, back)[-2::-1]])
    return sheet.reshape(-1, 3), capped(len(sheet), _SPOKES)[:, ::-1]


def ear_hollow_mm(points: np.ndarray) -> np.ndarray:
    """Return how deep [N] to push in the head's skin at points [N, 3], to make room for the ear's bowl.

    Points are in the coordinates of `ear_surface`.
    """
    offset = np.stack([-points[:, 2], points[:, 1]], -1) - _HOLLOW_MM
    from_centre = np.linalg.norm(offset / _HOLLOW_HALF_MM, axis=-1)
    return np.where(points[:, 0] > -30, _ROOT_MM * np.exp(-(from_centre**4)), 0)


def _outline(turn: np.ndarray) -> np.ndarray:
    """Return points [S, 2] of the outline at fractions [S] of its length."""
    points = np.array(tables_of(__file__)["ear_mm"], float)
    points = np.concatenate([points, points[:1]])
    length = arc_lengths(points)
    return CubicSpline(length / length[-1], points, bc_type="periodic")(turn)


def _relief(rho: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Return the height [R, S] of the ear's outer side above its plane: a sum of bumps and dents."""
    a, b = plane[..., 0], plane[..., 1]
    lobe = smoothstep(-b, 10, 20)
    rear = smoothstep(a, -3, 6)
    above = np.maximum(rear, smoothstep(b, 10, 20))
    helix = 3.4 * np.exp(-(((rho - 0.90) / 0.085) ** 2)) * above * (1 - 0.8 * lobe)
    scapha = -1.6 * np.exp(-(((rho - 0.74) / 0.07) ** 2)) * above * (1 - lobe)
    antihelix = 2.6 * np.exp(-(((rho - 0.57) / 0.10) ** 2)) * smoothstep(a, 2, 10) * (1 - lobe)
    bowl = -11.0 * np.exp(-((((a - 5.5) / 7.5) ** 2 + ((b + 0.5) / 10.0) ** 2) ** 1.6))
    crus = 4.0 * np.exp(-(((b - 5.5 - 0.25 * a) / 2.2) ** 2)) * smoothstep(-a, -9, 2) * smoothstep(a, -9, -2)
    fossa = -2.0 * np.exp(-(((a - 11) / 6) ** 2 + ((b - 22) / 6) ** 2))
    tragus = 6.5 * np.exp(-((((a + 4.0) / 3.2) ** 2 + ((b + 2.0) / 6.0) ** 2) ** 1.5))
    antitragus = 2.6 * np.exp(-(((a - 6) / 4.5) ** 2 + ((b + 13) / 2.8) ** 2))
    plump = 1.5 * np.exp(-(((a - 6) / 9) ** 2 + ((b + 21) / 6) ** 2))
    turned = -2.6 * np.clip((rho - 0.9) / 0.1, 0, 1) ** 2
    bend = -_BEND_MM * ((b - 6) / 30) ** 2
    return bend + helix + scapha + antihelix + bowl + crus + fossa + tragus + antitragus + plump + turned


def _placed(plane: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return points [R, S, 3] at (a, b) [R, S, 2] above the plane, which turns out and tilts back."""
    out, tilt = np.radians(_OUT_DEG), np.radians(_BACK_TILT_DEG)
    back = np.array([np.sin(out), 0, -np.cos(out)])
    normal = np.array([np.cos(out), 0, np.sin(out)])
    up = np.array([0.0, 1, 0])
    back, up = back * np.cos(tilt) - up * np.sin(tilt), up * np.cos(tilt) + back * np.sin(tilt)
    lean = np.radians(_IN_DEG)  # the upper part stands off a little more
    up = up * np.cos(lean) + normal * np.sin(lean)
    normal = np.cross(up, back) * -1
    return plane[..., :1] * back + plane[..., 1:] * up + height[..., None] * normal


def shell_head(vertices: Tensor, gaze_deg: tuple[float, float], subdivisions: int) -> HeadMesh:
    """Build the whole bare head of a face given as canonical vertices [GRID * GRID, 3] in metres.

    gaze_deg: azimuth to the right of the image, elevation up. The samples of the skin are about
    1 mm / 2 ** (subdivisions - 1) apart.
    """
    face_mm = vertices.detach().cpu().double().numpy() * 1000
    corners, weights = (array.numpy() for array in landmark_weights())
    landmarks_mm = (face_mm[corners] * weights[..., None]).sum(1)
    cut = _open(landmarks_mm)
    sheet = skin_sheet(subdivisions, cut)
    skin_mm = _skin(face_mm, sheet, subdivisions, cut)
    roots = {side: _ear_root(skin_mm, sheet, side) for side in (-1.0, 1.0)}
    for side, root in roots.items():
        skin_mm = _hollowed(skin_mm, root, side)
    around = {name: skin_mm[_around_eye(sheet.u_level, name)] for name in _LIDS}
    balls = {name: fitted_centre(face_surface(face_mm, outline(name)), around[name]) for name in _LIDS}
    normals = _normals(skin_mm, sheet.triangles, sheet.same)
    parts = [_ear(root, side) for side, root in roots.items()]
    parts += [_part("eye", *eyeball(centre, gaze_deg)) for centre in balls.values()]
    rims = {}
    for name, rim in sheet.rims.items():
        edge, down = skin_mm[rim], -normals[rim]
        inward = _inward(edge, normals[rim])
        rims[name] = _lips(edge, inward, down) if name == "mouth" else _lid(edge, inward, balls[name], down)
    if "mouth" in rims:
        inner = rims["mouth"][-1]
        parts.append(_part("mouth", *mouth.bag(inner)))
        parts += [_part("mouth", *mesh) for mesh in mouth.gums_and_tongue(landmarks_mm, inner)]
        parts.append(_part("teeth", *mouth.teeth(landmarks_mm, inner)))
    return joined(_rimmed(skin_mm, sheet, rims), *parts)


def _rimmed(skin_mm: np.ndarray, sheet: Sheet, rims: dict[str, list[np.ndarray]]) -> HeadMesh:
    """Return the skin with rings [N, 3] added at the rims of its openings; a ring has the uv of its rim."""
    vertices, uv, triangles = [skin_mm], [_continued_uv(sheet.u_level)], [sheet.triangles]
    for name, rings in rims.items():
        triangles.append(_strip(sheet.rims[name], sum(map(len, vertices)), len(rings)))
        vertices += rings
        uv += [uv[0][sheet.rims[name]]] * len(rings)
    count = sum(map(len, vertices))
    same = np.concatenate([sheet.same, np.arange(len(skin_mm), count)])
    whole_uv = np.concatenate(uv)
    label = skin_classes(whole_uv)
    return _part("skin", np.concatenate(vertices), np.concatenate(triangles), whole_uv, same, label)


def _open(landmarks_mm: np.ndarray) -> tuple[str, ...]:
    """Return the names of the openings that are wide enough to be cut."""
    gaps = {
        name: max(landmarks_mm[upper, 1] - landmarks_mm[lower, 1] for upper, lower in pairs)
        for name, pairs in _LIDS.items()
    }
    shut = [name for name, gap in gaps.items() if not -_OVERSHUT_LIDS_MM < gap <= _SHUT_LIDS_MM]
    parted = max(landmarks_mm[upper, 1] - landmarks_mm[lower, 1] for upper, lower in _LIPS)
    return (*shut, "mouth") if parted > _SHUT_LIPS_MM else tuple(shut)


def _skin(face_mm: np.ndarray, sheet: Sheet, subdivisions: int, cut: tuple[str, ...]) -> np.ndarray:
    """Return positions [N, 3] in millimetres of the samples of the sheet."""
    on = _on_face(sheet.u_level)
    skin = np.empty((len(on), 3))
    skin[on] = face_surface(face_mm, sheet.u_level[on])
    for name in cut:
        for lip in lips(name):
            samples = np.flatnonzero(lip.holds(sheet.u_level))
            side_mm = face_mm.copy()
            side_mm[lip.replaced] = lip.weights @ face_mm[lip.sources]
            skin[samples] = face_surface(side_mm, sheet.u_level[samples])
    skin[~on] = _surroundings(subdivisions).positions(face_mm)
    return skin[sheet.same]


@cache  # all heads share it
def _surroundings(subdivisions: int) -> Surroundings:
    """Return the head outside the face, at the samples of the sheet."""
    u_level = skin_sheet(subdivisions, ()).u_level
    return Surroundings(u_level[~_on_face(u_level)])


def _on_face(u_level: np.ndarray) -> np.ndarray:
    """[N] bool: samples inside the UV map of the face."""
    inside: np.ndarray = (u_level >= 0) & (u_level <= 1)
    return inside[:, 0] & inside[:, 1]


def _around_eye(uv: np.ndarray, name: str) -> np.ndarray:
    """Return ids [M] of samples at uv [N, 2] around an eye."""
    line, margin = outline(name), _AROUND_EYE_MM / 1000 / (TOP_M - BOTTOM_M)
    return np.flatnonzero(((uv > line.min(0) - margin) & (uv < line.max(0) + margin)).all(-1))


def _continued_uv(u_level: np.ndarray) -> np.ndarray:
    """uv [N, 2] of the continued UV map: over the crown, v is the height on the average head."""
    v = u_level[:, 1].copy()
    crown = v < 0
    y = average_head_mm(*u_level[crown].T)[:, 1] / 1000
    v[crown] = (TOP_M - y) / (TOP_M - BOTTOM_M)
    return np.stack([u_level[:, 0], v], -1)


def _inward(edge: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Unit vectors [N, 3] along the surface from a counter-clockwise rim into its opening."""
    along = np.roll(edge, -1, 0) - np.roll(edge, 1, 0)
    across = np.cross(normals, along)
    for _ in range(2):
        across = unit(across)
        across = np.roll(across, 1, 0) + 2 * across + np.roll(across, -1, 0)
    return unit(across)


def _lid(edge: np.ndarray, inward: np.ndarray, ball: np.ndarray, down: np.ndarray) -> list[np.ndarray]:
    """Build rings of the margin of the lids, from their edge to just under the surface of the eyeball."""
    low = edge + 0.6 * inward
    to_ball = low - ball
    foot = ball + unit(to_ball) * (EYEBALL_RADIUS_MM - 0.3)
    rounded = edge + 0.2 * inward + 0.15 * down
    return [rounded, 0.6 * rounded + 0.4 * foot + 0.15 * inward, foot]


def _lips(edge: np.ndarray, inward: np.ndarray, down: np.ndarray) -> list[np.ndarray]:
    """Build rings of the lips, which roll back into the mouth."""
    back = np.array([0.0, 0, -1])
    return [
        edge + 0.25 * inward + 0.35 * down + 0.2 * back,
        edge + 0.3 * inward + 1.0 * back + 0.5 * down,
        edge - 0.3 * inward + 3.0 * back,
    ]


def _strip(rim: np.ndarray, first: int, rings: int) -> np.ndarray:
    """Build triangles between the vertices of a rim and rings of new vertices with ids from `first`."""
    count = len(rim)
    ids = np.concatenate([rim[None], first + np.arange(rings * count).reshape(rings, count)])
    a, b = ids[:-1], np.roll(ids[:-1], -1, 1)
    c, d = ids[1:], np.roll(ids[1:], -1, 1)
    return np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])


def _ear_root(skin_mm: np.ndarray, sheet: Sheet, side: float) -> np.ndarray:
    """Return the position [3] of the ear canal on one side of the head (1: right in the image, -1: left)."""
    u = 0.5 + side * _EAR_AZIMUTH_DEG / (2 * HALF_ANGLE_DEG)
    v = (TOP_M - _EAR_Y_MM / 1000) / (TOP_M - BOTTOM_M)
    nearest = (((sheet.u_level - [u, v]) * UV_SIZE_MM) ** 2).sum(-1).argmin()
    return skin_mm[nearest] + [side * _EAR_OUT_MM, 0, 0]


def _hollowed(skin_mm: np.ndarray, root: np.ndarray, side: float) -> np.ndarray:
    """Return the skin pushed in behind the bowl of the ear."""
    near = np.flatnonzero((np.abs(skin_mm - root) < _AROUND_EAR_MM).all(-1))
    hollowed = skin_mm.copy()
    hollowed[near, 0] -= side * ear_hollow_mm((skin_mm[near] - root) * [side, 1, 1])
    return hollowed


def _ear(root: np.ndarray, side: float) -> HeadMesh:
    vertices, triangles = ear_surface()
    points = root + vertices * [side, 1, 1]
    azimuth_deg = np.degrees(np.arctan2(points[:, 0], points[:, 2]))
    u = 0.5 + azimuth_deg / (2 * HALF_ANGLE_DEG)
    uv = np.stack([u, (TOP_M - points[:, 1] / 1000) / (TOP_M - BOTTOM_M)], -1)
    label = np.full(len(points), class_index("ears"), np.uint8)
    return _part("skin", points, triangles if side > 0 else triangles[:, ::-1], uv, label=label)


def _part(
    name: str,
    vertices_mm: np.ndarray,
    triangles: np.ndarray,
    uv: np.ndarray,
    same: np.ndarray | None = None,
    label: np.ndarray | None = None,
) -> HeadMesh:
    """Make a mesh of one part, without unused vertices.

    same [V]: the vertex that represents each position; label [V]: classes, by default the part's.
    """
    used = np.zeros(len(vertices_mm), bool)
    used[triangles] = True
    place = np.arange(len(vertices_mm)) if same is None else same
    normals = _normals(vertices_mm, triangles, place)[used]
    mesh = strandless(name, vertices_mm[used] / 1000, normals, (np.cumsum(used) - 1)[triangles], uv[used])
    return mesh if label is None else replace(mesh, label=label[used])


def _normals(vertices: np.ndarray, triangles: np.ndarray, same: np.ndarray) -> np.ndarray:
    """Unit normals [V, 3], area-weighted; vertices with the same place share their normal."""
    return smooth_normals(vertices, same[triangles])[same]
