"""Hair: thousands of tapered ribbons, a wisp each, rooted on the scalp and combed over the head.

A wisp grows from its root in equal steps. Each step follows the style's combing, and gravity the more the
farther from the root, slides along the head's hull where it touches, and keeps to the wisp's own layer above
it; then the wisps of a clump draw together toward their tips, and curl. A wisp that comes before the face is
grown anew, shorter. Heights and azimuths are those of the canonical chart's frame (`face.topology`).
"""

import numpy as np
from scipy.spatial import cKDTree

from facerf_cli.synth.head.cranium import Hull, hull_of
from facerf_cli.synth.head.hair_styles import HairStyle, draw_style
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, scalp_margin_m, smoothstep, unit

MAX_VERTICES = 250_000

_FACE_DEG = 50.0  # within this azimuth and below the fringe there is face
_CHIN_M = -0.13
_RAGGED_M = 0.002  # unrest of the hairline
_ROWS_LEFT = 1e-4  # shortest step of a wisp, metres


def draw_hair(head: HeadMesh, random: np.random.Generator) -> tuple[HeadMesh | None, HairStyle]:
    """Draw a style and grow it on a head, which may wear clothes: long hair falls over them."""
    style = draw_style(random)
    hair = grow_hair(head, style, random)
    return hair if len(hair.vertices) else None, style


def grow_hair(head: HeadMesh, style: HairStyle, random: np.random.Generator) -> HeadMesh:
    """The hair alone, as part "hair"; without a vertex if there is none.

    normals: a soft volume's, not the ribbons'; uv: the wisp's random number, and root (0) to tip (1).
    """
    roots, root_normals, margin = _roots(head, style, random)
    if not len(roots):
        none = np.zeros((0, style.segments + 1, 3))
        return _ribbons(none, none, none[:, 0], style, random)
    hull = hull_of(head)
    length = _lengths(roots, margin, style, random)
    wisps = _Wisps(roots, root_normals, style, hull, random)
    paths = wisps.grow(length)
    before = _before_face(paths, style)
    first = np.where(before.any(1), before.argmax(1), style.segments + 1)
    last = np.maximum(first - 0.7, 0.3) / style.segments
    length = length * np.where(before.any(1), last**style.crowding, 1)
    paths = wisps.grow(length)
    leader = _leaders(roots, style, random)
    paths = _clumped(paths, leader, style, random)
    normals = hull.normals(paths)
    paths = _curled(paths, normals, length, leader, style, random)
    paths = hull.lifted(paths, np.minimum(0.0008, 0.02 * np.linspace(0, 1, paths.shape[1])))
    paths[:, 0] = roots - 0.001 * root_normals
    keep = ~_before_face(paths, style).any(1)
    return _ribbons(paths[keep], normals[keep], root_normals[keep], style, random)


