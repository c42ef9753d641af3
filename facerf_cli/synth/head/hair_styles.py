"""Hair styles: how hair is cut, combed and tied, drawn at random, and the hairline above which it grows."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from facerf_cli.face.topology import BOTTOM_M, HALF_ANGLE_DEG, TOP_M
from facerf_cli.synth import tables_of
from facerf_cli.synth.head.mesh import Hull, unit
from facerf_cli.synth.random_fields import Random

# Share and fields of each style, by name: the file says how.
_STYLES = tables_of(__file__)
STYLES = tuple(_STYLES)

# The hairline: height in metres at an azimuth in degrees from the nose, the same on both sides of the head.
# `forehead_mm` and `recession_mm` of a style are added to the first heights; the ear lies between 75 and
# 100 degrees.
_LINE_DEG = (0, 20, 36, 46, 54, 60, 64, 67, 72, 75, 85, 95, 103, 112, 130, 150, 180)
_LINE_M = (0, 0.001, 0.004, -0.003, -0.022, -0.040, -0.058, -0.076, -0.078)
_LINE_EAR_M = (0.046, 0.048, 0.043, 0.022, -0.018, -0.052, -0.066, -0.068)
_RECEDES = (0.0, 0.35, 1.0, 1.0, 0.6, 0.3, 0.1, 0, 0)  # fraction of `recession_mm` at the first azimuths
_MEAN_FOREHEAD_M = 0.096
ROWS = 17  # points of a path
_WISPS = {"ponytail": 1300, "bun": 900, "braids": 1400}
_BRAIDS_M = np.array([0.072, -0.035, -0.012])  # begin of the braid on the image's right: below the ear
_BACK_M = 0.09  # from the middle of the skull to its back
_SHOULDER_M = -0.105  # below this height a braid lies on the clothes
_STRAND_M = 0.007  # half width of a strand of a braid


@dataclass(frozen=True)
class HairStyle:
    """Cut and comb of one person's hair; every field is a number or a name, so that it can be recorded."""

    name: str = "short"
    comb: str = "whorl"  # whorl, parted, back, fringe, out or tied
    tail: str = ""  # ponytail, bun or braids
    knot_mm: float = 60.0  # height of the knot to which hair is tied
    wisps: int = 14_000
    segments: int = 7  # of a wisp
    top_mm: float = 40.0  # length on top of the head
    side_mm: float = 15.0  # length at temples and nape
    edge: float = 0.5  # fraction of the length at the hairline
    width_mm: float = 1.0  # of a wisp
    layer_mm: float = 10.0  # thickness of the hair over the skull
    crowding: float = 1.0  # above 1, the rows of a wisp lie closer near the root
    lift: float = 0.6  # how strongly hair stands off at the root
    gravity: float = 0.6
    stray: float = 0.16  # deviation of single wisps from the combing direction
    clump: float = 0.5  # how strongly wisps of a clump draw together
    clump_wisps: int = 14  # per clump
    curl_mm: float = 0.5  # radius of the curl
    wave_mm: float = 40.0  # length of one turn of the curl along the wisp
    frizz_mm: float = 0.8
    forehead_mm: float = 96.0  # height of the hairline above the underside of the nose
    recession_mm: float = 4.0  # of the hairline at the temples
    thinning: float = 0.0  # of the crown and behind the forehead
    fringe_mm: float = 75.0  # hair in front of the forehead ends at this height
    parting_mm: float = 30.0  # offset of the parting from the midline, to the right of the image
    tuck: float = 0.0  # 1: behind the ears


