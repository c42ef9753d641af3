"""Time of 150 OLATs of a face: facerf's way beside a whole forward pass a light.

    python benchmarks/olat.py [--lights 150] [--sides 256 512] [--checkpoint FILE]

The naive way runs encoder and decoder anew for every light. Also: writing and reading them as a stack.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.topology import LAYOUT_VERSION, grid_triangles
from facerf_cli.files.olat_stack import StackHeader, read_olat_stack, write_olat_stack
from facerf_cli.light.sphere import rig_directions
from facerf_cli.pipeline import FaceTexture, Models, load_models, predict_olat
from facerf_cli.raster.texture import normal_map

T = TypeVar("T")
_ROUNDS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--lights", type=int, default=150)
    parser.add_argument("--sides", type=int, nargs="+", default=[256, 512])
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    models = load_models(arguments.checkpoint, "builtin", torch.device(arguments.device))
    print(f"{arguments.lights} lights, {torch.get_num_threads()} threads, {arguments.device}")
    for side in arguments.sides:
        measure(models, some_face(models, side), rig_directions(arguments.lights))


def measure(models: Models, face: FaceTexture, lights: Tensor) -> None:
    """Print times of one texture's side, the two ways in one run."""
    ways: dict[str, Callable[[], Tensor]] = {
        "ours": lambda: torch.cat(list(predict_olat(models, face, lights))),
        "in bf16": lambda: torch.cat(list(predict_olat(models, face, lights, bf16=True))),
        "naive": lambda: naive(models, face, lights),
    }
    best_s = dict.fromkeys(ways, float("inf"))
    olats: dict[str, Tensor] = {}
    for _ in range(_ROUNDS):  # by turns, so that whatever else the machine does falls on all alike
        for name, way in ways.items():
            seconds, olats[name] = timed(way)
            best_s[name] = min(best_s[name], seconds)
    worst = float((olats["ours"] - olats["naive"]).abs().max())
    times = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in best_s.items())
    print(
        f"T={len(face.visible)}: {times}; naive takes {best_s['naive'] / best_s['ours']:.2f} times as long, "
        f"{best_s['naive'] / best_s['in bf16']:.2f} times as bf16; largest difference {worst:.1e}"
    )
    time_files(face, lights, olats["ours"])


def some_face(models: Models, side: int) -> FaceTexture:
    """The mean face in a made-up skin."""
    vertices = models.face.mean + torch.tensor([0.0, 0.0, -1.0])
    texture = 0.2 + 0.1 * torch.rand(3, side, side, generator=torch.Generator().manual_seed(0))
    return FaceTexture(texture, torch.ones(side, side), normal_map(vertices, grid_triangles(), side))


@torch.no_grad()
def naive(models: Models, face: FaceTexture, lights: Tensor) -> Tensor:
    """A forward pass of the whole network a light."""
    inputs = [x[None].to(models.device) for x in (face.texture, face.normals, face.visible[None])]
    network = models.network
    each = (
        network.decode(network.encode(*inputs), inputs[1], light[None, None].to(models.device))
        for light in lights
    )
    return torch.cat([olat[0].cpu() for olat in each])


def time_files(face: FaceTexture, lights: Tensor, olats: Tensor) -> None:
    source, normals = (x.permute(1, 2, 0).numpy() for x in (face.texture, face.normals))
    seen = face.visible.numpy()
    header = StackHeader("texture", lights.numpy(), np.eye(3), source, seen, normals, LAYOUT_VERSION, {})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "olat.exr")
        write_s, _ = timed(lambda: write_olat_stack(path, header, [olats]))
        read_s, _ = timed(lambda: read_olat_stack(path))
        print(
            f"  stack: written in {write_s:.2f} s, read in {read_s:.2f} s, {path.stat().st_size / 1e6:.1f} MB"
        )


def timed(work: Callable[[], T]) -> tuple[float, T]:
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


if __name__ == "__main__":
    main()
