"""Baked light transport next to a path tracer, Mitsuba: the difference of their images, and their times.

    python benchmarks/transport.py [--face-model builtin|PATH] [--size 384] [--lights 12] [--images DIR]

The scene is a diffuse head with a drawn appearance under point lights, seen from the front and from a side,
in direct light only and with two bounces. Both images are unwrapped to UV space. The error is the root mean
square over visible texels that lie more than two texels from the edge of a shadow, relative to the mean
radiance of the lit ones in the path tracer's image; over all texels, and over the lit ones alone.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import _path_tracer as path_tracer
import numpy as np
import torch
from _common import arguments, print_header, print_row, required_package
from _path_tracer import PathSettings
from scipy.ndimage import binary_dilation
from torch import Tensor

from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import GRID, grid_triangles
from facerf_cli.files.write import write_display
from facerf_cli.light.mesh_transport import bake_mesh
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.light.transport import BakeSettings
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.raster.texture import unwrap
from facerf_cli.synth.appearance.materials import Appearance, draw_appearance
from facerf_cli.synth.head.mesh import HeadMesh
from facerf_cli.synth.head.shell import shell_head
from facerf_cli.synth.person import SyntheticPerson
from facerf_cli.synth.renderer import images_under, light_of, view_of
from facerf_cli.synth.views import StageCamera

DISTANCE_M, FIELD_M = 1.5, 0.24  # of the cameras, and the width that an image shows
TEXTURE_SIDE = 128  # texels
EDGE_TEXELS = 2
LIT = 0.01  # share of the image's highest radiance above which a texel counts as lit
LIGHTS_DEG = (  # azimuth, elevation: from the front to the back
    *[(0, 0), (0, 40), (-30, 10), (45, 20), (-45, -25), (60, 50)],
    *[(-75, 0), (90, 15), (0, 80), (0, -60), (-120, 10), (135, 30)],
)


@dataclass(frozen=True)
class Comparison:
    """Relative errors [L] of each light, and the mean radiance [L] to which they are relative.

    The last entry is of all lights' texels together.
    """

    errors: list[float]
    errors_lit: list[float]
    means: list[float]
    texels: int


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--face-model", default="builtin")
    parser.add_argument("--size", type=int, default=192, help="of the images, in pixels")
    parser.add_argument("--lights", type=int, default=6, help=f"at most {len(LIGHTS_DEG)}")
    parser.add_argument("--samples", type=int, default=32, help="paths a pixel")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--images", type=Path, help="folder for both renderers' images")
    given = parser.parse_args()
    required_package("mitsuba", "dev")
    model = load_face_model(given.face_model)
    generator = torch.Generator().manual_seed(given.seed)
    alpha = 0.7 * torch.randn(len(model.identity), generator=generator)
    appearance = draw_appearance(512, generator)
    angles = LIGHTS_DEG[: given.lights]
    directions = np.stack([azel_to_direction(*map(float, angle)).numpy() for angle in angles])
    cameras = [stage_camera(given.size, yaw_deg) for yaw_deg in (0.0, 40.0)]
    results: dict[int, Comparison] = {}
    times: dict[str, list[float]] = {"bake": [], "photograph": [], "mitsuba": []}
    direct: list[Tensor] = []  # the path tracer's images without bounces
    for bounces in (0, 2):
        settings = PathSettings(samples=given.samples, bounces=bounces, gloss=False, relief=False)
        ours, theirs = render_both(model, alpha, appearance, directions, cameras, settings, given.seed, times)
        direct = direct or theirs
        results[bounces] = compare(model, alpha, cameras, ours, theirs, direct)
        if given.images is not None:
            write_images(given.images, bounces, ours, theirs)
    print(f"{model.name}, {given.size} px, {given.samples} paths a pixel, {results[0].texels} texels")
    print_errors(results, angles)
    print_times(times, len(angles))


def print_errors(results: dict[int, Comparison], angles: Sequence[tuple[int, int]]) -> None:
    """Print the errors of each light without and with bounces."""
    print_header("azimuth, elevation", "direct", "of lit texels", "two bounces", "of lit texels", "radiance")
    for light, name in enumerate([*(f"{a}, {e}" for a, e in angles), "all lights"]):
        percents = [f"{e[light]:.1%}" for n in (0, 2) for e in (results[n].errors, results[n].errors_lit)]
        print_row(name, *percents, f"{results[2].means[light]:.4f}")


def print_times(times: dict[str, list[float]], lights: int) -> None:
    """Print the times of both renderers, and the ratio for an image."""
    mean_s = {name: float(np.mean(values)) for name, values in times.items()}
    print(f"bake of {lights} lights {mean_s['bake']:.2f} s")
    print(
        f"an image: bake {1000 * mean_s['photograph']:.0f} ms, mitsuba {1000 * mean_s['mitsuba']:.0f} ms, "
        f"{mean_s['mitsuba'] / mean_s['photograph']:.1f} times as long"
    )


def stage_camera(side_px: int, yaw_deg: float) -> StageCamera:
    """A far camera that a head turned by `yaw_deg` fills."""
    camera = Camera(side_px * DISTANCE_M / FIELD_M, side_px, side_px, side_px / 2, side_px / 2)
    return StageCamera(camera, pose_to_rotation(yaw_deg, 0, 0), torch.tensor([0.0, 0, -DISTANCE_M]))


def render_both(
    model: MorphableModel,
    alpha: Tensor,
    appearance: Appearance,
    directions: np.ndarray,
    cameras: list[StageCamera],
    settings: PathSettings,
    seed: int,
    times: dict[str, list[float]],
) -> tuple[list[Tensor], list[Tensor]]:
    """Render diffuse images [L, 3, H, W] of each camera by both renderers; their seconds go into `times`."""
    beta = torch.zeros(1, len(model.expression))
    head = shell_head(model.vertices(alpha[None], beta)[0], gaze_deg=(0.0, 0.0), subdivisions=1)
    wanted = seen_vertices(head, cameras)
    bake = BakeSettings(light_radius_deg=0, bounce_samples=64 if settings.bounces else 0)
    started = time.perf_counter()
    transport = bake_mesh(head.vertices, head.normals, head.triangles, directions, bake, seed, wanted)
    flat = {name: replace(part, relief=0 * part.relief) for name, part in appearance.materials.items()}
    person = Appearance(flat, torch.zeros(3), {})
    subject = SyntheticPerson(
        head, person, torch.eye(3), torch.zeros(GRID * GRID, 3), np.zeros((68, 3)), {}, {}
    )
    light = light_of(subject, transport)
    times["bake"].append(time.perf_counter() - started)
    ours, theirs, single = [], [], torch.eye(len(directions))[..., None].expand(-1, -1, 3)
    for camera in cameras:
        started = time.perf_counter()
        ours.append(images_under(*view_of(subject, light, camera), single, highlights=0))
        times["photograph"].append((time.perf_counter() - started) / len(directions))
        started = time.perf_counter()
        theirs.append(path_tracer.photograph(head, appearance, directions, camera, settings, seed)[0])
        times["mitsuba"].append((time.perf_counter() - started) / len(directions))
    return ours, theirs


def seen_vertices(head: HeadMesh, cameras: list[StageCamera]) -> np.ndarray:
    """Mask [V] of the corners of the triangles that some camera sees."""
    wanted = np.zeros(len(head.vertices), bool)
    for camera in cameras:
        vertices = torch.from_numpy(head.vertices) @ camera.head_to_camera.T + camera.translation_m
        side = camera.camera
        finer = Camera(
            4 * side.focal_px, 4 * side.width_px, 4 * side.height_px, 4 * side.cx_px, 4 * side.cy_px
        )
        triangle = rasterize(vertices, torch.from_numpy(head.triangles), finer).triangle
        wanted[head.triangles[np.unique(triangle[triangle >= 0])].ravel()] = True
    return wanted


def compare(
    model: MorphableModel,
    alpha: Tensor,
    cameras: list[StageCamera],
    ours: list[Tensor],
    theirs: list[Tensor],
    direct: list[Tensor],
) -> Comparison:
    """Compare in UV space; `direct`, the path tracer's images without bounces, show what is lit."""
    vertices = model.vertices(alpha[None], torch.zeros(1, len(model.expression)))[0]
    lights = range(len(ours[0]))
    ours_at, theirs_at, lit_at = ([list[Tensor]() for _ in lights] for _ in range(3))
    for camera, our, their, unbounced in zip(cameras, ours, theirs, direct, strict=True):
        at = vertices @ camera.head_to_camera.T + camera.translation_m
        for light in lights:
            (a, seen), (b, _), (c, _) = (
                unwrap(images[light], at, grid_triangles(), camera.camera, TEXTURE_SIDE)
                for images in (our, their, unbounced)
            )
            lit = c.mean(0) > LIT * their.max()
            near = [binary_dilation(part.numpy(), iterations=EDGE_TEXELS) for part in (lit, ~lit)]
            clear = (seen > 0.5) & ~torch.from_numpy(near[0] & near[1])
            ours_at[light].append(a[:, clear])
            theirs_at[light].append(b[:, clear])
            lit_at[light].append(lit[clear])
    each = [[torch.cat(parts, -1) for parts in at] for at in (ours_at, theirs_at, lit_at)]
    rows = [_errors(*row) for row in zip(*each, strict=True)]
    rows.append(_errors(*(torch.cat(parts, -1) for parts in each)))
    errors, errors_lit, means = (list(column) for column in zip(*rows, strict=True))
    return Comparison(errors, errors_lit, means, sum(part.numel() for part in each[2]) // len(lights))


def _errors(ours: Tensor, theirs: Tensor, lit: Tensor) -> tuple[float, float, float]:
    """The error over all texels [3, N], the error over the lit ones [N] bool, and their mean radiance."""
    mean, squares = float(theirs[:, lit].mean()), (ours - theirs) ** 2
    return float(squares.mean().sqrt()) / mean, float(squares[:, lit].mean().sqrt()) / mean, mean


def write_images(folder: Path, bounces: int, ours: list[Tensor], theirs: list[Tensor]) -> None:
    """Write ours above theirs above four times the difference, one file a camera."""
    folder.mkdir(parents=True, exist_ok=True)
    for camera, (our, their) in enumerate(zip(ours, theirs, strict=True)):
        rows = [torch.cat(list(part), -1) for part in (our, their, 4 * (our - their).abs())]
        write_display(
            folder / f"bounces-{bounces}-camera-{camera}.png", torch.cat(rows, -2).permute(1, 2, 0).numpy()
        )


if __name__ == "__main__":
    main()
