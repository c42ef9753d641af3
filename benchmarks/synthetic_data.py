"""Synthetic data next to real data: people of the stage before a face detector, and procedural maps.

    facerf synth-stage -o CAPTURE --subjects 60
    python benchmarks/synthetic_data.py --capture CAPTURE [--maps ../shared/data/hdri] [--drawn 240]

- People: dlib's detector on the frontal image under all lights. A face counts as found where exactly one is.
  The landmark error is the mean distance to the true landmarks in inter-ocular distances, by skin tone too.
- Maps: contrast and colour of procedural maps, all shares in solid angle, all maps averaged to one width,
  since the sun's peak depends on it. A row is a figure: the real maps' values, the drawn ones' 5th, 50th and
  95th percentile, and the share of the real maps in that range (nine in ten if they were drawn alike).
"""

import json
from pathlib import Path

import numpy as np
import torch
from _common import MAPS, arguments, print_header, print_row, required

from facerf_cli.face.landmarks import to_display
from facerf_cli.face.topology import CONTOUR, OUTER_EYE_CORNERS
from facerf_cli.files.images import ENVMAP_LIMIT_PX, read_image
from facerf_cli.light.sphere import latlong_solid_angles
from facerf_cli.metrics import TONES, tone_of
from facerf_cli.portrait.find import detect_faces
from facerf_cli.raster.camera import project
from facerf_cli.synth.sky.skies import KINDS, MIX, draw_sky
from facerf_cli.synth.stage_cameras import stage_cameras

EDGES = np.array([-9, -1, -0.5, -0.25, 0, 0.25, 0.5, 1, 1.5, 2, 3, 9])  # log10 of radiance over the median
CHROMA_EDGES = np.array([-9, -1, -0.5, -0.2, 0.2, 0.5, 1, 9])  # log2 of red over blue
_ROUNDING = 1e-3  # of a figure at the edge of the range


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--capture", type=Path, help="of synth-stage")
    parser.add_argument("--maps", type=Path, help="folder of real envmaps")
    parser.add_argument("--drawn", type=int, default=240, help="procedural maps")
    parser.add_argument("--width", type=int, default=512, help="of all maps, in pixels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", choices=list(KINDS), help="of the procedural maps")
    given = parser.parse_args()
    if given.capture:
        report_people(required(given.capture, "", "--capture"))
    real = required(given.maps, "real envmaps", "--maps", MAPS)
    report_maps(real, given.drawn, given.width, given.seed, tuple(given.kind or MIX))


def report_people(capture: Path) -> None:
    """Print the share of found faces and their landmark errors, by skin tone."""
    rows: dict[str, list[tuple[float, float] | None]] = {}
    for path in sorted(capture.glob("*/subject.json")):
        tone = tone_of(json.loads(path.read_text())["traits"]["ita_deg"])
        errors = landmark_errors(path.parent)
        for name in ("all", tone):
            rows.setdefault(name, []).append(errors)
    print_header("", "people", "found", "error of 68 points", "of the inner 51")
    for name in ("all", *TONES):
        if people := rows.get(name):
            found = [errors for errors in people if errors]
            means = np.mean(found, 0) if found else (np.nan, np.nan)
            print_row(
                name, len(people), f"{len(found) / len(people):.1%}", *(f"{mean:.2%}" for mean in means)
            )


def landmark_errors(subject: Path) -> tuple[float, float] | None:
    """Mean error of all 68 landmarks and of the inner 51; None where there is not exactly one face."""
    lit = np.mean([read_image(path).pixels for path in sorted((subject / "C0").glob("*.exr"))], 0)
    faces = detect_faces(to_display(lit))
    if len(faces) != 1:
        return None
    record = json.loads((subject / "subject.json").read_text())
    shot = stage_cameras(lit.shape[0])[0]
    world = torch.tensor(record["landmarks_world"], dtype=torch.float32)
    truth = project(world @ shot.head_to_camera.T + shot.translation_m, shot.camera).numpy()
    left, right = OUTER_EYE_CORNERS
    eyes_px = np.linalg.norm(truth[left] - truth[right])
    errors = np.linalg.norm(faces[0].landmarks_px - truth, axis=-1) / eyes_px
    return float(errors.mean()), float(errors[len(CONTOUR) :].mean())


