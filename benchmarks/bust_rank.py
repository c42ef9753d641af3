"""Rank of the light transport of whole busts: coefficients that hold 99 and 99.9 % of the energy, by class.

    python benchmarks/bust_rank.py [--people 8] [--face-model builtin]

Synthetic people are photographed under 150 lights. Each pixel is a vector of 150 radiances for each channel.
Principal components over the pixels of all people, without subtraction of a mean, give the number of basis
functions of the light direction that a class needs. `maps` weighs the lights as procedural maps do: rows are
what the pixels look like under 100 maps at random rotations.
"""

import time

import numpy as np
import torch
from _common import arguments

from facerf_cli.light.mesh_transport import bake_mesh
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.portrait.classes import CLASSES
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.synth import renderer
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.bank.texture_samples import draw_light
from facerf_cli.synth.head.mesh import PARTS
from facerf_cli.synth.subjects import draw_subject
from facerf_cli.synth.views import StageCamera, truth_of

SIDE_PX, LIGHTS, MAPS = 128, 150, 100
SHARES = (0.99, 0.999)


def rendered(model_name: str, index: int, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radiances [N, L] of the covered pixels and channels of a person, and the class [N] of each."""
    subject = draw_subject(cached_face_model(model_name), index, 15, 256)
    mesh = subject.mesh
    strands = mesh.part == PARTS.index("hair")
    transport = bake_mesh(
        mesh.vertices, mesh.normals, mesh.triangles, directions, BakeSettings(), two_sided=strands
    )
    yaw = float(np.random.default_rng(index).uniform(-40, 40))
    lens = Camera(SIDE_PX * 2 / 0.5, SIDE_PX, SIDE_PX, SIDE_PX / 2, SIDE_PX / 2)
    camera = StageCamera(lens, pose_to_rotation(yaw, 0, 0), torch.tensor([0.0, 0.05, -2.0]))
    images, _ = renderer.photograph(mesh, subject.appearance, transport, camera)
    truth = truth_of(mesh, subject.appearance, camera)
    whole = truth.alpha.ravel() > 0.99
    pixels = images.permute(2, 3, 1, 0).reshape(-1, 3, len(directions)).numpy()[whole]
    kind = truth.classes.reshape(-1, len(CLASSES))[whole].argmax(-1)
    return pixels.reshape(-1, len(directions)), kind.repeat(3)


def needed(rows: np.ndarray) -> list[int]:
    """Number of principal components of rows [N, L] that hold each of `SHARES` of their energy."""
    energy = np.linalg.eigvalsh(rows.T.astype(np.float64) @ rows)[::-1].clip(0)
    held = np.cumsum(energy) / energy.sum()
    return [int(np.searchsorted(held, share) + 1) for share in SHARES]


def main() -> None:
    """Print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--people", type=int, default=8)
    parser.add_argument("--face-model", default="builtin")
    options = parser.parse_args()
    directions = rig_directions(LIGHTS).numpy().astype(np.float64)
    begun = time.process_time()
    people = [rendered(options.face_model, index, directions) for index in range(options.people)]
    rows, kinds = (np.concatenate(column) for column in zip(*people, strict=True))
    seconds = (time.process_time() - begun) / options.people
    generator = torch.Generator().manual_seed(0)
    lights = torch.from_numpy(directions).float()
    maps = torch.stack([draw_light(lights, generator).mean(-1) for _ in range(MAPS)]).numpy()  # [M, L]
    print(f"{options.people} people, {SIDE_PX} px, {LIGHTS} lights; {seconds:.1f} s of a core for each")
    print("class       pixels   lights 99 %  99.9 %   maps 99 %  99.9 %")
    for index, name in [(None, "all"), *enumerate(CLASSES)]:
        chosen = rows if index is None else rows[kinds == index]
        if len(chosen) > LIGHTS:
            single, under_maps = needed(chosen), needed(chosen @ maps.T)
            print(
                f"{name:10}{len(chosen) // 3:8}{single[0]:13}{single[1]:8}{under_maps[0]:12}{under_maps[1]:8}"
            )


if __name__ == "__main__":
    main()
