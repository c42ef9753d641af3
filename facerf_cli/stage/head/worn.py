"""What a synthetic head wears besides hair: glasses, and a garment about neck and shoulders.

Both are measured on the head itself. Glasses: rims before the eyes, as near as nose, brows and cheeks let
them, a bridge over the nose, and temples along the head to the ears. Clothes: rings about the neck, lofted
down and out to the shoulders, kept off the skin.
"""

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from facerf_cli.face.topology import LANDMARK_UV
from facerf_cli.raster.texture import vertex_normals
from facerf_cli.stage.head.hull import Hull, hull_of
from facerf_cli.stage.head.mesh import PARTS, HeadMesh, joined
from facerf_cli.stage.head.vectors import unit

GLASSES = ("round", "rectangular", "square", "aviator", "half-rim")
GARMENTS = ("crew neck", "v-neck", "wide neck", "turtleneck", "shirt")

_EYES = ((36, 39), (42, 45))  # corners
_NOSE_ROOT, _NOSE_BRIDGE, _CHIN = 27, 28, 8
_GAP_M = 0.0012  # between a frame and the skin
_NEAR_M = 0.003  # how far around a point skin is looked for
_TUBE = 10  # vertices around a tube

_AROUND = 144  # vertices around the neck
_CUT_M = 0.16  # below the chin
_LOWEST_CHIN_M = -0.085
_OFF_SKIN_M = 0.004  # of cloth
_BANDS_M = {"turtleneck": 0.045, "shirt": 0.006}  # height of the neckline's band, where it is fixed
_FLARE_M = 0.012  # how much wider than its narrowest a neck still is a neck
_BELOW_M = -0.06  # height under which cloth may touch skin
_ASIDE_M = 0.008  # of cloth that still lies over a vertex of the skin


def draw_glasses(head: HeadMesh, landmarks_m: np.ndarray, random: np.random.Generator) -> HeadMesh:
    """Glasses without lenses, as part "frame", for a bare head with these landmarks [68, 3]."""
    kind = str(random.choice(GLASSES))
    metal = kind == "aviator" or random.random() < 0.4
    depth = random.uniform(0.0008, 0.0012) if metal else random.uniform(0.0013, 0.0019)  # half of it
    width = random.uniform(0.0007, 0.0011) if metal else random.uniform(0.0012, 0.0026)
    face = _Face(head)
    rims = _rims(kind, landmarks_m, random)
    rims = _settled(rims, face, landmarks_m, depth + _GAP_M)
    parts = []
    for rim in rims:
        shown = rim if kind != "half-rim" else _upper(rim)
        parts.append(_tube(shown, np.array([0, 0, 1.0]), width, depth, closed=kind != "half-rim"))
    parts.append(_bridge(rims, face, width, depth, 0.15))
    if kind == "aviator":
        parts.append(_bridge(rims, face, width, depth, 0.75))
    high = width if metal else random.uniform(0.0018, 0.004)
    parts += [_temple(rim, face, depth, high) for rim in rims]
    return joined(*parts)


class _Face:
    """Where skin and eyes of a head lie, asked along one axis."""

    def __init__(self, head: HeadMesh) -> None:
        outer = np.isin(head.part, [PARTS.index("skin"), PARTS.index("eye")])
        self.points = head.vertices[outer].astype(float)
        front = self.points[self.points[:, 2] > 0.02]
        self._front, self._front_z = cKDTree(front[:, :2]), front[:, 2]
        self._sides = {}
        for side in (-1, 1):
            flank = self.points[self.points[:, 0] * side > 0.03]
            self._sides[side] = cKDTree(flank[:, 1:]), flank[:, 0] * side

    def front(self, points: np.ndarray) -> np.ndarray:
        """z [N] of the foremost skin at (x, y) of points [N, 3]."""
        return _greatest(self._front, self._front_z, points[:, :2])

    def flank(self, points: np.ndarray, side: int) -> np.ndarray:
        """|x| [N] of the outermost skin at (y, z) of points [N, 3], on the side of x's sign."""
        return _greatest(*self._sides[side], points[:, 1:])

    def ear_top(self, side: int) -> tuple[float, float]:
        """(y, z) just above the ear: the first height from the temple down where the head juts out."""
        heights = np.arange(0.062, 0.015, -0.002)
        z = np.arange(-0.015, 0.026, 0.003)
        points = np.stack(np.broadcast_arrays(0, heights[:, None], z), -1).reshape(-1, 3)
        out = self.flank(points, side).reshape(len(heights), len(z))
        juts = out > out[0].max() + 0.005
        if not juts.any():
            return 0.04, 0.0
        row = int(juts.any(1).argmax())
        return float(heights[row]) + 0.003, float(z[juts[row]].mean())


