"""Whole heads of real people under single flashes, relit by facerf: relative error and SSIM by region.

    python benchmarks/whole_heads.py [--data DIR] [--every N] [--people yaleB15,...] [--checkpoint FILE]

Pairs and scores are those of `portrait.py`; each source is fitted once. The twin is the photo left as it is.
"""

import sys
from pathlib import Path

import numpy as np
import portrait
import torch
from _common import WHOLE_YALE_B, arguments, required

from facerf_cli.errors import FacerfError
from facerf_cli.light.sphere import RigLight, azel_to_direction
from facerf_cli.person import fit
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.models import load_models


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--data", type=Path, help="folder of the frames")
    parser.add_argument("--every", type=int, default=1, help="of the sources, only each Nth")
    parser.add_argument("--people", default="yaleB01,yaleB11,yaleB15")
    parser.add_argument(
        "--checkpoint", type=Path, nargs="*", default=[], help="networks in place of the shipped"
    )
    given = parser.parse_args()
    data = required(given.data, "uncropped frames of Extended Yale B", "--data", WHOLE_YALE_B)
    models, people = load_models(given.checkpoint), given.people.split(",")
    pairs = [pair for pair in portrait.pairs(data) if pair[0] in people]
    sources = sorted({pair[:2] for pair in pairs})[:: given.every]
    relit: dict[portrait.Pair, np.ndarray] = {}
    for subject, source in sources:
        photo = np.repeat(portrait.frame(data, subject, source)[..., None], 3, -1).astype(np.float32)
        try:
            person = fit(
                models,
                photo,
                white_balance=None,
                face=find_faces(models.networks.people, photo, source)[0],
            )
        except FacerfError as error:
            print(f"{subject} {source}: {error}", file=sys.stderr)
            continue
        for pair in (pair for pair in pairs if pair[:2] == (subject, source)):
            light = RigLight(azel_to_direction(*portrait.angles_deg(pair[2]))[None], torch.ones(1, 3))
            relit[pair] = person.image(light).mean(-1)
    methods = {
        "the photo left as it is": lambda *pair: portrait.frame(data, *pair[:2]),
        "relit": lambda *pair: relit[pair],
    }
    portrait.print_table(
        {name: portrait.scores(data, method, iter(relit)) for name, method in methods.items()}
    )


if __name__ == "__main__":
    main()
