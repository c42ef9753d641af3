"""Whole heads of real people under single flashes: relative error and SSIM by region.

    python benchmarks/whole_heads.py [--bench DIR] [--every N] [--people yaleB15,...]

270 pairs of three people of Extended Yale B, each source fitted once (`bench/portrait` of the test data,
which holds outlines, alignment and scores). The twin is the photo left as it is.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from _common import SHARED, arguments, required
from portrait_oracles import benchmark

from facerf_cli.errors import FacerfError
from facerf_cli.light.sphere import RigLight, azel_to_direction
from facerf_cli.pipeline import find_for, fit
from facerf_cli.relighting.models import load_models

REGIONS = ("face", "hair", "ears", "neck", "head")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--bench", type=Path, help="the folder of portrait.py")
    parser.add_argument("--every", type=int, default=1, help="of the sources, only each Nth")
    parser.add_argument("--people", default="yaleB01,yaleB11,yaleB15")
    given = parser.parse_args()
    bench = benchmark(
        required(given.bench, "the portrait benchmark", "--bench", SHARED / "bench" / "portrait")
    )
    models, people = load_models(), given.people.split(",")
    pairs = [pair for pair in bench.cases(bench.DATA) if pair[0] in people]
    sources = sorted({pair[:2] for pair in pairs})[:: given.every]
    relit, left = {}, {}
    for subject, source in sources:
        picture = bench.picture(bench.DATA, subject, source)
        photo = np.repeat(picture[..., None], 3, -1).astype(np.float32)
        try:
            person = fit(models, photo, find_for(models.networks.people, "landmarks", photo, source)[0])
        except FacerfError as error:
            print(f"{subject} {source}: {error}", file=sys.stderr)
            continue
        for pair in (pair for pair in pairs if pair[:2] == (subject, source)):
            azimuth_deg, elevation_deg = bench.angles(pair[2])
            light = RigLight(azel_to_direction(azimuth_deg, elevation_deg)[None], torch.ones(1, 3))
            relit[pair], left[pair] = person.image(light).pixels.mean(-1), picture
    bench.cases = lambda _: iter(relit)
    print("| | " + " | ".join(REGIONS) + " |\n" + "|---" * (len(REGIONS) + 1) + "|")
    for name, images in (("the photo left as it is", left), ("relit", relit)):
        scores = bench.score(bench.DATA, lambda *pair, images=images: images[pair])
        for group in ("all", *people):
            cells = [
                f"{found['si_rel']:.4f} / {found['ssim']:.3f}"
                for region in REGIONS
                if (found := scores.get(f"{group}/{region}"))
            ]
            print(f"| {name}, {group} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
