"""The cost of relighting: OLATs of a face, one more envmap, and the images of a dataset.

    python benchmarks/relighting_speed.py [--lights 150] [--side 256] [--images 250]

- OLATs of a texture. Naive twin: the whole network, encoder too, once for each light.
- One more envmap on the example photo. Naive twin: the lights are predicted again for each map.
- A dataset's images: a stack's half floats times weights, to half floats. Peer: a bare torch.matmul of
  float32 matrices. Naive twin: a loop over images and lights.

Times are the best of a few rounds, in which the ways take turns.
"""

from collections.abc import Callable
from pathlib import Path

import torch
from _common import ASTRONAUT, ROOT, arguments, best_s
from torch import Tensor

from facerf_cli.dataset.weights import multiply
from facerf_cli.face.head import FaceTexture
from facerf_cli.face.topology import grid_triangles
from facerf_cli.files.images import read_image
from facerf_cli.light.envmap import envmap_weights, rotated_weights
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.studio_points import Lights
from facerf_cli.pipeline import fit_photo, reflectance_of
from facerf_cli.portrait.find import find_faces
from facerf_cli.raster.texture import normal_map
from facerf_cli.relighting.composition import Composition
from facerf_cli.relighting.field import Field
from facerf_cli.relighting.models import Models, load_models
from facerf_cli.synth.sky.skies import draw_sky

_ROUNDS = 3
_LOOPED = 25  # a loop over lights makes one in so many images


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--lights", type=int, default=150)
    parser.add_argument("--side", type=int, default=256, help="texels and pixels along a side")
    parser.add_argument("--images", type=int, default=250, help="of the dataset")
    parser.add_argument("--checkpoint", type=Path, help="default: the shipped one")
    parser.add_argument("--device", default="cpu", help="of the network")
    given = parser.parse_args()
    models = load_models(
        [given.checkpoint] if given.checkpoint else (), "builtin", torch.device(given.device)
    )
    print(f"{torch.get_num_threads()} threads, {given.device}, {given.lights} lights, {given.side} px")
    rig = rig_directions(given.lights)
    report_olats(models, mean_face(models, given.side), rig)
    report_second_map(models, rig, given.side)
    report_dataset(stack_of_ball(given.lights, given.side), sky_weights(given.lights, given.images))


def report_olats(models: Models, face: FaceTexture, rig: Tensor) -> None:
    """Print how long the OLATs of a texture take in each way."""
    ways: dict[str, Callable[[], Tensor]] = {
        "encoder once": lambda: torch.cat(list(Field(models, face).olats(rig))),
        "encoder once, bf16": lambda: torch.cat(list(Field(models, face, bf16=True).olats(rig))),
        "encoder each time": lambda: torch.cat(
            [olat for light in rig for olat in Field(models, face).olats(light[None])]
        ),
    }
    seconds, olats = best_s(ways, _ROUNDS)
    off = float((olats["encoder once"] - olats["encoder each time"]).abs().max())
    print_ratios("OLATs", seconds, "encoder each time")
    print(f"  largest difference of the first and the last: {off:.1e}")


def mean_face(models: Models, side: int) -> FaceTexture:
    """The mean face with a random texture [3, side, side]."""
    vertices = models.face.mean + torch.tensor([0.0, 0.0, -1.0])
    texture = 0.2 + 0.1 * torch.rand(3, side, side, generator=torch.Generator().manual_seed(0))
    return FaceTexture(texture, torch.ones(side, side), normal_map(vertices, grid_triangles(), side))


