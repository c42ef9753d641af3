"""What would be left of the portrait benchmark's error if parts of the truth were known; what a room adds.

    python benchmarks/portrait_oracles.py --pred PRED [--bench DIR]

PRED holds the images that the benchmark's `facerf_all.py` makes. Relative error by region (squared error over
the truth's, under one scale of the head) and the head's SSIM: of the images as they are; with the right scale
of each region; and times the ratio to the truth, blurred by a Gaussian of some pixels, which leaves only
finer errors. *room*: so much of the light replaced by the photo's own, as a room sends it back.
"""

import importlib.util
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
from _common import SHARED, arguments, required
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity

BLURS_PX = (40, 20, 10, 5)
ROOMS = (0.03, 0.06, 0.1, 0.15)
DARK = 1e-4


def main() -> None:
    """Print a table for all subjects and for each."""
    parser = arguments(__doc__)
    parser.add_argument("--pred", type=Path)
    parser.add_argument("--bench", type=Path)
    given = parser.parse_args()
    bench = benchmark(
        required(given.bench, "the portrait benchmark", "--bench", SHARED / "bench" / "portrait")
    )
    pred = required(given.pred, "images of facerf_all.py", "--pred")
    sums: dict[tuple[str, str, str], np.ndarray] = defaultdict(lambda: np.zeros(2))
    for subject, photo, relit, truth, regions in pairs(bench, pred):
        images = list(candidates(photo, relit, truth, regions["head"]))
        for name, image in images:
            for group in ("all", subject):
                sums[group, name, "SSIM"] += similarity(image, truth, regions["head"]), 1
        for region, mask in regions.items():
            for name, image in (*images, ("region's scale known", scaled(relit, truth, mask))):
                error = np.square(image - truth)[mask].mean(), np.square(truth)[mask].mean()
                for group in ("all", subject):
                    sums[group, name, region] += error
    for group in sorted({key[0] for key in sums}):
        for name in dict.fromkeys(key[1] for key in sums):
            cells = {
                r: sums[group, name, r] for r in (*bench.REGIONS, "head", "SSIM") if (group, name, r) in sums
            }
            shown = "  ".join(f"{region} {error / total:.3f}" for region, (error, total) in cells.items())
            print(f"{group:8} {name:22} {shown}")


def benchmark(folder: Path) -> ModuleType:
    """The benchmark's own script, for its pairs, regions and alignment."""
    spec = importlib.util.spec_from_file_location("portrait_benchmark", folder / "portrait.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pairs(
    bench: ModuleType, pred: Path
) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]]:
    """Subject, photo, relit image under the head's best scale and truth [H, W], masks [H, W] of regions."""
    shifts = bench.shifts()
    for subject, source, target in bench.cases(bench.DATA):
        at, to = shifts[subject, source], shifts[subject, target]
        truth = bench.moved(bench.picture(bench.DATA, subject, target), at[0] - to[0], at[1] - to[1])
        known = np.isfinite(truth)
        truth = np.nan_to_num(truth)
        regions = {
            name: (np.nan_to_num(bench.moved(mask.astype(np.float32), *at)) > 0.5) & known
            for name, mask in bench.masks(subject).items()
        }
        relit = bench.load(next((pred / subject / source).glob(f"{target}.*")))
        photo = bench.picture(bench.DATA, subject, source)
        seen = {name: mask for name, mask in regions.items() if mask.sum() > 100}  # as the benchmark
        yield subject, photo, scaled(relit, truth, regions["head"]), truth, seen


def candidates(
    photo: np.ndarray, relit: np.ndarray, truth: np.ndarray, head: np.ndarray
) -> Iterator[tuple[str, np.ndarray]]:
    """Names and images [H, W], given the mask of the head."""
    yield "as they are", relit
    for blur_px in BLURS_PX:
        wide = [gaussian_filter(image * head, blur_px) for image in (truth, relit)]
        yield f"ratio known, {blur_px} px", relit * wide[0] / np.maximum(wide[1], DARK)
    for room in ROOMS:
        own = photo * (relit[head].mean() / photo[head].mean())
        yield f"room of {room:.0%}", scaled((1 - room) * relit + room * own, truth, head)


def similarity(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """SSIM inside a mask, as the benchmark measures it."""
    local = structural_similarity(
        np.clip(image, 0, 1) * mask,
        truth * mask,
        data_range=1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )[1]
    return float(local[mask].mean())


def scaled(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """An image under its best scale inside a mask."""
    return np.asarray(image * ((image * truth)[mask].sum() / max(np.square(image)[mask].sum(), DARK)))


if __name__ == "__main__":
    main()
