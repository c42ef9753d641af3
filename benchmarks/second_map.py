"""What a second environment map costs beside the first, on the example portrait.

    python benchmarks/second_map.py [--texture-size 256] [--threads 1]

The first map pays for 150 predicted lights; every further map or rotation for its weights, one matrix product
in the texture's space, and one composite at the photo's resolution. The peer predicts again for each map.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch

from facerf_cli.composite import Surround, composite
from facerf_cli.face.landmarks import find_faces
from facerf_cli.face.view import photo_camera, view_face
from facerf_cli.files.images import read_image
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sphere import rig_directions
from facerf_cli.pipeline import crop_face, fit_face, load_models, predict_olat, unwrap_face, weigh

EXAMPLES = Path(__file__).parents[1] / "examples"
T = TypeVar("T")


def timed(label: str, step: Callable[[], T]) -> T:
    start_s = time.perf_counter()
    result = step()
    print(f"{label:58s} {1000 * (time.perf_counter() - start_s):9.1f} ms")
    return result


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--texture-size", type=int, default=256)
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    models = load_models(None, "builtin", torch.device("cpu"))
    photo = read_image(EXAMPLES / "astronaut.jpg").pixels
    landmarks_px = find_faces(photo, "astronaut")[0].landmarks_px
    crop, cropped = crop_face(photo, landmarks_px, 2 * given.texture_size)
    fit = fit_face(models.face, crop, landmarks_px, photo.shape)
    face = unwrap_face(models.face, fit, cropped, given.texture_size, photo.shape)
    vertices, size_px = fit.vertices_camera(models.face), photo.shape[:2]
    view = timed("face seen by the photo's camera, once a face",
                 lambda: view_face(vertices, photo_camera(crop, *size_px), crop.side_px))  # fmt: skip
    around = timed("its surroundings, once a face", lambda: Surround(vertices, crop, *size_px))
    rig = rig_directions()
    olats = timed("150 lights, once a face, and what the peer pays a map",
                  lambda: torch.cat(list(predict_olat(models, face, rig))))  # fmt: skip
    for path in sorted((EXAMPLES / "maps").glob("*.exr")):
        envmap = torch.from_numpy(read_image(path).pixels)
        weights = timed(f"{path.stem}: weights", lambda envmap=envmap: envmap_weights(envmap, rig))
        relit = timed(f"{path.stem}: product", lambda weights=weights: weigh(olats, weights[None])[0])
        timed(f"{path.stem}: composite", lambda relit=relit: composite(
            photo, face.texture, relit, face.visible, view, around))  # fmt: skip


if __name__ == "__main__":
    main()
