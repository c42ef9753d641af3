"""Whole heads of real people under single flashes: the error of any method, by region.

    python benchmarks/portrait.py --export FOLDER        # FOLDER/SUBJECT/SOURCE.png, 16 bit; cases.json
    python benchmarks/portrait.py --predictions FOLDER   # SUBJECT/SOURCE/TARGET.exr, .npy or linear .png
    python benchmarks/portrait.py --copy                 # the photo left as it is

270 pairs of frames (640 x 480) of yaleB01, yaleB11 and yaleB15 of Extended Yale B, in one folder (`--data`).
A prediction lies on its source. Values are close to linear in light; yaleB01's ambient frame is subtracted.
Light: `az_deg` > 0 from the picture's right, `el_deg` > 0 from above; pairs whose lights differ by less than
12 degrees are left out. A target is moved onto its source by the head's shift (data/portrait_shifts.csv). One
scale a picture, the best over the whole head; then by region (outlines in data/portrait_regions.json) the
squared error, summed over pictures, over the truth's; and SSIM of the scaled pictures, clipped to 0..1.
"""

import csv
import json
import math
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from _common import BENCHMARK_DATA, WHOLE_YALE_B, arguments, required
from PIL import Image, ImageDraw
from skimage.metrics import structural_similarity

from facerf_cli.light.sphere import azel_to_direction

REGIONS = ("face", "hair", "ears", "neck")
SIZE_PX = (640, 480)
_LEAST_DEG, _LEAST_PX = 12, 100  # between the lights; of a region
_LIGHT = re.compile(r"A([+-]\d+)E([+-]\d+)")
Pair = tuple[str, str, str]  # subject, light of the source, light of the target


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--data", type=Path, help="folder of the frames")
    parser.add_argument("--export", type=Path)
    parser.add_argument("--predictions", type=Path)
    parser.add_argument("--copy", action="store_true")
    given = parser.parse_args()
    data = required(given.data, "uncropped frames of Extended Yale B", "--data", WHOLE_YALE_B)
    if given.export:
        export(data, given.export)
    elif given.predictions:
        print_table({"predictions": scores(data, lambda *pair: prediction(given.predictions, *pair))})
    else:
        print_table({"the photo left as it is": scores(data, lambda *pair: frame(data, *pair[:2]))})


@cache
def frames(data: Path) -> dict[str, dict[str, Path]]:
    """Paths by subject and light, such as A+035E+15."""
    found: dict[str, dict[str, Path]] = {}
    for path in sorted(data.glob("yaleB*_P00A*")):
        subject, name = path.name.split("_P00")
        found.setdefault(subject, {})[name[:9]] = path
    return found


@cache
def frame(data: Path, subject: str, light: str) -> np.ndarray:
    """A frame [H, W], linear, without ambient light where that was photographed."""

    def read(path: Path) -> np.ndarray:
        return np.asarray(Image.open(path).convert("L"), np.float32) / 255

    image, ambient = read(frames(data)[subject][light]), data / f"{subject}_P00_Ambient.pgm"
    return np.asarray((image - read(ambient)).clip(0)) if ambient.exists() else image


def angles_deg(light: str) -> tuple[int, int]:
    """Azimuth, > 0 from the picture's right, and elevation."""
    found = _LIGHT.fullmatch(light)
    assert found
    return -int(found[1]), int(found[2])


def pairs(data: Path) -> Iterator[Pair]:
    """Every ordered pair of a subject's frames whose lights differ enough."""
    for subject, lights in frames(data).items():
        directions = {light: azel_to_direction(*angles_deg(light)).double() for light in lights}
        for source, toward in directions.items():
            for target, other in directions.items():
                cosine = min(1.0, max(-1.0, float(toward @ other)))
                if math.degrees(math.acos(cosine)) >= _LEAST_DEG:
                    yield subject, source, target


def moved(image: np.ndarray, down: int, right: int) -> np.ndarray:
    """An image [H, W] moved by whole pixels; what comes from beyond its border is NaN."""
    out, (h, w) = np.full_like(image, np.nan), image.shape
    kept = image[max(-down, 0) : h - max(down, 0), max(-right, 0) : w - max(right, 0)]
    out[max(down, 0) : h + min(down, 0), max(right, 0) : w + min(right, 0)] = kept
    return out


@cache
def shifts() -> dict[tuple[str, str], tuple[int, int]]:
    """How far down and right the head of a frame lies from that of its subject's reference."""
    with (BENCHMARK_DATA / "portrait_shifts.csv").open() as file:
        return {
            (row["subject"], row["light"]): (int(row["dy"]), int(row["dx"])) for row in csv.DictReader(file)
        }


