"""A garment around the neck and shoulders of a synthetic head: a loft through rings measured on the head."""

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from facerf_cli.face.topology import LANDMARK_UV
from facerf_cli.raster.texture import vertex_normals
from facerf_cli.synth.head.hull import Hull, hull_of
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, joined, strandless, unit

GARMENTS = ("crew neck", "v-neck", "wide neck", "turtleneck", "shirt")

_CHIN = 8  # landmark
_AROUND = 144  # vertices around the neck
_CUT_M = 0.16  # lower end of a garment below the chin
_LOWEST_CHIN_M = -0.085  # limit of the chin's height, so that an open mouth does not move the garment
_OFF_SKIN_M = 0.004  # minimal distance from cloth to skin
_BANDS_M = {"turtleneck": 0.045, "shirt": 0.006}  # fixed heights of the neckline's band; drawn for the others
_FLARE_M = 0.012  # a level counts as neck while it is at most this much wider than the narrowest level
_BELOW_M = -0.06  # height below which cloth may touch skin
_ASIDE_M = 0.008  # largest sideways distance at which cloth still lies over a vertex of the skin
_BODY_ROWS = 33  # rings between neckline and cut


def draw_clothes(head: HeadMesh, random: np.random.Generator) -> HeadMesh:
    """Draw a garment from the neck to the shoulders, as part "cloth", for a bare head."""
    kind = str(random.choice(GARMENTS))
    hull, skin = hull_of(head), _NeckSkin(head)
    azimuth = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    collar = _collar_line(kind, azimuth, _chin_m(head), random)
    collar = _on_neck(hull, azimuth, collar, _BANDS_M.get(kind, 0.01))
    garment = _body(kind, hull, skin, azimuth, collar, _chin_m(head) - _CUT_M, random)
    if kind != "shirt":
        return garment
    return joined(garment, _lapels(hull, skin, azimuth, collar, random))


def _chin_m(head: HeadMesh) -> float:
    """Height of the underside of the chin, not below `_LOWEST_CHIN_M`."""
    skin = head.part == PARTS.index("skin")
    nearest = np.linalg.norm(head.uv[skin] - LANDMARK_UV[_CHIN], axis=-1).argmin()
    return max(float(head.vertices[skin][nearest, 1]) - 0.003, _LOWEST_CHIN_M)


def _collar_line(kind: str, azimuth: np.ndarray, chin: float, random: np.random.Generator) -> np.ndarray:
    """Draw the height [N] of the neckline around the neck, lower at the front than at the back."""
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
    """The neckline [N], raised where the lower end of its band would lie on the shoulders of a short neck."""
    levels = line + np.arange(0, 0.06, 0.003)[:, None]
    radius = np.stack([_radius(hull, azimuth, level - band) for level in levels])
    slender = radius < radius.min(0) + _FLARE_M
    raised = np.take_along_axis(levels, slender.argmax(0)[None], 0)[0]
    return gaussian_filter1d(raised - line, 5, mode="wrap") + line


def _body(
    kind: str,
    hull: Hull,
    skin: "_NeckSkin",
    azimuth: np.ndarray,
    collar: np.ndarray,
    bottom: float,
    random: np.random.Generator,
) -> HeadMesh:
    """Loft from inside the neckline over its band down to the shoulders, then straight down to the cut."""
    neck = _radius(hull, azimuth, collar) + _OFF_SKIN_M + (0.012 if kind == "wide neck" else 0)
    thick = 0.006 if kind == "turtleneck" else 0.0025
    rows = _band(kind, hull, azimuth, collar, neck, thick, random)
    start_radius, start = rows[-1]
    start_radius = np.maximum(start_radius, neck + thick) - (0.0025 if kind != "turtleneck" else 0.006)
    rows += _shoulders(azimuth, start_radius, start, bottom, random)
    rings = np.stack([_ring(hull, azimuth, radius, level) for radius, level in rows])
    band_rows = len(rows) - _BODY_ROWS
    rings[band_rows:] += _folds(rings[band_rows:], azimuth, random)
    rings[3:] = skin.lifted(rings[3:])
    return _loft("cloth", rings, closed=True)


