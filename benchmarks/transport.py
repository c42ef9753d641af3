"""The baked transport against a path tracer, Mitsuba: how far apart their pictures are, and their times.

    python benchmarks/transport.py [--face-model builtin|PATH] [--size 384] [--lights 12] [--pictures DIR]

A diffuse head with a drawn appearance, lamps of no size, seen from the front and from a side. Direct light
alone and with one bounce. Both renderers' pictures are unwrapped into the chart; the error is the root mean
square over texels that are seen and lie more than two texels off every shadow's edge, relative to the mean
radiance of the lit ones in the path tracer's picture; over all texels, and over those alone that are lit.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from torch import Tensor

from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import grid_triangles
from facerf_cli.files.images import write_display
from facerf_cli.light.mesh_transport import bake_mesh
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.light.transport import BakeSettings
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.raster.texture import unwrap
from facerf_cli.synth import bake_renderer, path_tracer
from facerf_cli.synth.appearance.materials import Appearance, draw_appearance
from facerf_cli.synth.bake_renderer import RenderSettings
from facerf_cli.synth.head.heads import build_head
from facerf_cli.synth.head.mesh import HeadMesh
from facerf_cli.synth.path_tracer import PathSettings
from facerf_cli.synth.stage_cameras import StageCamera

DISTANCE_M, FIELD_M = 1.5, 0.24  # of the cameras, and what a picture's side takes in
CHART = 128  # texels along the chart's side
EDGE_TEXELS = 2
LIT = 0.01  # share of the picture's highest radiance above which a texel counts as lit
LIGHTS_DEG = (  # azimuth, elevation: from the front to the back
    *[(0, 0), (0, 40), (-30, 10), (45, 20), (-45, -25), (60, 50)],
    *[(-75, 0), (90, 15), (0, 80), (0, -60), (-120, 10), (135, 30)],
)


@dataclass(frozen=True)
class Comparison:
    """Relative errors [L] of each light, and the mean radiance [L] that they are relative to.

    The last entry is of all lights' texels together.
    """

    errors: list[float]
    errors_lit: list[float]
    means: list[float]
    texels: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--face-model", default="builtin")
    parser.add_argument("--size", type=int, default=384)
    parser.add_argument("--lights", type=int, default=len(LIGHTS_DEG))
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pictures", type=Path)
    arguments = parser.parse_args()
    model = load_face_model(arguments.face_model)
    generator = torch.Generator().manual_seed(arguments.seed)
    alpha = 0.7 * torch.randn(len(model.identity), generator=generator)
    appearance = draw_appearance(512, generator)
    angles = LIGHTS_DEG[: arguments.lights]
    directions = np.stack([azel_to_direction(*map(float, angle)).numpy() for angle in angles])
    cameras = [stage_camera(arguments.size, yaw) for yaw in (0.0, 40.0)]
    results, times = {}, {"bake": [], "irradiance": [], "photograph": [], "mitsuba": []}
    for bounces in (0, 1):
        settings = PathSettings(samples=arguments.samples, bounces=bounces, gloss=False, relief=False)
        ours, theirs = render_both(
            model, alpha, appearance, directions, cameras, settings, arguments.seed, times
        )
        if bounces == 0:
            truth = theirs
        results[bounces] = compare(model, alpha, cameras, ours, theirs, truth)
        if arguments.images is not None:
            write_images(arguments.images, bounces, ours, theirs)
    print(
        f"{model.name}, {arguments.size} px, {arguments.samples} paths a pixel, {results[0].texels} texels\n"
    )
    print(f"{'':14}{'direct':>14}{'with one bounce':>24}")
    print("azimuth elevation    all    lit        all    lit   mean radiance")
    for light, name in enumerate([*(f"{a:7} {e:9}" for a, e in angles), f"{'all lights':17}"]):
        percents = [(results[n].errors[light], results[n].errors_lit[light]) for n in (0, 1)]
        (direct, direct_lit), (total, total_lit) = percents
        print(f"{name} {direct:6.1%} {direct_lit:6.1%}     {total:6.1%} {total_lit:6.1%}", end="")
        print(f"{results[1].means[light]:16.4f}")
    print()
    per_image = {name: float(np.mean(values)) for name, values in times.items()}
    print(f"bake of {len(angles)} lights {per_image['bake']:.2f} s, ", end="")
    print(f"their irradiance {per_image['irradiance']:.2f} s")
    print(f"a picture: bake {1000 * per_image['photograph']:.0f} ms, ", end="")
    print(f"mitsuba {1000 * per_image['mitsuba']:.0f} ms ({arguments.samples} paths a pixel)")


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
    """Diffuse pictures [L, 3, H, W] of each camera by both renderers; their seconds go into `times`."""
    head = build_head(model, alpha, torch.zeros(len(model.expression)))
    wanted = seen_vertices(head, cameras)
    bake = BakeSettings(light_radius_deg=0, bounce_samples=64 if settings.bounces else 0)
    started = time.perf_counter()
    transport = bake_mesh(head.vertices, head.normals, head.triangles, directions, bake, seed, wanted)
    times["bake"].append(time.perf_counter() - started)
    plain = RenderSettings(bounces=settings.bounces, scattering=False, gloss=False, relief=False)
    started = time.perf_counter()
    irradiance = bake_renderer.scattered_irradiance(head, appearance, transport, plain)
    times["irradiance"].append(time.perf_counter() - started)
    ours, theirs = [], []
    for camera in cameras:
        started = time.perf_counter()
        ours.append(
            bake_renderer.photograph(head, appearance, transport, camera, plain, irradiance=irradiance)[0]
        )
        times["photograph"].append((time.perf_counter() - started) / len(directions))
        started = time.perf_counter()
        theirs.append(path_tracer.photograph(head, appearance, directions, camera, settings, seed)[0])
        times["mitsuba"].append((time.perf_counter() - started) / len(directions))
    return ours, theirs


def seen_vertices(head: HeadMesh, cameras: list[StageCamera]) -> np.ndarray:
    """Corners [V] bool of the triangles that some camera sees."""
    wanted = np.zeros(len(head.vertices), bool)
    for camera in cameras:
        vertices = torch.from_numpy(head.vertices) @ camera.head_to_camera.T + camera.translation_m
        side = camera.camera
        sizes = (side.focal_px, side.width_px, side.height_px, side.cx_px, side.cy_px)
        finer = Camera(*(4 * size for size in sizes))
        triangle = rasterize(vertices, torch.from_numpy(head.triangles), finer).triangle
        wanted[head.triangles[triangle[triangle >= 0].unique()].ravel()] = True
    return wanted


def compare(
    model: MorphableModel,
    alpha: Tensor,
    cameras: list[StageCamera],
    ours: list[Tensor],
    theirs: list[Tensor],
    direct: list[Tensor],
) -> Comparison:
    """`direct` are the path tracer's pictures without bounces: they tell what is lit, where shadows end."""
    vertices = model.vertices(alpha[None], torch.zeros(1, len(model.expression)))[0]
    ours_at, theirs_at, lit_at = ([[] for _ in range(len(ours[0]))] for _ in range(3))
    for camera, our, their, lamp in zip(cameras, ours, theirs, direct, strict=True):
        at = vertices @ camera.head_to_camera.T + camera.translation_m
        for light in range(len(our)):
            (a, seen), (b, _), (c, _) = (
                unwrap(images[light], at, grid_triangles(), camera.camera, CHART)
                for images in (our, their, lamp)
            )
            lit = c.mean(0) > LIT * their.max()
            edge = binary_dilation(lit, iterations=EDGE_TEXELS) & binary_dilation(
                ~lit, iterations=EDGE_TEXELS
            )
            clear = (seen > 0.5) & ~torch.from_numpy(edge)
            ours_at[light].append(a[:, clear])
            theirs_at[light].append(b[:, clear])
            lit_at[light].append(lit[clear])
    a, b, lit = ([torch.cat(parts, -1) for parts in at] for at in (ours_at, theirs_at, lit_at))
    rows = [_errors(*row) for row in zip(a, b, lit, strict=True)]
    rows.append(_errors(torch.cat(a, -1), torch.cat(b, -1), torch.cat(lit)))
    errors, errors_lit, means = (list(column) for column in zip(*rows, strict=True))
    return Comparison(errors, errors_lit, means, sum(part.numel() for part in lit) // len(lit))


def _errors(ours: Tensor, theirs: Tensor, lit: Tensor) -> tuple[float, float, float]:
    """The error over all texels [3, N], over the lit ones [N] bool, and the mean radiance of those."""
    mean, squares = float(theirs[:, lit].mean()), (ours - theirs) ** 2
    return float(squares.mean().sqrt()) / mean, float(squares[:, lit].mean().sqrt()) / mean, mean


def write_images(folder: Path, bounces: int, ours: list[Tensor], theirs: list[Tensor]) -> None:
    """Ours above theirs above four times the difference, one file a camera."""
    folder.mkdir(parents=True, exist_ok=True)
    for camera, (our, their) in enumerate(zip(ours, theirs, strict=True)):
        rows = [torch.cat(list(part), -1) for part in (our, their, 4 * (our - their).abs())]
        write_display(
            folder / f"bounces-{bounces}-camera-{camera}.png", torch.cat(rows, -2).permute(1, 2, 0).numpy()
        )


if __name__ == "__main__":
    main()
