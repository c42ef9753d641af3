"""How hair is cut and combed: named styles, drawn at random."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

STYLES = ("bald", "buzz", "short", "parted", "swept", "fringe", "bob", "long", "wavy", "curly", "receding")
_SHARES = (0.06, 0.10, 0.14, 0.13, 0.08, 0.10, 0.10, 0.11, 0.08, 0.06, 0.04)

# What makes a style: a value, (low, high) to draw from, or a [choice]; curls: side_mm is a share of top_mm.
_MADE_OF: dict[str, dict[str, Any]] = {
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
}


@dataclass(frozen=True)
class HairStyle:
    """How one person's hair is cut and combed; every field is a number or a name, for the record."""

    name: str = "short"
    comb: str = "whorl"  # whorl, parted, back, fringe or out
    wisps: int = 14_000
    segments: int = 7
    top_mm: float = 40.0
    side_mm: float = 15.0  # length at temples and nape
    edge: float = 0.5  # share of the length right at the hairline
    width_mm: float = 1.0
    layer_mm: float = 10.0  # thickness of the hair over the skull
    crowding: float = 1.0  # above 1, rows lie closer near the root
    lift: float = 0.6  # how much it stands off at the root
    gravity: float = 0.6
    stray: float = 0.16  # how far single wisps are from the common way
    clump: float = 0.5
    clump_wisps: int = 14
    curl_mm: float = 0.5  # radius of the curl
    wave_mm: float = 40.0  # its length along the wisp
    frizz_mm: float = 0.8
    forehead_mm: float = 96.0  # height of the hairline above the nose's underside
    recession_mm: float = 4.0  # at the temples
    thinning: float = 0.0  # of the crown and behind the forehead
    fringe_mm: float = 75.0  # height at which hair before the forehead ends
    parting_mm: float = 30.0  # of the parting from the midline, to the picture's right
    tuck: float = 0.0  # 1: behind the ears


def draw_style(random: np.random.Generator, name: str | None = None) -> HairStyle:
    """Draw a style, or a variant of the one that is named."""
    drawn = str(random.choice(STYLES, p=np.array(_SHARES) / sum(_SHARES)))
    name = drawn if name is None else name
    if name not in _MADE_OF:
        raise ValueError(f"no hair style is called {name!r}; there are {', '.join(STYLES)}")

    def between(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    def drawn_of(value: Any) -> Any:
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
    own = {field: drawn_of(value) for field, value in _MADE_OF[name].items()}
    if name == "curly":
        own["side_mm"] *= own["top_mm"]
    return replace(common, **own)
