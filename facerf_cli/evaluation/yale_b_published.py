"""What others reach on Extended Yale B: the benchmark's own figures, of the same pictures.

From the README of that benchmark, over 21 subjects: Si-MSE and SSIM by kind of source and target, and Si-MSE
by the angle between flash and camera. DPR: Zhou et al., ICCV 2019. GeomConsistentFR: Hou et al., CVPR 2022.
The methods in `TOLD_MORE` learn from other subjects under the same flashes, which one photo does not tell.
"""

from itertools import pairwise

from facerf_cli.evaluation.paper import Published
from facerf_cli.evaluation.yale_b_cases import ANGLES_DEG

COLUMNS = ("frontal", "soft", "environment")
PEERS = ("DPR", "GeomConsistentFR")
SHOWN = ("copy of the source", *PEERS, "quotient image")  # beside ours
TOLD_MORE = ("others' mean", "others' Lambert", "quotient image")
PUBLISHED_SUBJECTS = 21
_SOURCE = "Yale B"
_SAME = f"same pictures, {PUBLISHED_SUBJECTS} people"
_KNOWS = _SAME + ", told more"

# (Si-MSE, SSIM) by column, then Si-MSE by angle.
FIGURES: dict[str, tuple[tuple[tuple[float, float], ...], tuple[float, ...]]] = {
    "copy of the source": (
        ((0.0299, 0.609), (0.0512, 0.495), (0.0361, 0.646)),
        (0.0044, 0.0122, 0.0308, 0.0540, 0.0570),
    ),
    "DPR": (
        ((0.0111, 0.686), (0.0131, 0.641), (0.0145, 0.729)),
        (0.0057, 0.0080, 0.0122, 0.0164, 0.0155),
    ),
    "GeomConsistentFR": (
        ((0.0119, 0.674), (0.0151, 0.629), (0.0145, 0.709)),
        (0.0055, 0.0101, 0.0139, 0.0178, 0.0145),
    ),
    "others' mean": (
        ((0.0123, 0.610), (0.0123, 0.619), (0.0121, 0.654)),
        (0.0123, 0.0129, 0.0131, 0.0150, 0.0100),
    ),
    "others' Lambert": (
        ((0.0092, 0.672), (0.0125, 0.616), (0.0109, 0.760)),
        (0.0025, 0.0055, 0.0119, 0.0151, 0.0134),
    ),
    "quotient image": (
        ((0.0074, 0.751), (0.0093, 0.724), (0.0078, 0.789)),
        (0.0024, 0.0046, 0.0094, 0.0120, 0.0105),
    ),
}


def published() -> tuple[Published, ...]:
    """The rows to stand beside ours."""
    rows: list[Published] = []

    def add(method: str, metric: str, mean: float, group: tuple[str, str], digits: int) -> None:
        data = _KNOWS if method in TOLD_MORE else _SAME
        rows.append(Published(method, metric, mean, None, group, _SOURCE, data, digits))

    for method in SHOWN:
        by_column, by_angle = FIGURES[method]
        for column, (si_mse, ssim) in zip(COLUMNS, by_column, strict=True):
            add(method, "si_mse", si_mse, ("column", column), 4)
            add(method, "ssim", ssim, ("column", column), 3)
        for (low, high), si_mse in zip(pairwise(ANGLES_DEG), by_angle, strict=True):
            add(method, "si_mse", si_mse, ("angle", f"{low}-{high} deg"), 4)
    return tuple(rows)