def report_maps(folder: Path, count: int, width_px: int, seed: int, kinds: tuple[str, ...]) -> None:
    """Print each figure of the real maps next to the range of the drawn ones."""
    paths = sorted(path for path in folder.iterdir() if path.suffix in (".hdr", ".exr"))
    images = (read_image(path, limit_px=ENVMAP_LIMIT_PX).pixels for path in paths)
    real = [map_figures(halved_to(pixels, width_px)) for pixels in images]
    drawn = [map_figures(draw_sky(index, seed, width_px, kinds)[0]) for index in range(count)]
    print_header("", ", ".join(path.stem for path in paths), f"{count} drawn: 5, 50, 95 %", "real inside")
    inside: dict[str, list[bool]] = {}
    for name in real[0]:
        theirs, ours = ([row[name] for row in rows] for rows in (real, drawn))
        low, middle, high = np.percentile(ours, [5, 50, 95])
        hits = [bool(low - _ROUNDING <= value <= high + _ROUNDING) for value in theirs]
        inside.setdefault(name.split()[0], []).extend(hits)
        values = " ".join(f"{value:.3f}" for value in theirs)
        print_row(name, values, f"{low:.3f} {middle:.3f} {high:.3f}", f"{sum(hits)} of {len(hits)}")
    groups = ", ".join(f"{name} {np.mean(hits):.0%}" for name, hits in inside.items())
    print(
        f"real inside the drawn 5 to 95 %: {groups}; all {np.mean(np.concatenate(list(inside.values()))):.0%}"
    )


def map_figures(envmap: np.ndarray) -> dict[str, float]:
    """Figures of a map [H, W, 3] by name; a name starts with its group."""
    rgb = np.maximum(envmap.reshape(-1, 3), 1e-9 * envmap.max())
    solid = latlong_solid_angles(*envmap.shape[:2]).double().numpy().ravel() / (4 * np.pi)
    order: np.ndarray = np.argsort(rgb.mean(-1))[::-1]
    rgb, solid = rgb[order], solid[order]
    light, area = rgb.mean(-1), np.cumsum(solid)
    median = float(light[int(np.searchsorted(area, 0.5))])
    return contrast(light, solid, area, median) | histograms(rgb, solid, median) | chroma(rgb, solid, area)


def contrast(light: np.ndarray, solid: np.ndarray, area: np.ndarray, median: float) -> dict[str, float]:
    """Log10 ratios to the median, and shares of power, of pixels with the brightest first."""
    power = np.cumsum(light * solid)
    power /= power[-1]
    found = {"contrast log10 max": float(np.log10(light[0] / median))}
    for top in (0.001, 0.01, 0.1, 0.9, 0.99):
        level = light[min(int(np.searchsorted(area, top)), len(light) - 1)]
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
    found: dict[str, float] = {}
    for name, low, high in (("mean", 0, 2), ("top 1 %", 0, 0.01), ("darker half", 0.5, 2)):
        rows = (area > low) & (area <= high) if low else (area <= max(high, area[0]))
        r, g, b = (rgb[rows] * solid[rows, None]).sum(0)
        found |= {f"chroma {name} r/g": float(np.log2(r / g)), f"chroma {name} b/g": float(np.log2(b / g))}
    return found


def halved_to(envmap: np.ndarray, width_px: int) -> np.ndarray:
    """Average a map down by powers of two to at most this width."""
    while envmap.shape[1] > width_px:
        envmap = envmap.reshape(len(envmap) // 2, 2, envmap.shape[1] // 2, 2, 3).mean((1, 3))
    return envmap


if __name__ == "__main__":
    main()
