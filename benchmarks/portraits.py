"""Synthetic portraits: time of a bust and of a training photo, and a contact sheet to look at.

    python benchmarks/portraits.py [--people 24] [--face-model builtin] [--sheet sheet.png]

Times are of one core. Naive twin of a training photo: the single-light images of the bake renderer, weighed.
Columns of the sheet: even light, light as in training with another skin and other clothes, a lamp from the
side, a lamp behind; classes, matte, albedo and normals.
"""

import time

import numpy as np
import torch
from _common import arguments
from PIL import Image

from facerf_cli.light.mesh_transport import bake_mesh
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.portrait.classes import CLASSES
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.synth import bake_renderer
from facerf_cli.synth.appearance.materials import Appearance, draw_appearance
from facerf_cli.synth.head.mesh import PARTS
from facerf_cli.synth.portraits import BakedPortrait, bake_portrait, photograph
from facerf_cli.synth.stage_cameras import StageCamera
from facerf_cli.synth.subjects import Subject, draw_subject, subject_model
from facerf_cli.synth.texture_samples import draw_light

SIDE_PX, LIGHTS, SEED = 256, 150, 101
BAKE = BakeSettings(light_samples=2, bounce_samples=8)
PALETTE = (
    np.random.default_rng(2).uniform(0.15, 1, (len(CLASSES), 3)) * (np.arange(len(CLASSES)) > 0)[:, None]
)


def lamp(portrait: BakedPortrait, azimuth_deg: float, elevation_deg: float) -> torch.Tensor:
    """Weights [L, 3] of a lamp with a little light from all around."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    toward = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    share = (60 * (portrait.directions @ torch.tensor(toward, dtype=torch.float32))).softmax(0)
    return (share + 0.03 / LIGHTS)[:, None] * torch.ones(3)


def shown(image: torch.Tensor) -> np.ndarray:
    """A scene-linear image [3, H, W] as the eye sees it [H, W, 3]."""
    white = max(float(image.mean(0).flatten().quantile(0.97)), 0.05) / 0.8
    return np.asarray((image / white).clamp(0, 1).permute(1, 2, 0).numpy() ** (1 / 2.2))


def row(
    portrait: BakedPortrait, own: Appearance, other: Appearance, generator: torch.Generator
) -> np.ndarray:
    """One person of the sheet."""
    even = torch.full((LIGHTS, 3), 4 / LIGHTS)
    lights = ((even, own), (draw_light(portrait.directions, generator), other))
    lights += ((lamp(portrait, 75, 15), own), (lamp(portrait, 160, 30), own))
    photos = [photograph(portrait, appearance, weights) for weights, appearance in lights]
    truth = photos[0]
    classes = truth.classes.permute(1, 2, 0).numpy() @ PALETTE
    matte = np.repeat(truth.alpha[..., None].numpy(), 3, -1)
    normals = truth.normals.permute(1, 2, 0).numpy() * 0.5 + 0.5
    return np.hstack(
        [*(shown(photo.image) for photo in photos), classes, matte, shown(truth.albedo), normals]
    )


def twin_s(subject: Subject, camera: StageCamera, directions: np.ndarray) -> float:
    """Seconds of the single-light images of a person, whose transport is baked, and of their weighted sum."""
    mesh = subject.mesh
    hair = mesh.part == PARTS.index("hair")
    transport = bake_mesh(mesh.vertices, mesh.normals, mesh.triangles, directions, BAKE, two_sided=hair)
    begun = time.process_time()
    images, _ = bake_renderer.photograph(mesh, subject.appearance, transport, camera)
    torch.einsum("lchw,lc->chw", images, torch.full((LIGHTS, 3), 4 / LIGHTS))
    return time.process_time() - begun


def main() -> None:
    """Print the times and write the sheet."""
    parser = arguments(__doc__)
    parser.add_argument("--people", type=int, default=2)
    parser.add_argument("--face-model", default="builtin")
    parser.add_argument("--sheet", default="")
    options = parser.parse_args()
    torch.set_num_threads(1)
    model, directions = subject_model(options.face_model), rig_directions(LIGHTS).numpy().astype(np.float64)
    others = [draw_appearance(256, torch.Generator().manual_seed(seed)) for seed in range(4)]
    rows, busts_s, photos_s = [], [], []
    for index in range(options.people):
        begun = time.process_time()
        subject = draw_subject(model, index, SEED, SIDE_PX)
        lens = Camera(SIDE_PX * 2 / 0.5, SIDE_PX, SIDE_PX, SIDE_PX / 2, SIDE_PX / 2)
        yaw = float(np.random.default_rng(index).uniform(-40, 40))
        camera = StageCamera(lens, pose_to_rotation(yaw, 0, 0), torch.tensor([0.0, 0.05, -2.0]))
        portrait = bake_portrait(subject, camera, directions, BAKE, index)
        busts_s.append(time.process_time() - begun)
        generator = torch.Generator().manual_seed(index)
        rows.append(row(portrait, subject.appearance, others[index % 4], generator))
        weights = draw_light(portrait.directions, generator)
        for _ in range(3):
            begun = time.process_time()
            photograph(portrait, subject.appearance, weights)
            photos_s.append(time.process_time() - begun)
        print(
            index, subject.traits["hair"], subject.traits["garment"], subject.traits["headwear"], flush=True
        )
        if options.sheet:
            Image.fromarray((255 * np.vstack(rows).clip(0, 1)).astype(np.uint8)).save(options.sheet)
    print(f"{options.people} people, {SIDE_PX} px, {LIGHTS} lights")
    print(f"a bust {np.median(busts_s):.1f} s, a photo {1000 * np.median(photos_s):.0f} ms of a core")
    print(f"naive twin of a photo: {twin_s(subject, camera, directions) / np.median(photos_s):.0f} x as long")


if __name__ == "__main__":
    main()
