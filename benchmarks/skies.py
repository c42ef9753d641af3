"""The contrast of procedural maps beside real ones.

    python benchmarks/skies.py --hdri DIR [--maps 200] [--width 1024]

A row a statistic: the real maps' values, the procedural ones' percentiles, and where each real map lies among
the procedural ones (their share below it, in per cent; 0 or 100 is outside). All maps have the same width.
"""

import argparse
from pathlib import Path

import numpy as np

from facerf_cli.files.images import ENVMAP_LIMIT_PX, read_image
from facerf_cli.light.sphere import latlong_solid_angles
from facerf_cli.stage.skies import draw_sky


def statistics(envmap: np.ndarray) -> dict[str, float]:
    """Contrast of a map [H, W, 3]: log10 ratios to its median, shares of power; by solid angle."""
    light = envmap.mean(-1).ravel()
    solid = latlong_solid_angles(*envmap.shape[:2]).double().numpy().ravel()
    order = np.argsort(light)[::-1]
    light, area = np.maximum(light[order], 1e-9), np.cumsum(solid[order]) / (4 * np.pi)
    power = np.cumsum(light * solid[order])
    power /= power[-1]
    median = light[np.searchsorted(area, 0.5)]
    rows = {f"log10 p{100 * (1 - top):g} / median": top for top in (0.001, 0.01, 0.1, 0.9, 0.99)}
    ranges = {name: float(np.log10(light[np.searchsorted(area, top)] / median)) for name, top in rows.items()}
    shares = {f"power in {100 * top:g} %": float(np.interp(top, area, power)) for top in (0.001, 0.01, 0.1)}
    return {"log10 max / median": float(np.log10(light[0] / median)), **ranges, **shares}


def halved_to(envmap: np.ndarray, width_px: int) -> np.ndarray:
    """A map averaged down by powers of two to at most this width."""
    while envmap.shape[1] > width_px:
        envmap = envmap.reshape(len(envmap) // 2, 2, envmap.shape[1] // 2, 2, 3).mean((1, 3))
    return envmap


def main() -> None:
    shared = Path(__file__).parents[2] / "shared" / "data" / "hdri"
    parser = argparse.ArgumentParser()
    parser.add_argument("--hdri", type=Path, default=shared)
    parser.add_argument("--maps", type=int, default=200)
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    paths = sorted(path for path in options.hdri.iterdir() if path.suffix in (".hdr", ".exr"))
    pictures = (read_image(path, limit_px=ENVMAP_LIMIT_PX).pixels for path in paths)
    real = [statistics(halved_to(pixels, options.width)) for pixels in pictures]
    drawn = [statistics(draw_sky(i, options.seed, options.width)[0]) for i in range(options.maps)]
    print("real:", ", ".join(path.stem for path in paths))
    print(f"{'':24s} {'real':42s} | {options.maps} drawn: p0 p5 p50 p95 p100    | real among drawn, %")
    for name in real[0]:
        theirs = [row[name] for row in real]
        ours = np.array([row[name] for row in drawn])
        spread = " ".join(f"{value:6.2f}" for value in np.percentile(ours, [0, 5, 50, 95, 100]))
        ranks = " ".join(f"{100 * (ours < value).mean():3.0f}" for value in theirs)
        print(f"{name:24s} {' '.join(f'{value:6.2f}' for value in theirs):42s} | {spread} | {ranks}")


if __name__ == "__main__":
    main()