@cache
def outlined(subject: str) -> dict[str, np.ndarray]:
    """Masks [H, W] of the regions in a subject's reference; the face's is cut out of the others."""
    found: dict[str, np.ndarray] = {}
    outlines = json.loads((BENCHMARK_DATA / "portrait_regions.json").read_text())[subject]
    for name in REGIONS:
        canvas = Image.new("L", SIZE_PX)
        for polygon in outlines[name]:
            ImageDraw.Draw(canvas).polygon([tuple(point) for point in polygon], fill=1)
        found[name] = np.asarray(canvas, bool) & ~found.get("face", np.zeros(SIZE_PX[::-1], bool))
    return {**found, "head": np.any(list(found.values()), 0)}


def truth(data: Path, subject: str, source: str, target: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The target [H, W] on its source, 0 where it is unknown, and masks [H, W] of regions there."""
    at, to = shifts()[subject, source], shifts()[subject, target]
    image = moved(frame(data, subject, target), at[0] - to[0], at[1] - to[1])
    known, masks = np.isfinite(image), outlined(subject).items()
    there = {name: (np.nan_to_num(moved(mask.astype(np.float32), *at)) > 0.5) & known for name, mask in masks}
    return np.nan_to_num(image), there


def scaled(image: np.ndarray, wanted: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """An image under its best scale inside a mask."""
    return np.asarray(image * ((image * wanted)[mask].sum() / max(np.square(image)[mask].sum(), 1e-12)))


def similarity(image: np.ndarray, wanted: np.ndarray, head: np.ndarray) -> np.ndarray:
    """SSIM [H, W] of images that are clipped at white, black beyond the head."""
    local = structural_similarity(
        np.clip(image, 0, 1) * head,
        wanted * head,
        data_range=1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )[1]
    return np.asarray(local)


def scores(
    data: Path, prediction_of: Callable[[str, str, str], np.ndarray], chosen: Iterator[Pair] | None = None
) -> dict[str, dict[str, tuple[float, float]]]:
    """Relative squared error and SSIM by group (all, each subject) and region, for all pairs or some."""
    rows: list[tuple[str, str, float, float, float]] = []
    for pair in chosen or pairs(data):
        wanted, regions = truth(data, *pair)
        image = scaled(prediction_of(*pair), wanted, regions["head"])
        alike = similarity(image, wanted, regions["head"])
        for name, mask in regions.items():
            if mask.sum() > _LEAST_PX:
                error, power = np.square(image - wanted)[mask].mean(), np.square(wanted)[mask].mean()
                rows.append((pair[0], name, float(error), float(power), float(alike[mask].mean())))
    table: dict[str, dict[str, tuple[float, float]]] = {}
    for group in ("all", *sorted({row[0] for row in rows})):
        of_group = [row for row in rows if group in ("all", row[0])]
        table[group] = {}
        for region in (*REGIONS, "head"):
            if found := [row[2:] for row in of_group if row[1] == region]:
                error, power, alike_sum = np.sum(found, 0)
                table[group][region] = error / power, alike_sum / len(found)
    return table


def print_table(tables: dict[str, dict[str, Any]]) -> None:
    """Print relative error and SSIM by region, a line for each method and group."""
    regions = (*REGIONS, "head")
    print("| | " + " | ".join(regions) + " |\n" + "|---" * (len(regions) + 1) + "|")
    for name, table in tables.items():
        for group, found in table.items():
            cells = [
                "{:.4f} / {:.3f}".format(*found[region]) if region in found else "" for region in regions
            ]
            print(f"| {name}, {group} | " + " | ".join(cells) + " |")


def prediction(folder: Path, subject: str, source: str, target: str) -> np.ndarray:
    """A predicted image [480, 640] of a folder."""
    found = [folder / subject / source / f"{target}{suffix}" for suffix in (".npy", ".exr", ".png")]
    path = next((one for one in found if one.exists()), None)
    if path is None:
        raise SystemExit(f"{found[0].with_suffix('')}: no prediction (.npy, .exr or .png)")
    if path.suffix == ".npy":
        image = np.load(path, allow_pickle=False)
    else:
        image = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)
    image = image[..., :3].mean(-1) if image.ndim == 3 else image
    if image.shape != SIZE_PX[::-1]:
        raise SystemExit(f"{path}: predictions have 640 x 480 pixels and lie on their source")
    return np.asarray(image, np.float32)


def export(data: Path, folder: Path) -> None:
    """Write the sources and the list of cases for another program."""
    listed: list[dict[str, Any]] = []
    for subject, source, target in pairs(data):
        path = folder / subject / f"{source}.png"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray((frame(data, subject, source) * 65535).astype(np.uint16)).save(path)
        az_deg, el_deg = angles_deg(target)
        listed.append(dict(subject=subject, source=source, target=target, az_deg=az_deg, el_deg=el_deg))
    (folder / "cases.json").write_text(json.dumps(listed, indent=0))
    print(f"{len(listed)} cases")


if __name__ == "__main__":
    main()
