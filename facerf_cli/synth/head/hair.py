"""Hair, beard, moustache and lashes: tapered ribbons, one per wisp, rooted on the skin and combed.

A wisp grows from its root in steps. Each step follows the combing direction of the style and, increasingly
with the distance from the root, gravity; it slides along the hull of the head where it touches it and stays
in the layer of the wisp above it. Then the wisps of a clump draw together toward their tips, and curl. A wisp
that hangs in front of the face is grown a second time, shorter. Heights and azimuths are in the head frame
(`face.topology`).
"""

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from facerf_cli.face.topology import LANDMARK_UV
from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.appearance.facial_hair import beard_density
from facerf_cli.synth.head.hair_styles import ROWS, HairStyle, draw_style, scalp_margin_m, tail_paths, tied
from facerf_cli.synth.head.mesh import (
    PARTS,
    HeadMesh,
    Hull,
    doubled_areas,
    drawn_places,
    hull_of,
    joined,
    part_class,
    smoothstep,
    unit,
)
from facerf_cli.synth.head.worn import Headwear
from facerf_cli.synth.random_fields import CANVAS_SPAN, Random, Window

MAX_VERTICES = 250_000  # of all hair; more wisps are dropped

_FACE_DEG = 50.0  # hair below the fringe covers the face up to this azimuth
_CROWN_M = np.array([0, 0.145, -0.01])  # thinning is strongest here and in front of it
_CHIN_M = -0.13  # hair below this height no longer covers the face
_RAGGED_M = 0.002  # standard deviation of the hairline's height
_RAGGED_FRINGE_M, _FRINGE_LOCKS = 0.005, 400  # deviation of a fringe's edge; locks of all hair
_SHORTEST_STEP_M = 1e-4  # of a wisp
_BEARD = HairStyle(name="beard", comb="whorl", segments=5, width_mm=0.6)
_LASHES = HairStyle(name="lashes", comb="whorl", segments=4, width_mm=0.22)
_WISPS = 7000  # of a full beard
_MOUTH_V = float(LANDMARK_UV[48:60, 1].mean())
_LIP_M = 0.034  # half width of a moustache
_LEAST_COVER = 0.15  # of a beard that has length
_LIDS = (((36, 37, 38, 39), 110), ((39, 40, 41, 36), 60), ((42, 43, 44, 45), 110), ((45, 46, 47, 42), 60))
_LASH_M = {110: 0.009, 60: 0.0055}  # length of upper and lower lashes, by their number


def draw_hair(
    head: HeadMesh, random: Random, headwear: Headwear | None = None
) -> tuple[HeadMesh | None, HairStyle]:
    """Draw a style and grow it on a head. If the head wears clothes, long hair falls over them."""
    style = draw_style(random)
    if headwear is None:
        hair = grow_hair(head, style, random)
    else:
        hair = headwear.uncovered(grow_hair(head, headwear.flat(style), random))
    return hair if len(hair.vertices) else None, style