def draw_style(random: Random, name: str | None = None) -> HairStyle:
    """Draw a random style, or a random variant of the style `name`."""
    shares = [style["share"] for style in _STYLES.values()]
    drawn = str(random.choice(STYLES, p=np.array(shares) / sum(shares)))
    name = drawn if name is None else name
    if name not in _STYLES:
        raise ValueError(f"hair style {name!r}: unknown; choose one of {', '.join(STYLES)}")

    def between(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    def drawn_from(value: Any) -> Any:
        if isinstance(value, dict):
            choices: list[Any] = value["any"]
            return random.choice(choices).item()
        return between(*value) if isinstance(value, list) else value

    common = HairStyle(
        name=name,
        clump=between(0.25, 0.6),
        clump_wisps=int(random.integers(8, 24)),
        curl_mm=between(0, 1.2),
        wave_mm=between(30, 60),
        frizz_mm=between(0.3, 1.2),
        forehead_mm=between(90, 106),
        recession_mm=between(-3, 8),
        parting_mm=between(20, 42) * float(random.choice([-1, 1])),
        width_mm=between(0.8, 1.2),
    )
    own = {field: drawn_from(value) for field, value in _STYLES[name].items() if field != "share"}
    if name in ("curly", "afro"):
        own["side_mm"] *= own["top_mm"]
    return replace(common, **own)


def scalp_margin_m(points: np.ndarray, style: HairStyle) -> np.ndarray:
    """Return the height [...] in metres of skin points [..., 3] above the style's hairline."""
    azimuth = np.abs(np.degrees(np.arctan2(points[..., 0], points[..., 2])))
    first = np.array(_LINE_M) + style.forehead_mm / 1000 + np.array(_RECEDES) * style.recession_mm / 1000
    fixed = np.array(_LINE_M) + _MEAN_FOREHEAD_M  # the style does not move temples and sideburns
    first = np.where(np.array(_LINE_DEG[: len(first)]) > 50, fixed, first)
    return points[..., 1] - np.interp(azimuth, _LINE_DEG, [*first, *_LINE_EAR_M])


def scalp_cover(uv: np.ndarray, style: HairStyle) -> np.ndarray:
    """Return the coverage [...] of the skin by hair at (u, v) [..., 2], which may lie outside 0..1.

    A skin texture stained with it hides the scalp that shows between the wisps.
    """
    azimuth = np.radians((uv[..., 0] - 0.5) * 2 * HALF_ANGLE_DEG)
    y = TOP_M - uv[..., 1] * (TOP_M - BOTTOM_M)
    points = np.stack([np.sin(azimuth), y, np.cos(azimuth)], -1)
    cover = np.clip(scalp_margin_m(points, style) / 0.008 + 0.3, 0, 1) * (style.wisps > 0)
    return cover * np.where(np.abs(azimuth) < np.pi, 1 - 0.7 * style.thinning * (y > 0.1), 0)


def knot_m(hull: Hull, height_m: float) -> np.ndarray:
    """Return the point [3] at the back of the head, at this height, that hair is combed to."""
    far = hull.middle + 5 * np.array([0.0, max(height_m - hull.middle[1], 0.0), -_BACK_M])
    far[1] += min(height_m - hull.middle[1], 0.0)
    return np.asarray(far - (hull.height(far[None])[0] - 0.004) * hull.rays(far[None])[0])


def tail_paths(
    kind: str, person_m: np.ndarray, hull: Hull, height_m: float, random: Random
) -> tuple[np.ndarray, np.ndarray]:
    """Draw paths and normals [W, ROWS, 3] of a ponytail, a bun or two braids.

    person_m [V, 3]: head and clothes under the braids.
    """
    count = _WISPS[kind]
    share = np.linspace(0, 1, ROWS)[None, :, None]
    if kind == "braids":
        both = [_braid(person_m, side, count // 2, random) for side in (-1, 1)]
        paths, normals = (np.concatenate(column) for column in zip(*both, strict=True))
        return paths, normals
    knot = knot_m(hull, height_m)
    away = unit(knot - hull.middle)
    if kind == "bun":
        radius = random.uniform(0.024, 0.038)
        axes = unit(random.normal(0, 1, (count, 3)))
        first = unit(np.cross(axes, np.where(np.abs(axes[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])))
        second = np.cross(axes, first)
        angle = 2 * np.pi * (random.uniform(0, 1, (count, 1, 1)) + 0.7 * share)
        shell = radius * random.uniform(0.8, 1, (count, 1, 1))
        around = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
        return knot + 0.85 * radius * away + shell * around, around
    offset = random.normal(0, 0.006, (count, 1, 3))
    length = random.uniform(0.14, 0.3) * random.uniform(0.75, 1.05, (count, 1, 1))
    out = 0.045 * (1 - (1 - np.minimum(share * 2, 1)) ** 2)
    fall = length * share**1.6
    paths = knot + offset * (1 + 2 * share) + out * away - fall * np.array([0, 1.0, 0])
    paths = hull.lifted(paths, 0.004)
    return paths, unit(paths - paths.mean(0))


def _braid(person_m: np.ndarray, side: int, count: int, random: Random) -> tuple[np.ndarray, np.ndarray]:
    """Paths and normals [W, ROWS, 3] of three strands that cross on their way down to the chest."""
    long_m, turns = random.uniform(0.18, 0.28), 3.5
    rows = np.linspace(0, 1, ROWS)
    middle = _BRAIDS_M * [side, 1, 1] + np.stack([0.012 * side * rows, -long_m * rows, 0 * rows], -1)
    front = person_m[person_m[:, 2] > 0]
    near = cKDTree(front[:, :2]).query_ball_point(middle[:, :2], 0.012)
    depth_m = np.array([front[ids, 2].max() if ids else -1.0 for ids in near])
    depth_m[middle[:, 1] > _SHOULDER_M] = -1.0  # beside the neck
    middle[:, 2] = np.maximum(middle[:, 2], np.maximum.accumulate(depth_m) + 0.016)
    middle[:, 2] = np.convolve(np.pad(middle[:, 2], 2, "edge"), np.full(5, 0.2), "valid")
    strand = np.arange(count) % 3
    phase = 2 * np.pi * (turns * rows + strand[:, None] / 3)
    across, depth = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    crossed = 0.011 * np.sin(phase)[..., None] * across + 0.006 * np.sin(2 * phase)[..., None] * depth
    turn = random.uniform(0, 2 * np.pi, (count, 1, 1))
    within = _STRAND_M * np.sqrt(random.uniform(0, 1, (count, 1, 1)))
    spread = within * (np.cos(turn) * across + np.sin(turn) * depth)
    thinner = (1 - 0.5 * rows)[None, :, None]
    away = (crossed + spread) * thinner
    return middle + away, unit(away)


def tied(paths: np.ndarray, hull: Hull, height_m: float, layer_m: float) -> np.ndarray:
    """Return paths [W, R, 3] that lie on the head and end in the knot, with as many points as before."""
    knot, rows = knot_m(hull, height_m), paths.shape[1]
    last = np.maximum(np.linalg.norm(paths - knot, axis=-1).argmin(1), 1)
    at = np.linspace(0, 1, rows) * last[:, None]
    low = np.minimum(at.astype(int), rows - 2)
    part = (at - low)[..., None]
    each = np.arange(len(paths))[:, None]
    cut = paths[each, low] * (1 - part) + paths[each, low + 1] * part
    cut = cut + np.linspace(0, 1, rows)[:, None] ** 2 * (knot - cut[:, -1:])
    above = np.maximum(hull.height(cut) - layer_m, 0)
    return hull.lifted(cut - above[..., None] * hull.rays(cut), 0.0015)
