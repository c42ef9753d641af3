#!/usr/bin/env python
"""Write photographs in natural light of the people of a prepared dataset: they stand for FFHQ in training.

    python examples/natural_photos.py DATASET OUT [EACH]

Each source of `facerf relight-dataset` (the first EACH of a person, none of the split test) is laid over its
own environment map, as a lens sees it out of focus, and written as an 8-bit JPEG. `facerf train
--preset paper --photos OUT` detects the faces as in any photos.
"""

import math
import sys
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.dataset.pairs import Pair, image_path, read_pairs
from facerf_cli.dataset.weights import read_envmap
from facerf_cli.files.olat_stack import read_olat_header
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.light.sphere import direction_to_uv

VIEW_DEG = 40.0  # angle that the background spans
BLUR_PX = 2.5
COVERED = 0.004  # radiance under a constant map of radiance 1 above which a pixel shows the person


def background(pair: Pair, side: int) -> np.ndarray:
    """The environment map behind the person [side, side, 3], blurred."""
    envmap = read_envmap(pair.envmap).numpy()
    reach = math.tan(math.radians(VIEW_DEG / 2))
    along = np.linspace(-reach, reach, side)
    x, y = np.meshgrid(along, -along)
    directions = np.stack([x, y, np.full_like(x, -1.0)], -1)
    turn = math.radians(-pair.rotate_deg)
    around_y = np.array(
        [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]]
    )
    u, v = direction_to_uv(torch.from_numpy(directions @ around_y.T)).unbind(-1)
    height, width = envmap.shape[:2]
    column = (u.numpy() * width).astype(int) % width
    row = (v.numpy() * height).astype(int).clip(0, height - 1)
    seen = envmap[row, column] * 2.0**pair.exposure_ev
    blurred: np.ndarray = gaussian_filter(seen, (BLUR_PX, BLUR_PX, 0))
    return blurred


def main(folder: Path, out: Path, each: int) -> None:
    """Write a photo of each pair that is not of the split test, of up to `each` a person."""
    dataset = read_dataset(folder)
    for pair in read_pairs(dataset):
        if pair.split == "test" or pair.index >= each:
            continue
        person = read_image(image_path(dataset, *pair.key)).pixels
        stack = read_olat_header(dataset.stack_path(pair.subject, pair.source_camera))
        shown = stack.source.max(-1) > COVERED
        alpha = gaussian_filter(shown.astype(np.float32), 0.7)[..., None]
        photo = person * alpha + background(pair, len(person)) * (1 - alpha)
        out.mkdir(parents=True, exist_ok=True)
        write_display(out / f"{pair.subject}_{pair.index:05d}.jpg", photo.astype(np.float32), "auto")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else sys.maxsize)
