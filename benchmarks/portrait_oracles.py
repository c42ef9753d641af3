"""What would be left of the portrait benchmark's error if parts of the truth were known; what a room adds.

    python benchmarks/portrait_oracles.py --predictions FOLDER [--data DIR]

FOLDER holds images as `portrait.py` reads them. Relative error by region (squared error over
the truth's, under one scale of the head) and the head's SSIM: of the images as they are; with the right scale
of each region; and times the ratio to the truth, blurred by a Gaussian of some pixels, which leaves only
finer errors. *room*: so much of the light replaced by the photo's own, as a room sends it back.
"""

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import portrait
from _common import WHOLE_YALE_B, arguments, required
from portrait import scaled, similarity
from scipy.ndimage import gaussian_filter

BLURS_PX = (40, 20, 10, 5)
ROOMS = (0.03, 0.06, 0.1, 0.15)
DARK = 1e-4


def main() -> None:
    """Print a table for all subjects and for each."""
    parser = arguments(__doc__)
    parser.add_argument("--predictions", type=Path)
    parser.add_argument("--data", type=Path)
    given = parser.parse_args()
    data = required(given.data, "uncropped frames of Extended Yale B", "--data", WHOLE_YALE_B)
    folder = required(given.predictions, "predicted images", "--predictions")
    sums: dict[tuple[str, str, str], np.ndarray] = defaultdict(lambda: np.zeros(2))
    for subject, source, target in portrait.pairs(data):
        photo = portrait.frame(data, subject, source)
        truth, regions = portrait.truth(data, subject, source, target)
        relit = scaled(portrait.prediction(folder, subject, source, target), truth, regions["head"])
        images = list(candidates(photo, relit, truth, regions["head"]))
        for name, image in images:
            for group in ("all", subject):
                sums[group, name, "SSIM"] += (
                    similarity(image, truth, regions["head"])[regions["head"]].mean(),
                    1,
                )
        for region, mask in regions.items():
            for name, image in (*images, ("region's scale known", scaled(relit, truth, mask))):
                error = np.square(image - truth)[mask].mean(), np.square(truth)[mask].mean()
                for group in ("all", subject):
                    sums[group, name, region] += error
    for group in sorted({key[0] for key in sums}):
        for name in dict.fromkeys(key[1] for key in sums):
            cells = {
                r: sums[group, name, r]
                for r in (*portrait.REGIONS, "head", "SSIM")
                if (group, name, r) in sums
            }
            shown = "  ".join(f"{region} {error / total:.3f}" for region, (error, total) in cells.items())
            print(f"{group:8} {name:22} {shown}")


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


if __name__ == "__main__":
    main()