def _band(
    kind: str,
    hull: Hull,
    azimuth: np.ndarray,
    collar: np.ndarray,
    neck: np.ndarray,
    thick: float,
    random: np.random.Generator,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(radius, height) [N] of the rings of the neckline, from its inside over the edge down its band."""
    band = _BANDS_M.get(kind, random.uniform(0.010, 0.02))
    rows = [(neck - 0.0025, collar - 0.012), (neck - 0.002, collar - 0.003), (neck, collar)]
    rows += [(neck + thick, collar - 0.0025)]
    for share in (0.35, 0.7, 1.0):
        level = collar - band * share * (1 if kind == "turtleneck" else 0.75)
        level = (
            np.maximum(level, collar - band) if kind != "turtleneck" else np.minimum(level, collar - 0.003)
        )
        rows.append((_radius(hull, azimuth, level) + _OFF_SKIN_M + thick + 0.002 * share, level))
    return rows


def _shoulders(
    azimuth: np.ndarray,
    start_radius: np.ndarray,
    start: np.ndarray,
    bottom: float,
    random: np.random.Generator,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(radius, height) [N] of the rings from the band, at `start_radius` and height `start`, to the cut."""
    wide = random.uniform(0.195, 0.225)
    deep = np.where(np.cos(azimuth) > 0, random.uniform(0.10, 0.12), random.uniform(0.105, 0.12))
    outline = (np.abs(np.sin(azimuth) / wide) ** 2.6 + np.abs(np.cos(azimuth) / deep) ** 2.6) ** (-1 / 2.6)
    outline = np.maximum(outline, start_radius + 0.012)
    aside = np.sin(azimuth) ** 2
    fall = random.uniform(0.24, 0.38)  # slope of the shoulders, height by width
    sloped = fall * (outline - start_radius) * aside
    drop = np.maximum(start - sloped - bottom, 0.02)
    rows = []
    for share in np.linspace(0, 1, _BODY_ROWS + 1)[1:]:
        quarter = share * np.pi / 2
        out = (1 - aside) * share**0.75 + aside * np.sin(quarter)
        down = (1 - aside) * share + aside * (1 - np.cos(quarter)) ** 1.4
        radius = start_radius + (outline - start_radius) * out
        rows.append((radius, start - sloped * out - drop * down))
    return rows


def _radius(hull: Hull, azimuth: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Horizontal distance [N] from the hull's axis to its surface at azimuths and heights [N]."""
    return 1.0 - hull.height(_ring(hull, azimuth, np.ones(len(azimuth)), level))


def _ring(hull: Hull, azimuth: np.ndarray, radius: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Points [N, 3] around the hull's axis at azimuths, radii and heights [N]."""
    x, z = radius * np.sin(azimuth), radius * np.cos(azimuth) + hull.middle[2]
    return np.stack([x, np.broadcast_to(level, x.shape), z], -1)


def _folds(rings: np.ndarray, azimuth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Draw offsets [rows, N, 3] of soft folds, which grow from the neckline outward."""
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
    """Unit normals [rows, N, 3] of closed rings."""
    around = np.roll(rings, -1, 1) - np.roll(rings, 1, 1)
    down = np.gradient(rings, axis=0)
    return unit(np.cross(down, around))


class _NeckSkin:
    """The skin of a head below its chin, from which cloth keeps the distance `_OFF_SKIN_M`."""

    def __init__(self, head: HeadMesh) -> None:
        low = (head.part == PARTS.index("skin")) & (head.vertices[:, 1] < _BELOW_M)
        self.points, self.normals = head.vertices[low].astype(float), head.normals[low].astype(float)
        self._tree = cKDTree(self.points)

    def lifted(self, rings: np.ndarray) -> np.ndarray:
        """Rings [R, N, 3] moved along the normals of the skin where they come too near to it."""
        for _ in range(4):
            distance, near = self._tree.query(rings)
            facing = (self.normals[near] * _ring_normals(rings)).sum(-1) > 0
            off = ((rings - self.points[near]) * self.normals[near]).sum(-1)
            aside = np.sqrt(np.maximum(distance**2 - off**2, 0))  # large where the skin mesh ends
            short = np.where(facing & (aside < _ASIDE_M), np.maximum(_OFF_SKIN_M - off, 0), 0)
            rings = rings + short[..., None] * self.normals[near]
        return rings


def _lapels(
    hull: Hull, skin: _NeckSkin, azimuth: np.ndarray, collar: np.ndarray, random: np.random.Generator
) -> HeadMesh:
    """Draw a shirt's collar: a stand around the neck, folded over to two points in front of the throat."""
    gap = random.uniform(0.10, 0.3)
    around = np.linspace(gap, 2 * np.pi - gap, 120)
    base = np.interp(around, azimuth, collar, period=2 * np.pi)
    off = np.minimum(around, 2 * np.pi - around) - gap  # azimuth from the ends of the collar
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
    """Mesh a surface through rings [R, N, 3] that go down and, seen from outside, to the right."""
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
    return strandless(part, vertices, normals, triangles, np.stack(share, -1).reshape(-1, 2))