def grow_hair(head: HeadMesh, style: HairStyle, random: Random) -> HeadMesh:
    """Grow only the hair, as part "hair"; without vertices if the style has none.

    Normals belong to a soft volume and not to the ribbons. uv: a random number of the wisp, and the
    position from root (0) to tip (1).
    """
    roots, root_normals, margin = _roots(head, style, random)
    if not len(roots):
        none = np.zeros((0, style.segments + 1, 3))
        return ribbons(none, none, none[:, 0], style, random)
    hull = hull_of(head)
    length = _lengths(roots, margin, style, random)
    wisps = _Wisps(roots, root_normals, style, hull, random)
    paths = wisps.grow(length)
    ragged_m = _ragged(roots, style, random)
    covers = _covers_face(paths, style, ragged_m)
    first = np.where(covers.any(1), covers.argmax(1), style.segments + 1)
    last = np.maximum(first - 0.7, 0.3) / style.segments
    length = length * np.where(covers.any(1), last**style.crowding, 1)
    paths = wisps.grow(length)
    if style.comb == "tied":
        paths = tied(paths, hull, style.knot_mm / 1000, style.layer_mm / 1000)
    leaders = random.choice(len(roots), max(1, len(roots) // style.clump_wisps), replace=False)
    leader = leaders[cKDTree(roots[leaders]).query(roots)[1]]  # of each wisp's clump: the nearest
    paths = _clumped(paths, leader, style, random)
    normals = hull.normals(paths)
    paths = _curled(paths, normals, length, leader, style, random)
    paths = hull.lifted(paths, np.minimum(0.0008, 0.02 * np.linspace(0, 1, paths.shape[1])))
    paths[:, 0] = roots - 0.001 * root_normals
    keep = ~_covers_face(paths, style, ragged_m).any(1)
    hair = ribbons(paths[keep], normals[keep], root_normals[keep], style, random)
    return joined(hair, _tail(head, style, hull, random)) if style.tail else hair


def _tail(head: HeadMesh, style: HairStyle, hull: Hull, random: Random) -> HeadMesh:
    paths, normals = tail_paths(style.tail, head.vertices, hull, style.knot_mm / 1000, random)
    shape = replace(style, segments=ROWS - 1, crowding=1.0)
    return ribbons(paths, normals, normals[:, 0], shape, random)


def _roots(head: HeadMesh, style: HairStyle, random: Random) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw roots [W, 3], the normals of the skin there [W, 3], and their height above the hairline [W]."""
    triangles = head.faces_of("skin")
    corners = head.vertices[triangles].astype(float)
    centre = corners.mean(1)
    margin = scalp_margin_m(centre, style)
    ragged = margin + random.normal(0, _RAGGED_M, len(margin))
    chance = doubled_areas(corners) * np.clip(ragged / 0.007 + 0.25, 0, 1) ** 1.5
    from_crown_m = np.linalg.norm((centre - _CROWN_M) * [1, 1, 0.8], axis=-1)
    bare = 0.97 * np.clip((0.075 - from_crown_m) / 0.025, 0, 1)
    chance = chance * (1 - style.thinning * bare)
    if style.comb == "parted":  # a parting shows its roots, so it needs more of them
        chance = chance * (1 + 3 * np.exp(-(((centre[:, 0] - style.parting_mm / 1000) / 0.008) ** 2)))
    if not style.wisps or not chance.any():
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    roots, normals, chosen = drawn_places(head, triangles, chance, style.wisps, random)
    return roots, normals, margin[chosen]


def _lengths(roots: np.ndarray, margin: np.ndarray, style: HairStyle, random: Random) -> np.ndarray:
    """Draw the lengths [W] of wisps in metres."""
    top = smoothstep((roots[:, 1] - 0.055) / 0.05)
    length = style.side_mm + (style.top_mm - style.side_mm) * top
    edge = style.edge + (1 - style.edge) * smoothstep(margin / 0.02)
    return length * edge * random.uniform(0.75, 1.08, len(roots)) / 1000


def _shares(style: HairStyle) -> np.ndarray:
    """Position in 0..1 along the wisp of each of its rows [segments + 1]."""
    return np.linspace(0, 1, style.segments + 1) ** style.crowding


class _Wisps:
    """Wisps with the random numbers that stay the same when they grow a second time."""

    def __init__(
        self, roots: np.ndarray, normals: np.ndarray, style: HairStyle, hull: Hull, random: Random
    ) -> None:
        self.roots, self.normals, self.style, self.hull = roots, normals, style, hull
        count = len(roots)
        self.layer_m = style.layer_mm / 1000 * random.uniform(0.15, 1, count) ** 0.7
        self.stray = random.normal(0, style.stray, (count, 3))
        self.lift = style.lift * random.uniform(0.6, 1.3, count)

    def grow(self, length_m: np.ndarray) -> np.ndarray:
        """Grow paths [W, segments + 1, 3] of wisps of these lengths [W]."""
        style, steps = self.style, self.style.segments
        points, rows = self.roots, [self.roots]
        shares = _shares(style)
        for index in range(steps):
            share = shares[index]
            step = np.maximum(length_m * (shares[index + 1] - share), _SHORTEST_STEP_M)[:, None]
            normal = self.normals if index == 0 else self.hull.normals(points)
            combing = 0.1 + 0.9 * smoothstep((points[:, 1] + 0.01) / 0.08)  # below the ears hair hangs down
            combing = np.where(length_m > 0.08, combing, 1)
            direction = combing[:, None] * (_combed(points, normal, self.roots, style) + self.stray)
            fallen = share * length_m / 0.1 * style.gravity
            direction[:, 1] -= np.minimum(fallen, 4)
            direction = direction + normal * (self.lift * (1 - share) ** 3)[:, None]
            inward = (direction * normal).sum(-1)
            touches = self.hull.height(points) < self.layer_m + 0.004
            direction = unit(direction - (np.minimum(inward, 0) * touches)[:, None] * normal)
            points = points + step * direction
            points = self._in_layer(points, shares[index + 1], length_m)
            rows.append(points)
        return np.stack(rows, 1)

    def _in_layer(self, points: np.ndarray, share: float, length_m: np.ndarray) -> np.ndarray:
        """Return points [W, 3] kept above the skin, and on the skull inside the layer of the wisp."""
        rise = np.minimum(self.layer_m, 0.6 * share * length_m)
        least = 0.6 * rise if self.style.comb != "out" else np.minimum(rise, 0.002)
        points = self.hull.lifted(points, least)
        above = np.maximum(self.hull.height(points) - self.layer_m, 0)
        hold = smoothstep((points[:, 1] - 0.03) / 0.05)
        return points - (0.6 * above * hold)[:, None] * self.hull.rays(points)


def _combed(points: np.ndarray, normals: np.ndarray, roots: np.ndarray, style: HairStyle) -> np.ndarray:
    """Combing direction [W, 3] at these points, along the skull."""
    x, y, z = points.T
    side = np.sign(roots[:, 0])
    front = smoothstep((roots[:, 2] - 0.0) / 0.05)
    if style.comb == "out":
        return 2 * normals
    if style.comb == "whorl":
        whorl = points - np.array([0.012, 0.14, -0.045])
        spin = np.stack([-whorl[:, 2], np.zeros(len(x)), whorl[:, 0]], -1)
        direction = unit(whorl + 0.35 * spin)
        direction[:, 2] -= 0.5 * (y < 0.08) * (z > 0)  # temples: downward, not in front of the face
    elif style.comb == "back":
        direction = np.stack([0.12 * side, -0.2 - 0.3 * (1 - front), -1 + 0.3 * front], -1)
    elif style.comb == "tied":
        direction = unit(np.array([0, style.knot_mm / 1000, -0.09]) - points)
    elif style.comb == "fringe":
        ahead = smoothstep((roots[:, 2] - 0.02) / 0.03) * (np.abs(roots[:, 0]) < 0.055)
        away = np.clip(x / 0.03, -1, 1)
        aside = 1 - ahead
        direction = np.stack([0.25 * ahead + away * aside, -0.6 + 0 * x, ahead - 0.15 * aside], -1)
    else:
        parting = style.parting_mm / 1000
        away = np.tanh((roots[:, 0] - parting) / 0.003)
        front_sweep = smoothstep((roots[:, 2] - 0.05) / 0.03)
        direction = np.stack([1.0 * away, -0.45 + 0 * x, -0.35 - 0.25 * front_sweep], -1)
    direction[:, 2] -= style.tuck * 1.2 * ((y < 0.075) & (z > -0.02))
    around = np.abs(np.degrees(np.arctan2(x, z)))
    if style.comb != "fringe":
        faced = np.clip((62 - around) / 10, 0, 1) * np.clip((0.09 - y) / 0.02, 0, 1)
        outward = np.stack([np.sign(x) * z, 0 * x, -np.abs(x)], -1) / np.hypot(x, z)[:, None]
        direction = direction + 1.5 * faced[:, None] * outward
    return direction - (direction * normals).sum(-1, keepdims=True) * normals


def _ragged(roots: np.ndarray, style: HairStyle, random: Random) -> np.ndarray:
    """Draw how much lower or higher the wisps [W] of a fringe end: lock by lock, and each by itself."""
    locks = roots[random.choice(len(roots), min(len(roots), _FRINGE_LOCKS), replace=False)]
    lock = cKDTree(locks).query(roots)[1]
    return _RAGGED_FRINGE_M * (random.normal(0, 1, len(locks))[lock] + random.normal(0, 0.6, len(roots)))


def _covers_face(paths: np.ndarray, style: HairStyle, ragged_m: np.ndarray) -> np.ndarray:
    """[W, rows] bool: in front of the face and below the height to which a fringe may hang."""
    x, y, z = np.moveaxis(paths, -1, 0)
    azimuth = np.abs(np.degrees(np.arctan2(x, z)))
    low = style.fringe_mm / 1000 + ragged_m[:, None] + 0.10 * np.abs(x) * (style.comb == "parted")
    return (azimuth < _FACE_DEG) & (y < low) & (y > _CHIN_M)


def _clumped(paths: np.ndarray, leader: np.ndarray, style: HairStyle, random: Random) -> np.ndarray:
    """Draw paths toward the leader of their clump, increasingly toward the tip."""
    share = _shares(style)
    pull = style.clump * random.uniform(0.3, 1, len(paths))[:, None] * share**0.8
    apart = paths[leader] - paths
    reach = np.linalg.norm(apart, axis=-1)
    pull = pull * np.exp(-((reach / 0.03) ** 2))  # no pull toward a leader that grew elsewhere
    return paths + pull[..., None] * apart


def _curled(
    paths: np.ndarray,
    normals: np.ndarray,
    length_m: np.ndarray,
    leader: np.ndarray,
    style: HairStyle,
    random: Random,
) -> np.ndarray:
    """Wind paths into helices, with some random frizz."""
    along = _tangents(paths)
    across = np.cross(along, normals)
    share = _shares(style)
    pace = random.uniform(0.8, 1.2, (len(paths), 1))[leader] / (style.wave_mm / 1000)
    turns = pace * length_m[:, None] * share
    begin = random.uniform(0, 2 * np.pi, (len(paths), 1))[leader]  # a clump curls in step
    phase = turns * 2 * np.pi + begin + random.uniform(-0.6, 0.6, (len(paths), 1))
    radius = style.curl_mm / 1000 * smoothstep(share * 4)
    wound = radius[:, None] * (np.cos(phase)[..., None] * across + 0.7 * np.sin(phase)[..., None] * normals)
    frizz = np.cumsum(random.normal(0, 1, paths.shape), 1) * share[:, None]
    return paths + wound + style.frizz_mm / 1000 / np.sqrt(paths.shape[1]) * frizz


def _tangents(paths: np.ndarray) -> np.ndarray:
    """Unit tangents [W, R, 3] of paths."""
    return unit(np.gradient(paths, axis=1))


def ribbons(
    paths: np.ndarray, normals: np.ndarray, root_normals: np.ndarray, style: HairStyle, random: Random
) -> HeadMesh:
    """Mesh paths [W, R, 3] as tapered ribbons that face outward: two vertices per row, one at the tip."""
    wisps, rows = paths.shape[:2]
    wisps = min(wisps, MAX_VERTICES // (2 * rows - 1))
    paths, normals, root_normals = paths[:wisps], normals[:wisps], root_normals[:wisps]
    along = _tangents(paths)
    across = unit(np.cross(along, normals))
    roll = random.uniform(-1.0, 1.0, (wisps, 1, 1))
    across = np.cos(roll) * across + np.sin(roll) * np.cross(along, across)
    share = _shares(style)
    taper = np.minimum(1, 0.6 + 3 * share) * (1 - share**2.5 * (0.4 if style.comb == "out" else 0.8))
    half = 0.5 * style.width_mm / 1000 * random.uniform(0.6, 1.3, (wisps, 1)) * taper
    left, right = paths - half[..., None] * across, paths + half[..., None] * across
    soft = unit(0.65 * normals + 0.35 * root_normals[:, None])
    uv = np.stack(np.broadcast_arrays(random.uniform(0, 1, (wisps, 1)), share), -1)

    def interleaved(a: np.ndarray, b: np.ndarray, tip: np.ndarray) -> np.ndarray:
        pairs = np.stack([a[:, :-1], b[:, :-1]], 2).reshape(wisps, 2 * (rows - 1), a.shape[-1])
        return np.concatenate([pairs, tip[:, -1:]], 1).reshape(-1, a.shape[-1]).astype(np.float32)

    vertices = interleaved(left, right, paths)
    return HeadMesh(
        vertices=vertices,
        normals=interleaved(soft, soft, soft),
        triangles=_ribbon_triangles(wisps, rows),
        part=np.full(len(vertices), PARTS.index("hair"), np.uint8),
        uv=interleaved(uv, uv, uv),
        tangents=interleaved(along, along, along),
        label=np.full(len(vertices), part_class("hair"), np.uint8),
    )


def _ribbon_triangles(wisps: int, rows: int) -> np.ndarray:
    """Return triangles [F, 3] of ribbons with two vertices per row and one at the tip."""
    first = np.arange(rows - 2)[:, None] * 2
    quads = np.concatenate([first + np.array([0, 1, 2]), first + np.array([1, 3, 2])])
    strip = np.concatenate([quads, [[2 * rows - 4, 2 * rows - 3, 2 * rows - 2]]])
    return (strip + np.arange(wisps)[:, None, None] * (2 * rows - 1)).reshape(-1, 3).astype(np.int64)


def grow_beard(head: HeadMesh, traits: dict[str, float | str | bool], random: Random) -> HeadMesh | None:
    """Grow the beard and moustache that the traits of a person describe; None if there is none."""
    beard, moustache = float(traits["beard"]), float(traits["moustache"])
    if max(beard, moustache) < _LEAST_COVER:
        return None
    faces = head.faces_of("skin")
    uv = head.uv[faces].mean(1).astype(float)
    corners = head.vertices[faces].astype(float)
    place = ((uv - CANVAS_SPAN[0]) / (CANVAS_SPAN[1] - CANVAS_SPAN[0]) * 256).astype(int).clip(0, 255)
    centre = corners.mean(1)
    on_lip = (uv[:, 1] < _MOUTH_V) & (np.abs(centre[:, 0]) < _LIP_M)
    cover = np.where(on_lip, moustache, beard)
    if float(traits["goatee"]):
        cover = cover * smoothstep(0.042 - np.abs(centre[:, 0]), 0, 0.012)
    density = beard_density(Window(256, CANVAS_SPAN))[0, 0].numpy()
    chance = doubled_areas(corners) * density[place[:, 1], place[:, 0]] ** 1.3 * cover
    if chance.sum() <= 0:
        return None
    count = int(_WISPS * max(beard, 0.35 * moustache))
    roots, normals, chosen = drawn_places(head, faces, chance, count, random)
    longest = random.uniform(0.004, 0.03) * max(beard, 0.3)
    chin = 0.5 + 0.5 * smoothstep(-roots[:, 1], 0.03, 0.08)
    length = np.where(on_lip[chosen], min(longest, 0.009), longest * chin) * random.uniform(0.5, 1.1, count)
    return _labelled(_grown(head, roots, normals, length, random), "beard")


def _grown(
    head: HeadMesh, roots: np.ndarray, normals: np.ndarray, length_m: np.ndarray, random: Random
) -> HeadMesh:
    """Grow wisps down along the skin, a little outward."""
    hull = hull_of(head)
    aside = np.sign(roots[:, 0]) * smoothstep(np.abs(roots[:, 0]), 0.0, 0.03) * 0.25
    down = np.stack([aside, -np.ones(len(roots)), 0.15 + 0 * aside], -1)
    stray = random.normal(0, 0.22, roots.shape)
    points, rows = roots - 0.0006 * normals, [roots - 0.0006 * normals]
    for step in range(_BEARD.segments):
        out = 0.75 * (1 - step / _BEARD.segments)
        direction = unit(down + stray + out * normals)
        points = points + length_m[:, None] / _BEARD.segments * direction
        points = hull.lifted(points, 0.0) if step else points
        rows.append(points)
    paths = np.stack(rows, 1)
    return ribbons(paths, np.broadcast_to(normals[:, None], paths.shape), normals, _BEARD, random)


def grow_lashes(landmarks_m: np.ndarray, random: Random) -> HeadMesh:
    """Grow lashes along the lids between landmarks [68, 3], curved away from the eye."""
    paths = []
    for ids, count in _LIDS:
        along = np.sort(random.uniform(0.06, 0.97, count))
        lid = CubicSpline(np.linspace(0, 1, 4), landmarks_m[list(ids)])(along)
        eye = landmarks_m[36:42] if ids[0] < 42 else landmarks_m[42:48]
        away = unit((lid - eye.mean(0)) * [1.0, 0.6, 0.0])
        opening = float(np.linalg.norm(eye[[1, 2]].mean(0) - eye[[4, 5]].mean(0)))
        upward = 1.8 * float(smoothstep(np.array(opening), 0.002, 0.007)) - 0.8 if count == 110 else -1.0
        share = np.linspace(0, 1, _LASHES.segments + 1)[:, None, None]
        length = _LASH_M[count] * random.uniform(0.6, 1.1, (count, 1))
        ahead, rise = np.array([0, 0, 1.0]), np.array([0, upward, 0])
        bent = ahead * (share - 0.35 * share**2) + rise * (0.25 * share + 0.5 * share**2) + 0.3 * share * away
        paths.append(np.moveaxis(lid + length * bent + random.normal(0, 2e-4, lid.shape) * share, 0, 1))
    whole = np.concatenate(paths)
    normals = np.broadcast_to([0.0, 0.0, 1.0], whole.shape)
    return _labelled(ribbons(whole, normals, normals[:, 0], _LASHES, random), "eyes")


def _labelled(strands: HeadMesh, name: str) -> HeadMesh:
    strands.label[:] = class_index(name)
    return strands
