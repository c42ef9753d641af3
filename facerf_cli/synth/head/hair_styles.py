"""Hair styles: how hair is cut and combed, drawn at random, and the hairline above which it grows."""

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.face.topology import BOTTOM_M, HALF_ANGLE_DEG, TOP_M

# Share and fields of each style, by name: the file says how.
_STYLES: dict[str, dict[str, Any]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
)
STYLES = tuple(_STYLES)

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
    shares = [style["share"] for style in _STYLES.values()]
    drawn = str(random.choice(STYLES, p=np.array(shares) / sum(shares)))
    name = drawn if name is None else name
    if name not in _STYLES:
        raise ValueError(f"hair style {name!r}: unknown; choose one of {', '.join(STYLES)}")

    def between(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    def drawn_from(value: Any) -> Any:
        if isinstance(value, dict):
            return random.choice(value["any"]).item()
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