def _roots(
    head: HeadMesh, style: HairStyle, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Roots [W, 3], the skin's normals there [W, 3], and how far above the hairline they lie [W]."""
    triangles = head.triangles[head.part[head.triangles[:, 0]] == PARTS.index("skin")]
    corners = head.vertices[triangles].astype(float)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    centre = corners.mean(1)
    margin = scalp_margin_m(centre, style)
    ragged = margin + random.normal(0, _RAGGED_M, len(margin))
    chance = area * np.clip(ragged / 0.007 + 0.25, 0, 1) ** 1.5
    chance = chance * (1 - style.thinning * _bare_top(centre))
    if style.comb == "parted":  # all roots show there, so it takes more of them
        chance = chance * (1 + 3 * np.exp(-(((centre[:, 0] - style.parting_mm / 1000) / 0.008) ** 2)))
    if not style.wisps or not chance.any():
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    chosen = random.choice(len(triangles), style.wisps, p=chance / chance.sum())
    weights = random.dirichlet([1, 1, 1], style.wisps)[..., None]
    normals = (head.normals[triangles[chosen]] * weights).sum(1)
    normals = unit(normals)
    return (corners[chosen] * weights).sum(1), normals, margin[chosen]


def _bare_top(points: np.ndarray) -> np.ndarray:
    """Where hair thins with age [N], 0..1: the crown and what lies before it."""
    crown = np.array([0, 0.145, -0.01])
    distance = np.linalg.norm((points - crown) * [1, 1, 0.8], axis=-1)
    return 0.97 * np.clip((0.075 - distance) / 0.025, 0, 1)


def _lengths(
    roots: np.ndarray, margin: np.ndarray, style: HairStyle, random: np.random.Generator
) -> np.ndarray:
    top = smoothstep((roots[:, 1] - 0.055) / 0.05)
    length = style.side_mm + (style.top_mm - style.side_mm) * top
    edge = style.edge + (1 - style.edge) * smoothstep(margin / 0.02)
    return length * edge * random.uniform(0.75, 1.08, len(roots)) / 1000


def _shares(style: HairStyle) -> np.ndarray:
    """How far along the wisp each of its rows lies [segments + 1]."""
    return np.linspace(0, 1, style.segments + 1) ** style.crowding


class _Wisps:
    """What stays the same while the wisps are grown a second time."""

    def __init__(
        self,
        roots: np.ndarray,
        normals: np.ndarray,
        style: HairStyle,
        hull: Hull,
        random: np.random.Generator,
    ) -> None:
        self.roots, self.normals, self.style, self.hull = roots, normals, style, hull
        count = len(roots)
        self.layer_m = style.layer_mm / 1000 * random.uniform(0.15, 1, count) ** 0.7
        self.stray = random.normal(0, style.stray, (count, 3))
        self.lift = style.lift * random.uniform(0.6, 1.3, count)

    def grow(self, length_m: np.ndarray) -> np.ndarray:
        """Paths [W, segments + 1, 3] of wisps of these lengths [W]."""
        style, steps = self.style, self.style.segments
        points, rows = self.roots, [self.roots]
        shares = _shares(style)
        for index in range(steps):
            share = shares[index]
            step = np.maximum(length_m * (shares[index + 1] - share), _ROWS_LEFT)[:, None]
            normal = self.normals if index == 0 else self.hull.normals(points)
            held = 0.1 + 0.9 * smoothstep((points[:, 1] + 0.01) / 0.08)  # below the ears hair just hangs
            held = np.where(length_m > 0.08, held, 1)
            way = held[:, None] * (_combed(points, normal, self.roots, style) + self.stray)
            fallen = share * length_m / 0.1 * style.gravity
            way[:, 1] -= np.minimum(fallen, 4)
            way = way + normal * (self.lift * (1 - share) ** 3)[:, None]
            inward = (way * normal).sum(-1)
            touches = self.hull.height(points) < self.layer_m + 0.004
            way = way - (np.minimum(inward, 0) * touches)[:, None] * normal
            way = unit(way)
            points = points + step * way
            points = self._in_layer(points, shares[index + 1], length_m)
            rows.append(points)
        return np.stack(rows, 1)

    def _in_layer(self, points: np.ndarray, share: float, length_m: np.ndarray) -> np.ndarray:
        """Kept above the skin, and on the skull down to the wisp's own layer."""
        rise = np.minimum(self.layer_m, 0.6 * share * length_m)
        least = 0.6 * rise if self.style.comb != "out" else np.minimum(rise, 0.002)
        points = self.hull.lifted(points, least)
        above = np.maximum(self.hull.height(points) - self.layer_m, 0)
        hold = smoothstep((points[:, 1] - 0.03) / 0.05)
        return points - (0.6 * above * hold)[:, None] * self.hull.rays(points)


def _combed(points: np.ndarray, normals: np.ndarray, roots: np.ndarray, style: HairStyle) -> np.ndarray:
    """The way [W, 3] hair is combed at these points, along the skull."""
    x, y, z = points.T
    side = np.sign(roots[:, 0])
    front = smoothstep((roots[:, 2] - 0.0) / 0.05)
    if style.comb == "out":
        return 2 * normals
    if style.comb == "whorl":
        whorl = points - np.array([0.012, 0.14, -0.045])
        spin = np.stack([-whorl[:, 2], np.zeros(len(x)), whorl[:, 0]], -1)
        way = whorl + 0.35 * spin
        way = unit(way)
        way[:, 2] -= 0.5 * (y < 0.08) * (z > 0)  # temples: downward, not before the face
    elif style.comb == "back":
        way = np.stack([0.12 * side, -0.2 - 0.3 * (1 - front), -1 + 0.3 * front], -1)
    elif style.comb == "fringe":
        ahead = smoothstep((roots[:, 2] - 0.02) / 0.03) * (np.abs(roots[:, 0]) < 0.055)
        away = np.clip(x / 0.03, -1, 1)
        aside = 1 - ahead
        way = np.stack([0.25 * ahead + away * aside, -0.6 + 0 * x, ahead - 0.15 * aside], -1)
    else:
        parting = style.parting_mm / 1000
        away = np.tanh((roots[:, 0] - parting) / 0.003)
        front_sweep = smoothstep((roots[:, 2] - 0.05) / 0.03)
        way = np.stack([1.0 * away, -0.45 + 0 * x, -0.35 - 0.25 * front_sweep], -1)
    way[:, 2] -= style.tuck * 1.2 * ((y < 0.075) & (z > -0.02))
    around = np.abs(np.degrees(np.arctan2(x, z)))
    if style.comb != "fringe":
        faced = np.clip((62 - around) / 10, 0, 1) * np.clip((0.09 - y) / 0.02, 0, 1)
        outward = np.stack([np.sign(x) * z, 0 * x, -np.abs(x)], -1) / np.hypot(x, z)[:, None]
        way = way + 1.5 * faced[:, None] * outward
    return way - (way * normals).sum(-1, keepdims=True) * normals


def _before_face(paths: np.ndarray, style: HairStyle) -> np.ndarray:
    """[W, rows] bool: before the face, where only a fringe may hang, and only so low."""
    x, y, z = np.moveaxis(paths, -1, 0)
    azimuth = np.abs(np.degrees(np.arctan2(x, z)))
    low = style.fringe_mm / 1000 + 0.10 * np.abs(x) * (style.comb == "parted")
    return (azimuth < _FACE_DEG) & (y < low) & (y > _CHIN_M)


def _leaders(roots: np.ndarray, style: HairStyle, random: np.random.Generator) -> np.ndarray:
    """The wisp [W] that leads each wisp's clump: the nearest one on the scalp."""
    leaders = random.choice(len(roots), max(1, len(roots) // style.clump_wisps), replace=False)
    return leaders[cKDTree(roots[leaders]).query(roots)[1]]


def _clumped(
    paths: np.ndarray, leader: np.ndarray, style: HairStyle, random: np.random.Generator
) -> np.ndarray:
    """Wisps drawn toward their clump's leader, the more the nearer the tip."""
    share = _shares(style)
    pull = style.clump * random.uniform(0.3, 1, len(paths))[:, None] * share**0.8
    apart = paths[leader] - paths
    reach = np.linalg.norm(apart, axis=-1)
    pull = pull * np.exp(-((reach / 0.03) ** 2))  # a leader that went elsewhere is left alone
    return paths + pull[..., None] * apart


def _curled(
    paths: np.ndarray,
    normals: np.ndarray,
    length_m: np.ndarray,
    leader: np.ndarray,
    style: HairStyle,
    random: np.random.Generator,
) -> np.ndarray:
    """Each path wound into a helix about itself, with some of its own unrest."""
    along = _tangents(paths)
    across = np.cross(along, normals)
    share = _shares(style)
    pace = random.uniform(0.8, 1.2, (len(paths), 1))[leader] / (style.wave_mm / 1000)
    turns = pace * length_m[:, None] * share
    begin = random.uniform(0, 2 * np.pi, (len(paths), 1))[leader]  # a clump curls in step
    phase = turns * 2 * np.pi + begin + random.uniform(-0.6, 0.6, (len(paths), 1))
    radius = style.curl_mm / 1000 * smoothstep(share * 4)
    wound = radius[:, None] * (np.cos(phase)[..., None] * across + 0.7 * np.sin(phase)[..., None] * normals)
    unrest = np.cumsum(random.normal(0, 1, paths.shape), 1) * share[:, None]
    return paths + wound + style.frizz_mm / 1000 / np.sqrt(paths.shape[1]) * unrest


def _tangents(paths: np.ndarray) -> np.ndarray:
    along = np.gradient(paths, axis=1)
    return unit(along)


def _ribbons(
    paths: np.ndarray,
    normals: np.ndarray,
    root_normals: np.ndarray,
    style: HairStyle,
    random: np.random.Generator,
) -> HeadMesh:
    """Paths [W, R, 3] as tapered ribbons, two vertices a row and one at the tip, facing outward."""
    wisps, rows = paths.shape[:2]
    wisps = min(wisps, MAX_VERTICES // (2 * rows - 1))
    paths, normals, root_normals = paths[:wisps], normals[:wisps], root_normals[:wisps]
    along = _tangents(paths)
    across = np.cross(along, normals)
    across = unit(across)
    roll = random.uniform(-1.0, 1.0, (wisps, 1, 1))
    across = np.cos(roll) * across + np.sin(roll) * np.cross(along, across)
    share = _shares(style)
    taper = np.minimum(1, 0.6 + 3 * share) * (1 - share**2.5 * (0.4 if style.comb == "out" else 0.8))
    half = 0.5 * style.width_mm / 1000 * random.uniform(0.6, 1.3, (wisps, 1)) * taper
    left, right = paths - half[..., None] * across, paths + half[..., None] * across
    soft = 0.65 * normals + 0.35 * root_normals[:, None]
    soft = unit(soft)
    uv = np.stack(np.broadcast_arrays(random.uniform(0, 1, (wisps, 1)), share), -1)

    def woven(a: np.ndarray, b: np.ndarray, tip: np.ndarray) -> np.ndarray:
        pairs = np.stack([a[:, :-1], b[:, :-1]], 2).reshape(wisps, 2 * (rows - 1), a.shape[-1])
        return np.concatenate([pairs, tip[:, -1:]], 1).reshape(-1, a.shape[-1]).astype(np.float32)

    first = np.arange(rows - 2)[:, None] * 2
    quads = np.concatenate([first + np.array([0, 1, 2]), first + np.array([1, 3, 2])])
    strip = np.concatenate([quads, [[2 * rows - 4, 2 * rows - 3, 2 * rows - 2]]])
    triangles = (strip + np.arange(wisps)[:, None, None] * (2 * rows - 1)).reshape(-1, 3).astype(np.int64)
    vertices = woven(left, right, paths)
    return HeadMesh(
        vertices=vertices,
        normals=woven(soft, soft, soft),
        triangles=triangles,
        part=np.full(len(vertices), PARTS.index("hair"), np.uint8),
        uv=woven(uv, uv, uv),
        tangents=woven(along, along, along),
    )
