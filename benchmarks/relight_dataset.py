"""Relighting a subject: weights times OLAT stack, beside a bare torch.matmul and a loop over lights.

    python benchmarks/relight_dataset.py [--side 256] [--lights 150] [--pictures 250] [--threads 1]

Ours begins with the stack as it is read (half floats, light by light) and ends with pictures in half floats;
the bare matmul is handed float32 matrices and only multiplies. Disk is left out of both; what reading the
stack and writing the pictures take is shown for information.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.dataset.relight import multiply
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.images import write_exr
from facerf_cli.files.olat_stack import StackHeader, read_olats, write_olat_stack
from facerf_cli.light.envmap import rotated_weights
from facerf_cli.light.sphere import rig_directions
from facerf_cli.synth.sky.skies import draw_sky

_ROUNDS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--side", type=int, default=256)
    parser.add_argument("--lights", type=int, default=150)
    parser.add_argument("--pictures", type=int, default=250)
    parser.add_argument("--threads", type=int, default=1, help="ours takes one; this is for the others")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    olats = some_stack(given.lights, given.side)
    weights = some_weights(given.lights, given.images)
    print(
        f"{given.images} pictures of {given.side} x {given.side} pixels from {given.lights} lights, "
        f"{torch.get_num_threads()} threads"
    )
    measure_product(olats, weights)
    measure_disk(olats, weights)


def measure_product(olats: Tensor, weights: Tensor) -> None:
    """Print times of the three ways, and how far ours is from float32."""
    images = torch.empty(len(weights), *olats.shape[1:], dtype=torch.float16)
    stack = olats.permute(1, 0, 2, 3).reshape(3, len(olats), -1).float()  # [3, L, P]
    by_channel = weights.permute(2, 0, 1).contiguous()  # [3, M, L]
    few = max(1, len(weights) // 25)
    ways: dict[str, Callable[[], object]] = {
        "ours": lambda: multiply(olats, weights, images),
        "bare torch.matmul": lambda: torch.matmul(by_channel, stack),
        "loop over lights": lambda: naive(olats, weights[:few]),
    }
    best_s = dict.fromkeys(ways, float("inf"))
    for _ in range(_ROUNDS):  # by turns, so that whatever else the machine does falls on all alike
        for name, way in ways.items():
            best_s[name] = min(best_s[name], timed(way))
    best_s["loop over lights"] *= len(weights) / few
    operations = 2 * weights.numel() * olats[0, 0].numel()
    for name, seconds in best_s.items():
        share = best_s["bare torch.matmul"] / seconds
        rate = operations / seconds / 1e9
        print(
            f"  {name:18s} {seconds:8.3f} s  {rate:7.1f} GFLOP/s  {share:5.2f} of bare torch.matmul's speed"
        )
    truth = torch.matmul(by_channel[:, :few], stack).transpose(0, 1).reshape(few, *olats.shape[1:])
    difference = relative(images[:few].float(), truth)
    print(f"  largest relative difference to float32: {difference:.1e} (half a step of halfs is 4.9e-4)")


def naive(olats: Tensor, weights: Tensor) -> Tensor:
    """Picture by picture, light by light."""
    images = torch.zeros(len(weights), *olats.shape[1:])
    for image, weight in zip(images, weights, strict=True):
        for olat, rgb in zip(olats, weight, strict=True):
            image += rgb[:, None, None] * olat.float()
    return images


def measure_disk(olats: Tensor, weights: Tensor) -> None:
    """Print what reading the stack and writing the pictures take."""
    side = olats.shape[-1]
    normals = np.zeros((side, side, 3), np.float32)
    directions = rig_directions(len(olats)).numpy()
    blank = normals[..., 0]
    header = StackHeader("image", directions, np.eye(3), normals, blank, normals, LAYOUT_VERSION, {})
    images = torch.empty(8, *olats.shape[1:], dtype=torch.float16)
    multiply(olats, weights[:8], images)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "stack.exr")
        write_olat_stack(path, header, [olats])
        read_s = min(timed(lambda: read_olats(path)) for _ in range(2))
        megabytes, packed = 2 * olats.numel() / 1e6, path.stat().st_size / 1e6
        print(f"  stack read in {read_s:.2f} s: {megabytes / read_s:.0f} MB/s ({packed:.0f} MB on disk)")
        pixels = [image.permute(1, 2, 0).float().numpy() for image in images]
        write_s = timed(lambda: [write_exr(Path(folder, f"{i}.exr"), x) for i, x in enumerate(pixels)]) / 8
        size = Path(folder, "0.exr").stat().st_size / 1e3
        print(f"  a picture written in {1000 * write_s:.1f} ms ({size:.0f} kB)")


def some_stack(lights: int, side: int) -> Tensor:
    """A lit ball with grain [L, 3, H, W] float16, in memory as a stack is that was read."""
    line = torch.linspace(-1, 1, side)
    y, x = torch.meshgrid(-line, line, indexing="ij")
    z = (1 - x * x - y * y).clamp_min(0).sqrt()
    cosine = torch.einsum("lc,chw->lhw", rig_directions(lights), torch.stack([x, y, z])).clamp_min(0) * (
        z > 0
    )
    grain = 0.3 + 0.1 * torch.rand(3, side, side, generator=torch.Generator().manual_seed(0))
    stack = torch.empty(lights, side, side, 3, dtype=torch.float16).permute(0, 3, 1, 2)
    return stack.copy_(cosine[:, None] * grain)


def some_weights(lights: int, images: int) -> Tensor:
    """Weights [M, L, 3] of procedural skies."""
    turns = tuple(360 * k / 10 for k in range(10))
    maps = [torch.from_numpy(draw_sky(index, 0, 128)[0]) for index in range(-(-images // 10))]
    return torch.cat([rotated_weights(sky, rig_directions(lights), turns) for sky in maps])[:images]


def relative(values: Tensor, truth: Tensor) -> float:
    bright = truth > 1e-3
    return float(((values - truth).abs() / truth)[bright].max())


def timed(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
