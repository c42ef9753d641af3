"""Histograms of procedural maps beside real ones: contrast and colour.

    python benchmarks/skies.py --hdri DIR [--maps 240] [--width 512] [--kind sun]

A row a number: the real maps' values, the drawn ones' median and 5-95 % range, and how many of the real maps
lie inside that range (nine in ten would, were they drawn from it). All shares are of solid angle; all maps
are averaged to the same width, as the sun's peak depends on it.
"""

import argparse
from pathlib import Path

import numpy as np

from facerf_cli.files.images import ENVMAP_LIMIT_PX, read_image
from facerf_cli.light.sphere import latlong_solid_angles
from facerf_cli.synth.sky.skies import KINDS, MIX, draw_sky

EDGES = np.array([-9, -1, -0.5, -0.25, 0, 0.25, 0.5, 1, 1.5, 2, 3, 9])  # log10 of radiance to the median's
CHROMA_EDGES = np.array([-9, -1, -0.5, -0.2, 0.2, 0.5, 1, 9])  # log2 of red to blue


def numbers(envmap: np.ndarray) -> dict[str, float]:
    """What is compared of a map [H, W, 3], by name; a name starts with its group."""
    rgb = np.maximum(envmap.reshape(-1, 3), 1e-9 * envmap.max())
    solid = latlong_solid_angles(*envmap.shape[:2]).double().numpy().ravel() / (4 * np.pi)
    order = np.argsort(rgb.mean(-1))[::-1]
    rgb, solid = rgb[order], solid[order]
    light, area = rgb.mean(-1), np.cumsum(solid)
    median = light[np.searchsorted(area, 0.5)]
    return contrast(light, solid, area, median) | histograms(rgb, solid, median) | chroma(rgb, solid, area)


def contrast(light: np.ndarray, solid: np.ndarray, area: np.ndarray, median: float) -> dict[str, float]:
    """Log10 ratios to the median, and shares of power, of pixels with the brightest first."""
    power = np.cumsum(light * solid)
    power /= power[-1]
    found = {"contrast log10 max": float(np.log10(light[0] / median))}
    for top in (0.001, 0.01, 0.1, 0.9, 0.99):
        level = light[min(np.searchsorted(area, top), len(light) - 1)]
        found[f"contrast log10 p{100 * (1 - top):g}"] = float(np.log10(level / median))
    shares = {
        f"power in top {100 * top:g} %": float(np.interp(top, area, power)) for top in (0.001, 0.01, 0.1)
    }
    return found | shares


def histograms(rgb: np.ndarray, solid: np.ndarray, median: float) -> dict[str, float]:
    """Shares of the sphere by log radiance over the median and by log red over blue."""
    lums = np.histogram(np.log10(rgb.mean(-1) / median), EDGES, weights=solid)[0]
    reds = np.histogram(np.log2(rgb[:, 0] / rgb[:, 2]).clip(-8, 8), CHROMA_EDGES, weights=solid)[0]
    found = {f"luminance {a:+5.2f}..{b:+5.2f}": v for a, b, v in zip(EDGES, EDGES[1:], lums, strict=False)}
    pairs = zip(CHROMA_EDGES, CHROMA_EDGES[1:], reds, strict=False)
    return found | {f"red/blue {a:+5.2f}..{b:+5.2f}": v for a, b, v in pairs}


def chroma(rgb: np.ndarray, solid: np.ndarray, area: np.ndarray) -> dict[str, float]:
    """Log2 of red to green and blue to green: of the mean, the brightest per cent, the darker half."""
    found = {}
    for name, low, high in (("mean", 0, 2), ("top 1 %", 0, 0.01), ("darker half", 0.5, 2)):
        rows = (area > low) & (area <= high) if low else (area <= max(high, area[0]))
        r, g, b = (rgb[rows] * solid[rows, None]).sum(0)
        found |= {f"chroma {name} r/g": float(np.log2(r / g)), f"chroma {name} b/g": float(np.log2(b / g))}
    return found


def halved_to(envmap: np.ndarray, width_px: int) -> np.ndarray:
    """A map averaged down by powers of two to at most this width."""
    while envmap.shape[1] > width_px:
        envmap = envmap.reshape(len(envmap) // 2, 2, envmap.shape[1] // 2, 2, 3).mean((1, 3))
    return envmap


def main() -> None:
    shared = Path(__file__).parents[2] / "shared" / "data" / "hdri"
    parser = argparse.ArgumentParser()
    parser.add_argument("--hdri", type=Path, default=shared)
    parser.add_argument("--maps", type=int, default=240)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", choices=list(KINDS))
    options = parser.parse_args()
    paths = sorted(path for path in options.hdri.iterdir() if path.suffix in (".hdr", ".exr"))
    images = (read_image(path, limit_px=ENVMAP_LIMIT_PX).pixels for path in paths)
    real = [numbers(halved_to(pixels, options.width)) for pixels in images]
    kinds = tuple(options.kind or MIX)
    drawn = [numbers(draw_sky(i, options.seed, options.width, kinds)[0]) for i in range(options.maps)]
    print("real:", ", ".join(path.stem for path in paths))
    print(f"{'':24s} {'real':{8 * len(real)}s} | {options.maps} drawn: p5, p50, p95 | real inside")
    inside: dict[str, list[bool]] = {}
    for name in real[0]:
        theirs, ours = ([row[name] for row in rows] for rows in (real, drawn))
        low, middle, high = np.percentile(ours, [5, 50, 95])
        hits = [bool(low - 1e-3 <= value <= high + 1e-3) for value in theirs]
        inside.setdefault(name.split()[0], []).extend(hits)
        values = " ".join(f"{value:7.3f}" for value in theirs)
        print(f"{name:24s} {values} | {low:7.3f} {middle:7.3f} {high:7.3f} | {sum(hits)}/{len(hits)}")
    groups = ", ".join(f"{name} {np.mean(hits):.0%}" for name, hits in inside.items())
    print(f"real inside the drawn 5-95 %: {groups}; all {np.mean(np.concatenate(list(inside.values()))):.0%}")


if __name__ == "__main__":
    main()