def report_second_map(models: Models, rig: Tensor, side: int) -> None:
    """Print what one more envmap costs once one is shown, and what a new prediction costs."""
    photo = read_image(ASTRONAUT).pixels
    face = find_faces(models.networks.parsing, photo, "astronaut")[0]
    head = fit_photo(models, photo, face.landmarks_px, models.sides(side))
    composition = Composition(models.face, photo, head, reflectance=reflectance_of(models, head))
    maps = [
        torch.from_numpy(read_image(path).pixels)
        for path in sorted((ROOT / "examples" / "maps").glob("*.exr"))
    ]

    def relit(count: int) -> None:
        weights = torch.stack([envmap_weights(envmap, rig) for envmap in maps[:count]])
        for one in composition.relit(Lights(rig, weights)):
            composition.image(one)

    seconds, _ = best_s({"one map": lambda: relit(1), "all maps": lambda: relit(len(maps))}, _ROUNDS)
    more_s = (seconds["all maps"] - seconds["one map"]) / (len(maps) - 1)
    print_ratios(
        "one more envmap", {"added": more_s, "predicted again": seconds["one map"]}, "predicted again"
    )


def report_dataset(olats: Tensor, weights: Tensor) -> None:
    """Print how long the images of one camera take in each way, and the error of half floats."""
    images = torch.empty(len(weights), *olats.shape[1:], dtype=torch.float16)
    stack = olats.permute(1, 0, 2, 3).reshape(3, len(olats), -1).float()  # [3, L, P]
    by_channel = weights.permute(2, 0, 1).contiguous()  # [3, M, L]
    few = max(1, len(weights) // _LOOPED)
    ways: dict[str, Callable[[], object]] = {
        "relight-dataset": lambda: multiply(olats, weights, images),
        "bare torch.matmul": lambda: torch.matmul(by_channel, stack),
        "loop over lights": lambda: loop_over_lights(olats, weights[:few]),
    }
    seconds, _ = best_s(ways, _ROUNDS)
    seconds["loop over lights"] *= len(weights) / few
    print_ratios(f"{len(weights)} images of a dataset", seconds, "bare torch.matmul")
    truth = torch.matmul(by_channel[:, :few], stack).transpose(0, 1).reshape(few, *olats.shape[1:])
    bright = truth > 1e-3
    off = float(((images[:few].float() - truth).abs() / truth)[bright].max())
    print(f"  largest relative difference to float32: {off:.1e} (half a step of half floats is 4.9e-4)")


def loop_over_lights(olats: Tensor, weights: Tensor) -> Tensor:
    """Sum OLATs image by image and light by light."""
    images = torch.zeros(len(weights), *olats.shape[1:])
    for image, weight in zip(images, weights, strict=True):
        for olat, rgb in zip(olats, weight, strict=True):
            image += rgb[:, None, None] * olat.float()
    return images


def stack_of_ball(lights: int, side: int) -> Tensor:
    """A lit ball with grain [L, 3, H, W] float16, in memory like a stack that was read."""
    line = torch.linspace(-1, 1, side)
    y, x = torch.meshgrid(-line, line, indexing="ij")
    z = (1 - x * x - y * y).clamp_min(0).sqrt()
    cosine = torch.einsum("lc,chw->lhw", rig_directions(lights), torch.stack([x, y, z])).clamp_min(0) * (
        z > 0
    )
    grain = 0.3 + 0.1 * torch.rand(3, side, side, generator=torch.Generator().manual_seed(0))
    stack = torch.empty(lights, side, side, 3, dtype=torch.float16).permute(0, 3, 1, 2)
    return stack.copy_(cosine[:, None] * grain)


def sky_weights(lights: int, images: int) -> Tensor:
    """Weights [M, L, 3] of procedural skies at ten rotations each."""
    turns_deg = tuple(360 * k / 10 for k in range(10))
    maps = [torch.from_numpy(draw_sky(index, 0, 128)[0]) for index in range(-(-images // 10))]
    return torch.cat([rotated_weights(sky, rig_directions(lights), turns_deg) for sky in maps])[:images]


def print_ratios(what: str, seconds: dict[str, float], reference: str) -> None:
    """Print each way's seconds, and its time as a multiple of the reference's."""
    print(what)
    for name, value in seconds.items():
        print(f"  {name:20} {value:8.3f} s  {value / seconds[reference]:6.2f} x {reference}", flush=True)


if __name__ == "__main__":
    main()