def _greatest(tree: cKDTree, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The greatest of `values` within `_NEAR_M` of each place [N, 2], or else the nearest one's."""
    _, nearest = tree.query(at)
    return np.array(
        [
            values[near].max() if near else values[one]
            for near, one in zip(tree.query_ball_point(at, _NEAR_M), nearest, strict=True)
        ]
    )


def _rims(kind: str, landmarks_m: np.ndarray, random: np.random.Generator) -> list[np.ndarray]:
    """Outlines [64, 3] of both lenses, the picture's left one first; from the inner end over the top."""
    size = random.uniform(0.92, 1.08)
    half_width, half_height, power = {
        "round": (0.0225, 0.0215, 2.0),
        "rectangular": (0.0265, 0.0165, 4.5),
        "square": (0.0260, 0.0205, 3.6),
        "aviator": (0.0275, 0.0230, 2.5),
        "half-rim": (0.0260, 0.0165, 3.2),
    }[kind]
    span = abs(landmarks_m[45, 0] - landmarks_m[36, 0]) / 0.089  # of this face to the mean one
    half_width, half_height = half_width * size * span, half_height * size * random.uniform(0.95, 1.1)
    centres = [landmarks_m[list(pair)].mean(0) for pair in _EYES]
    apart = np.abs([centre[0] for centre in centres]).mean()
    apart = max(apart, half_width + 0.0085)  # room for the nose
    height = np.mean([centre[1] for centre in centres]) - random.uniform(0.001, 0.004)
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    cos, sin = np.cos(turn), np.sin(turn)
    x = -np.sign(cos) * np.abs(cos) ** (2 / power)  # from the nose, which lies at -x of the right rim
    y = np.sign(sin) * np.abs(sin) ** (2 / power)
    if kind == "aviator":  # a drop that hangs outward
        x = x * (1 - 0.12 * (y < 0) * np.abs(y)) + 0.10 * np.minimum(y, 0) * -1
        y = np.where(y < 0, 1.15 * y, 0.9 * y)
    x = apart + half_width * x
    y = half_height * y
    wrap, tilt = random.uniform(1.2, 2.4), np.tan(np.radians(random.uniform(3, 10)))
    z = -wrap * x**2 + tilt * y
    return [np.stack([side * x, y + height, z], -1) for side in (-1, 1)]


def _settled(
    rims: list[np.ndarray], face: _Face, landmarks_m: np.ndarray, clear_m: float
) -> list[np.ndarray]:
    """Rims brought before the face: as near as skin, lids and the nose's bridge let them."""
    need = max(float((face.front(rim) + clear_m - rim[:, 2]).max()) for rim in rims)
    eyes = landmarks_m[np.arange(36, 48), 2].max() + 0.009  # room for the lashes
    need = max(need, eyes - float(np.mean([rim[:, 2].mean() for rim in rims])))
    return [rim + np.array([0, 0, need]) for rim in rims]


def _upper(rim: np.ndarray) -> np.ndarray:
    """The half of a rim that a half-rim has: its upper part, and a little down both sides."""
    order = np.roll(rim, 4, 0)
    return order[: len(rim) // 2 + 8]


def _bridge(rims: list[np.ndarray], face: _Face, width: float, depth: float, level: float) -> HeadMesh:
    """From rim to rim over the nose, `level` (0..1) of the way from the rim's middle to its top."""
    ends = []
    for rim in rims:
        inner = rim[np.argsort(np.abs(rim[:, 0]))[: len(rim) // 3]]
        height = rim[:, 1].mean() + level * np.ptp(rim[:, 1]) / 2
        ends.append(inner[np.argmin(np.abs(inner[:, 1] - height))])
    share = np.linspace(0, 1, 21)[:, None]
    path = ends[0] + (ends[1] - ends[0]) * share
    arch = 4 * share[:, 0] * (1 - share[:, 0])
    path[:, 1] += 0.003 * arch
    path[:, 2] += 0.002 * arch
    path[:, 2] = np.maximum(path[:, 2], face.front(path) + depth + _GAP_M)
    path[1:-1, 2] = (path[:-2, 2] + 2 * path[1:-1, 2] + path[2:, 2]) / 4
    path[:, 2] += np.maximum(face.front(path) + depth + 0.5 * _GAP_M - path[:, 2], 0).max() * arch**0.25
    return _tube(path, np.array([0, 0, 1.0]), width, depth, closed=False)


def _temple(rim: np.ndarray, face: _Face, thick: float, high: float) -> HeadMesh:
    """From a rim's outer end along the head to the ear, over it and a little on."""
    side = int(np.sign(rim[:, 0].mean()))
    outer = rim[np.argsort(-np.abs(rim[:, 0]))[:20]]
    level = rim[:, 1].mean() + 0.35 * np.ptp(rim[:, 1]) / 2
    hinge = outer[np.argmin(np.abs(outer[:, 1] - level))]
    ear_y, ear_z = face.ear_top(side)
    top = np.array([hinge[0], ear_y + high, ear_z])
    end = np.array([hinge[0], ear_y + high - 0.004, ear_z - 0.022])
    corner = hinge + np.array([side * 0.004, 0, -0.006])
    far = np.linspace(0, 1, 22)[1:, None]
    path = np.concatenate(
        [hinge[None], corner[None], corner + (top - corner) * far, top + (end - top) * far[6::7]]
    )
    out = np.maximum(face.flank(path, side) + thick + _GAP_M, 0)
    out[:2] = np.maximum(out[:2], np.abs(path[:2, 0]))
    reach = np.abs(corner[0])
    behind = np.clip((corner[2] - path[:, 2]) / (corner[2] - ear_z), 0, 1)
    ear_out = out[-4]
    out = np.maximum(out, np.maximum(reach + (ear_out - reach) * behind, 0))
    path[:, 0] = side * out
    path[1:-1, 0] = np.maximum(np.abs(path[1:-1, 0]), np.abs(path[:-2, 0] + path[2:, 0]) / 2) * side
    return _tube(path, np.array([0, 1.0, 0]), thick, high, closed=False)


def _tube(path: np.ndarray, up: np.ndarray, across_m: float, up_m: float, closed: bool) -> HeadMesh:
    """A rounded bar along `path` [N, 3], half as thick as `up_m` along `up` and as `across_m` across it."""
    count = len(path)
    along = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    along = unit(along)
    aside = np.cross(up, along)
    aside = unit(aside)
    over = np.cross(along, aside)
    turn = np.linspace(0, 2 * np.pi, _TUBE, endpoint=False)
    cos, sin = np.cos(turn), np.sin(turn)
    square = 2 / 3.0  # a superellipse: flat sides, round edges
    a = (np.sign(cos) * np.abs(cos) ** square)[None, :, None]
    b = (np.sign(sin) * np.abs(sin) ** square)[None, :, None]
    offset = across_m * a * aside[:, None] + up_m * b * over[:, None]
    normal = a * aside[:, None] / across_m + b * over[:, None] / up_m
    vertices = path[:, None] + offset
    uv = np.stack(
        np.broadcast_arrays(np.linspace(0, 1, count)[:, None], np.linspace(0, 1, _TUBE)[None, :]), -1
    )
    rings = np.arange(count if closed else count - 1)
    here = rings[:, None] * _TUBE + np.arange(_TUBE)
    ahead = (rings[:, None] + 1) % count * _TUBE + np.arange(_TUBE)
    here_on, ahead_on = np.roll(here, -1, 1), np.roll(ahead, -1, 1)
    triangles = [np.stack([here, here_on, ahead], -1), np.stack([here_on, ahead_on, ahead], -1)]
    faces = np.concatenate([t.reshape(-1, 3) for t in triangles])
    if not closed:
        fan = np.stack(np.broadcast_arrays(0, np.arange(1, _TUBE - 1), np.arange(2, _TUBE)), -1)
        faces = np.concatenate([faces, fan[:, ::-1], fan + (count - 1) * _TUBE])
    return _plain("frame", vertices.reshape(-1, 3), normal.reshape(-1, 3), faces, uv.reshape(-1, 2))


def draw_clothes(head: HeadMesh, random: np.random.Generator) -> HeadMesh:
    """A garment from the neck to the shoulders, as part "cloth", for a bare head."""
    kind = str(random.choice(GARMENTS))
    hull, skin = hull_of(head), _Skin(head)
    azimuth = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    collar = _collar_line(kind, azimuth, _chin_m(head), random)
    collar = _on_neck(hull, azimuth, collar, _BANDS_M.get(kind, 0.01))
    garment = _body(kind, hull, skin, azimuth, collar, _chin_m(head) - _CUT_M, random)
    if kind != "shirt":
        return garment
    return joined(garment, _lapels(hull, skin, azimuth, collar, random))


def _chin_m(head: HeadMesh) -> float:
    """Height of the chin's underside, at most so low: an open mouth takes no garment with it."""
    skin = head.part == PARTS.index("skin")
    nearest = np.linalg.norm(head.uv[skin] - LANDMARK_UV[_CHIN], axis=-1).argmin()
    return max(float(head.vertices[skin][nearest, 1]) - 0.003, _LOWEST_CHIN_M)


def _collar_line(kind: str, azimuth: np.ndarray, chin: float, random: np.random.Generator) -> np.ndarray:
    """Height [N] of the neckline around the neck; lower before than behind."""
    front = (1 + np.cos(azimuth)) / 2
    depth, slope = {
        "crew neck": (0.036, 0.028),
        "v-neck": (0.036, 0.026),
        "wide neck": (0.044, 0.026),
        "turtleneck": (0.022, 0.012),
        "shirt": (0.034, 0.024),
    }[kind]
    line = chin - depth * random.uniform(0.9, 1.15) + slope * (1 - front) ** 0.8
    if kind == "v-neck":
        off = np.abs((azimuth + np.pi) % (2 * np.pi) - np.pi)
        line -= random.uniform(0.025, 0.045) * np.clip(1 - off / 0.75, 0, 1)
    return line


def _on_neck(hull: Hull, azimuth: np.ndarray, line: np.ndarray, band: float) -> np.ndarray:
    """The neckline [N], raised where the foot of its band would lie on the shoulders of a short neck."""
    levels = line + np.arange(0, 0.06, 0.003)[:, None]
    radius = np.stack([_radius(hull, azimuth, level - band) for level in levels])
    slender = radius < radius.min(0) + _FLARE_M
    raised = np.take_along_axis(levels, slender.argmax(0)[None], 0)[0]
    return gaussian_filter1d(raised - line, 5, mode="wrap") + line


def _body(
    kind: str,
    hull: Hull,
    skin: "_Skin",
    azimuth: np.ndarray,
    collar: np.ndarray,
    bottom: float,
    random: np.random.Generator,
) -> HeadMesh:
    """Rings from inside the neckline over its band down to the shoulders, and straight down to the cut."""
    neck = _radius(hull, azimuth, collar) + _OFF_SKIN_M + (0.012 if kind == "wide neck" else 0)
    band = _BANDS_M.get(kind, random.uniform(0.010, 0.02))
    thick = 0.006 if kind == "turtleneck" else 0.0025
    rows = [(neck - 0.0025, collar - 0.012), (neck - 0.002, collar - 0.003), (neck, collar)]
    rows += [(neck + thick, collar - 0.0025)]
    for share in (0.35, 0.7, 1.0):
        level = collar - band * share * (1 if kind == "turtleneck" else 0.75)
        level = (
            np.maximum(level, collar - band) if kind != "turtleneck" else np.minimum(level, collar - 0.003)
        )
        rows.append((_radius(hull, azimuth, level) + _OFF_SKIN_M + thick + 0.002 * share, level))
    start_radius, start = rows[-1]
    start_radius = np.maximum(start_radius, neck + thick) - (0.0025 if kind != "turtleneck" else 0.006)

    wide = random.uniform(0.195, 0.225)
    deep = np.where(np.cos(azimuth) > 0, random.uniform(0.10, 0.12), random.uniform(0.105, 0.12))
    outline = (np.abs(np.sin(azimuth) / wide) ** 2.6 + np.abs(np.cos(azimuth) / deep) ** 2.6) ** (-1 / 2.6)
    outline = np.maximum(outline, start_radius + 0.012)
    aside = np.sin(azimuth) ** 2
    fall = random.uniform(0.24, 0.38)  # of the shoulders, height by width
    sloped = fall * (outline - start_radius) * aside
    drop = np.maximum(start - sloped - bottom, 0.02)
    for share in np.linspace(0, 1, 34)[1:]:
        quarter = share * np.pi / 2
        out = (1 - aside) * share**0.75 + aside * np.sin(quarter)
        down = (1 - aside) * share + aside * (1 - np.cos(quarter)) ** 1.4
        radius = start_radius + (outline - start_radius) * out
        rows.append((radius, start - sloped * out - drop * down))
    rings = np.stack([_ring(hull, azimuth, radius, level) for radius, level in rows])
    band_rows = len(rows) - 33
    rings[band_rows:] += _folds(rings[band_rows:], azimuth, random)
    rings[3:] = skin.lifted(rings[3:])
    return _loft("cloth", rings, closed=True)


def _radius(hull: Hull, azimuth: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Horizontal distance [N] from the hull's axis to its surface at azimuths and heights [N]."""
    return 1.0 - hull.height(_ring(hull, azimuth, np.ones(len(azimuth)), level))


def _ring(hull: Hull, azimuth: np.ndarray, radius: np.ndarray, level: np.ndarray) -> np.ndarray:
    x, z = radius * np.sin(azimuth), radius * np.cos(azimuth) + hull.middle[2]
    return np.stack([x, np.broadcast_to(level, x.shape), z], -1)


def _folds(rings: np.ndarray, azimuth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Offsets [rows, N, 3] of soft folds, from the neckline outward ever larger."""
    share = np.linspace(0, 1, len(rings))[:, None]
    wave = np.zeros(rings.shape[:2])
    for _ in range(7):
        around, down = random.integers(3, 14), random.uniform(-9, 9)
        phase = around * azimuth + down * share + random.uniform(0, 2 * np.pi)
        phase = phase + 1.3 * np.sin(random.integers(1, 4) * azimuth + random.uniform(-4, 4) * share)
        wave += random.uniform(0.2, 1) * (1 - 2 * np.abs(np.sin(phase / 2)) ** 0.8)
    height = random.uniform(0.0008, 0.0024) * np.minimum(share * 3, 1) * wave
    return height[..., None] * _ring_normals(rings)


def _ring_normals(rings: np.ndarray) -> np.ndarray:
    around = np.roll(rings, -1, 1) - np.roll(rings, 1, 1)
    down = np.gradient(rings, axis=0)
    normal = np.cross(down, around)
    return unit(normal)


class _Skin:
    """The skin of a head below its chin, which cloth must not come nearer to than `_OFF_SKIN_M`."""

    def __init__(self, head: HeadMesh) -> None:
        low = (head.part == PARTS.index("skin")) & (head.vertices[:, 1] < _BELOW_M)
        self.points, self.normals = head.vertices[low].astype(float), head.normals[low].astype(float)
        self._tree = cKDTree(self.points)

    def lifted(self, rings: np.ndarray) -> np.ndarray:
        """Rings [R, N, 3], moved along the normals of the skin that they come too near to."""
        for _ in range(4):
            distance, near = self._tree.query(rings)
            facing = (self.normals[near] * _ring_normals(rings)).sum(-1) > 0
            off = ((rings - self.points[near]) * self.normals[near]).sum(-1)
            aside = np.sqrt(np.maximum(distance**2 - off**2, 0))  # far where the skin has ended
            short = np.where(facing & (aside < _ASIDE_M), np.maximum(_OFF_SKIN_M - off, 0), 0)
            rings = rings + short[..., None] * self.normals[near]
        return rings


def _lapels(
    hull: Hull, skin: _Skin, azimuth: np.ndarray, collar: np.ndarray, random: np.random.Generator
) -> HeadMesh:
    """A shirt's collar: a stand about the neck, folded over to two points before the throat."""
    gap = random.uniform(0.10, 0.3)
    around = np.linspace(gap, 2 * np.pi - gap, 120)
    base = np.interp(around, azimuth, collar, period=2 * np.pi)
    off = np.minimum(around, 2 * np.pi - around) - gap  # from the collar's ends
    stand = random.uniform(0.016, 0.024) * np.clip(0.55 + off, 0, 1)
    fall = random.uniform(0.034, 0.042) + random.uniform(0.012, 0.03) * np.exp(-((off / 0.35) ** 2))
    neck = _radius(hull, around, base) + _OFF_SKIN_M + 0.002
    top = base + stand
    top_radius = np.maximum(_radius(hull, around, top) + _OFF_SKIN_M, neck - 0.003)
    rows = [(neck, base - 0.004), ((neck + top_radius) / 2, base + stand / 2), (top_radius, top)]
    rows += [(top_radius + 0.003, top + 0.001)]
    for share in np.linspace(0, 1, 8)[1:]:
        level = top - fall * share
        radius = top_radius + 0.005 + 0.022 * share**1.2
        rows.append((radius, level))
    rings = np.stack([_ring(hull, around, radius, level) for radius, level in rows])
    rings[4:] = skin.lifted(rings[4:])
    return _loft("cloth", rings, closed=False)


def _loft(part: str, rings: np.ndarray, closed: bool) -> HeadMesh:
    """A surface through rings [R, N, 3] that go down and, seen from outside, to the right."""
    count, around = rings.shape[:2]
    ids = np.arange(count * around).reshape(count, around)
    if closed:
        ids = np.concatenate([ids, ids[:, :1]], 1)
    upper, lower = ids[:-1], ids[1:]
    quads = [(upper[:, :-1], lower[:, :-1], upper[:, 1:]), (upper[:, 1:], lower[:, :-1], lower[:, 1:])]
    triangles = np.concatenate([np.stack(quad, -1).reshape(-1, 3) for quad in quads])
    vertices = rings.reshape(-1, 3)
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(triangles)).numpy()
    share = np.broadcast_arrays(np.linspace(0, 1, around)[None], np.linspace(0, 1, count)[:, None])
    return _plain(part, vertices, normals, triangles, np.stack(share, -1).reshape(-1, 2))


def _plain(
    part: str, vertices: np.ndarray, normals: np.ndarray, triangles: np.ndarray, uv: np.ndarray
) -> HeadMesh:
    normals = unit(normals)
    return HeadMesh(
        vertices=vertices.astype(np.float32),
        normals=normals.astype(np.float32),
        triangles=triangles.astype(np.int64),
        part=np.full(len(vertices), PARTS.index(part), np.uint8),
        uv=uv.astype(np.float32),
        tangents=np.zeros((len(vertices), 3), np.float32),
    )
