"""Hair styles: how hair is cut and combed, drawn at random, and the hairline above which it grows."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from facerf_cli.face.topology import BOTTOM_M, HALF_ANGLE_DEG, TOP_M

# The styles, and how often they are drawn.
_FREQUENCIES = {
    "bald": 0.06,
    "buzz": 0.09,
    "short": 0.12,
    "parted": 0.11,
    "swept": 0.06,
    "fringe": 0.08,
    "bob": 0.09,
    "long": 0.10,
    "wavy": 0.07,
    "curly": 0.05,
    "afro": 0.03,
    "receding": 0.04,
    "tied": 0.07,
    "braided": 0.03,
}
STYLES = tuple(_FREQUENCIES)

# Fields of each style: a value, a range (low, high) to draw from, or a [list] to choose from. The side_mm of
# "curly" and "afro" is a fraction of their top_mm.
_STYLE_FIELDS: dict[str, dict[str, Any]] = {
    "bald": {"wisps": 0},
    "buzz": {
        "wisps": 26_000,
        "segments": 3,
        "top_mm": (5, 13),
        "side_mm": (3, 6),
        "width_mm": 0.8,
        "layer_mm": 4,
        "lift": 0.9,
        "gravity": 0.1,
        "clump": 0.15,
        "curl_mm": 0,
        "frizz_mm": 0.4,
        "edge": 0.7,
    },
    "short": {
        "wisps": 17_000,
        "segments": 6,
        "top_mm": (25, 50),
        "side_mm": (8, 16),
        "layer_mm": (9, 16),
        "lift": (0.7, 1.6),
        "gravity": 0.3,
        "clump": (0.4, 0.7),
    },
    "receding": {
        "wisps": 16_000,
        "segments": 6,
        "top_mm": (15, 40),
        "side_mm": (8, 14),
        "layer_mm": (5, 9),
        "lift": 0.5,
        "gravity": 0.4,
        "forehead_mm": (104, 122),
        "recession_mm": (10, 22),
        "thinning": (0.1, 1),
    },
    "parted": {
        "comb": "parted",
        "wisps": 15_000,
        "segments": 7,
        "top_mm": (60, 95),
        "side_mm": (15, 30),
        "layer_mm": (10, 17),
        "lift": (0.4, 0.9),
        "fringe_mm": (74, 84),
    },
    "swept": {
        "comb": "back",
        "wisps": 15_000,
        "segments": 7,
        "top_mm": (60, 110),
        "side_mm": (25, 45),
        "layer_mm": (9, 18),
        "lift": (0.5, 1.1),
        "gravity": 0.4,
    },
    "fringe": {
        "comb": "fringe",
        "wisps": 14_000,
        "segments": 8,
        "top_mm": (75, 100),
        "side_mm": (25, 70),
        "layer_mm": (10, 16),
        "lift": 0.4,
        "fringe_mm": (56, 76),
        "edge": 0.8,
    },
    "bob": {
        "comb": ["parted", "fringe"],
        "wisps": 12_000,
        "segments": 10,
        "edge": 0.95,
        "top_mm": (150, 210),
        "side_mm": (90, 140),
        "layer_mm": (10, 18),
        "lift": 0.5,
        "gravity": 1.2,
        "crowding": 1.4,
        "fringe_mm": (58, 72),
        "tuck": (0, 0.6),
    },
    "long": {
        "comb": ["parted", "parted", "back", "fringe"],
        "wisps": 8_900,
        "segments": 13,
        "edge": 0.95,
        "top_mm": (280, 400),
        "side_mm": (200, 300),
        "layer_mm": (9, 16),
        "lift": 0.4,
        "gravity": 1.5,
        "crowding": 1.5,
        "width_mm": (1.0, 1.5),
        "fringe_mm": (58, 72),
        "parting_mm": (-25, 25),
        "tuck": [0.0, 1.0],
        "curl_mm": (0, 2),
        "wave_mm": (70, 120),
    },
    "wavy": {
        "comb": "parted",
        "wisps": 6_200,
        "segments": 19,
        "edge": 0.9,
        "top_mm": (180, 300),
        "side_mm": (140, 220),
        "layer_mm": (14, 24),
        "lift": 0.7,
        "gravity": 1.1,
        "crowding": 1.2,
        "width_mm": 1.5,
        "curl_mm": (3, 7),
        "wave_mm": (40, 65),
        "clump": (0.6, 0.85),
        "parting_mm": (-35, 35),
        "tuck": (0, 0.5),
    },
    "curly": {
        "comb": "out",
        "wisps": 7_900,
        "segments": 15,
        "edge": 0.5,
        "top_mm": (18, 58),
        "side_mm": (0.6, 1),
        "layer_mm": 80,
        "lift": 1.0,
        "gravity": 0,
        "width_mm": (1.7, 2.2),
        "curl_mm": (2.5, 4.5),
        "wave_mm": (15, 24),
        "stray": 0.6,
        "clump": (0.2, 0.5),
        "clump_wisps": 5,
        "frizz_mm": 2.5,
    },
    "afro": {
        "comb": "out",
        "wisps": 8_600,
        "segments": 14,
        "edge": 0.7,
        "top_mm": (45, 85),
        "side_mm": (0.8, 1),
        "layer_mm": 100,
        "lift": 1.0,
        "gravity": 0,
        "width_mm": (1.8, 2.3),
        "curl_mm": (2.0, 3.5),
        "wave_mm": (9, 15),
        "stray": 0.7,
        "clump": (0.1, 0.3),
        "clump_wisps": 4,
        "frizz_mm": 3.0,
    },
    "tied": {
        "comb": "tied",
        "tail": ["ponytail", "bun"],
        "wisps": 13_000,
        "segments": 7,
        "top_mm": 230,
        "side_mm": 200,
        "edge": 1.0,
        "layer_mm": (4, 9),
        "lift": (0.2, 0.5),
        "gravity": 0,
        "stray": 0.05,
        "frizz_mm": (0.2, 0.6),
        "knot_mm": (30, 120),
    },
    "braided": {
        "comb": "parted",
        "tail": "braids",
        "wisps": 12_000,
        "segments": 8,
        "top_mm": (120, 150),
        "side_mm": (60, 90),
        "edge": 0.95,
        "layer_mm": (6, 11),
        "lift": 0.3,
        "gravity": 0.9,
        "parting_mm": (-6, 6),
        "tuck": 1.0,
    },
}
# The hairline: height in metres at an azimuth in degrees from the nose, the same on both sides of the head.
# `forehead_mm` and `recession_mm` of a style are added to the first heights; the ear lies between 75 and
# 100 degrees.
_LINE_DEG = (0, 20, 36, 46, 54, 60, 64, 67, 72, 75, 85, 95, 103, 112, 130, 150, 180)
_LINE_M = (0, 0.001, 0.004, -0.003, -0.022, -0.040, -0.058, -0.076, -0.078)
_LINE_EAR_M = (0.046, 0.048, 0.043, 0.022, -0.018, -0.052, -0.066, -0.068)
_RECEDES = (0.0, 0.35, 1.0, 1.0, 0.6, 0.3, 0.1, 0, 0)  # fraction of `recession_mm` at the first azimuths
_MEAN_FOREHEAD_M = 0.096


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
    lift: float = 0.6  # strength by which hair stands off at the root
    gravity: float = 0.6
    stray: float = 0.16  # deviation of single wisps from the combing direction
    clump: float = 0.5  # strength by which wisps of a clump draw together
    clump_wisps: int = 14  # per clump
    curl_mm: float = 0.5  # radius of the curl
    wave_mm: float = 40.0  # length of one turn of the curl along the wisp
    frizz_mm: float = 0.8
    forehead_mm: float = 96.0  # height of the hairline above the underside of the nose
    recession_mm: float = 4.0  # of the hairline at the temples
    thinning: float = 0.0  # of the crown and behind the forehead
    fringe_mm: float = 75.0  # height at which hair in front of the forehead ends
    parting_mm: float = 30.0  # offset of the parting from the midline, to the right of the image
    tuck: float = 0.0  # 1: behind the ears


def draw_style(random: np.random.Generator, name: str | None = None) -> HairStyle:
    """Draw a random style, or a random variant of the style `name`."""
    drawn = str(random.choice(STYLES, p=np.array(list(_FREQUENCIES.values())) / sum(_FREQUENCIES.values())))
    name = drawn if name is None else name
    if name not in _STYLE_FIELDS:
        raise ValueError(f"hair style {name!r}: unknown; choose one of {', '.join(STYLES)}")

    def between(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    def drawn_from(value: Any) -> Any:
        if isinstance(value, list):
            return random.choice(value).item()
        return between(*value) if isinstance(value, tuple) else value

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
    own = {field: drawn_from(value) for field, value in _STYLE_FIELDS[name].items()}
    if name in ("curly", "afro"):
        own["side_mm"] *= own["top_mm"]
    return replace(common, **own)


def scalp_margin_m(points: np.ndarray, style: HairStyle) -> np.ndarray:
    """Height [...] in metres of skin points [..., 3] above the style's hairline; negative below it."""
    azimuth = np.abs(np.degrees(np.arctan2(points[..., 0], points[..., 2])))
    first = np.array(_LINE_M) + style.forehead_mm / 1000 + np.array(_RECEDES) * style.recession_mm / 1000
    fixed = np.array(_LINE_M) + _MEAN_FOREHEAD_M  # the style does not move temples and sideburns
    first = np.where(np.array(_LINE_DEG[: len(first)]) > 50, fixed, first)
    return points[..., 1] - np.interp(azimuth, _LINE_DEG, [*first, *_LINE_EAR_M])


def scalp_cover(uv: np.ndarray, style: HairStyle) -> np.ndarray:
    """Cover [...] in 0..1 of the skin by hair at (u, v) [..., 2] of the UV map, which may lie outside 0..1.

    A skin texture stained with it hides the scalp that shows between the wisps.
    """
    azimuth = np.radians((uv[..., 0] - 0.5) * 2 * HALF_ANGLE_DEG)
    y = TOP_M - uv[..., 1] * (TOP_M - BOTTOM_M)
    points = np.stack([np.sin(azimuth), y, np.cos(azimuth)], -1)
    cover = np.clip(scalp_margin_m(points, style) / 0.008 + 0.3, 0, 1) * (style.wisps > 0)
    return cover * np.where(np.abs(azimuth) < np.pi, 1 - 0.7 * style.thinning * (y > 0.1), 0)
