"""Time of one frame of the canonical mesh, beside embree's ray casting and the textbook loop over triangles.

    python benchmarks/rasterize.py [--threads N]

The face turns from frame to frame, so embree builds its tree anew for each; "trace only" leaves that out.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from torch import Tensor

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.raster.camera import (
    Camera,
    crop_camera,
    pixel_centres_px,
    pixel_rays,
    pose_to_rotation,
    project,
)
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.raster.texture import render_texture, unwrap

SIDES_PX = (256, 512)
TEXTURE_SIDE = 256


def best_ms(run: Callable[[], object], repeats: int = 7) -> float:
    """The fastest of several runs, in milliseconds; the machine may be shared."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return 1000 * min(times)


def embree_scene(vertices: Tensor, triangles: Tensor) -> rtcore_scene.EmbreeScene:
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices.numpy(), triangles.numpy().astype(np.int32))
    return scene


def embree_triangles(scene: rtcore_scene.EmbreeScene, rays: np.ndarray) -> np.ndarray:
    """Triangle that each ray [P, 3] from the camera hits [P]; embree finds the barycentrics as well."""
    return scene.run(np.zeros_like(rays), rays, output=True)["primID"]


def loop_over_triangles(vertices: Tensor, triangles: Tensor, camera: Camera) -> np.ndarray:
    """The textbook: each triangle's bounding box, edge functions, z-buffer. Triangle [H, W], -1 = none."""
    px, inverse = project(vertices, camera).double().numpy(), -1 / vertices[:, 2].double().numpy()
    nearest = np.zeros((camera.height_px, camera.width_px))
    seen = np.full(nearest.shape, -1)
    for number, corners in enumerate(triangles.numpy()):
        a, b, c = px[corners]
        x0, y0 = np.maximum(np.floor(np.min([a, b, c], 0)), 0).astype(int)
        x1, y1 = np.ceil(np.max([a, b, c], 0)).astype(int)
        y, x = np.mgrid[y0 : min(y1, camera.height_px), x0 : min(x1, camera.width_px)] + 0.5
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if x.size == 0 or area == 0:
            continue
        wb = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        wc = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        depth = inverse[corners] @ np.stack([1 - wb - wc, wb, wc]).reshape(3, -1)
        box = np.s_[y0 : y0 + x.shape[0], x0 : x0 + x.shape[1]]
        depth = depth.reshape(x.shape)
        wins = (wb >= 0) & (wc >= 0) & (wb + wc <= 1) & (depth > nearest[box])
        nearest[box][wins], seen[box][wins] = depth[wins], number
    return seen


def with_gradients(vertices: Tensor, texture: Tensor, camera: Camera) -> None:
    leaf = vertices.clone().requires_grad_()
    image, _ = render_texture(texture, leaf, grid_triangles(), grid_uv(), camera)
    image.sum().backward()


def rows(side_px: int, vertices: Tensor) -> list[tuple[str, float]]:
    camera, triangles = crop_camera(side_px), grid_triangles()
    texture = torch.rand(3, TEXTURE_SIDE, TEXTURE_SIDE)
    rays = pixel_rays(pixel_centres_px(camera), camera).reshape(-1, 3).numpy()
    scene = embree_scene(vertices, triangles)
    image = torch.rand(3, side_px, side_px)
    fragments = rasterize(vertices, triangles, camera)
    hit = embree_triangles(scene, rays).reshape(side_px, side_px)
    agree = float((fragments.triangle.numpy() == hit)[fragments.covered.numpy()].mean())
    loop = loop_over_triangles(vertices, triangles, camera)
    agree_loop = float((fragments.triangle.numpy() == loop)[fragments.covered.numpy()].mean())
    print(
        f"{side_px} px: {int(fragments.covered.sum())} pixels covered; same triangle as embree in "
        f"{agree:.3%}, as the loop in {agree_loop:.3%}"
    )
    return [
        ("rasterize", best_ms(lambda: rasterize(vertices, triangles, camera))),
        ("render_texture", best_ms(lambda: render_texture(texture, vertices, triangles, grid_uv(), camera))),
        ("render_texture and backward", best_ms(lambda: with_gradients(vertices, texture, camera))),
        ("unwrap to 256", best_ms(lambda: unwrap(image, vertices, triangles, camera, TEXTURE_SIDE))),
        (
            "embree, tree and trace",
            best_ms(lambda: embree_triangles(embree_scene(vertices, triangles), rays)),
        ),
        ("embree, trace only", best_ms(lambda: embree_triangles(scene, rays))),
        ("loop over triangles", best_ms(lambda: loop_over_triangles(vertices, triangles, camera), repeats=1)),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    torch.set_num_threads(parser.parse_args().threads)
    pose = pose_to_rotation(25, 5, 3)
    vertices = load_face_model("builtin").mean @ pose.T + torch.tensor([0.0, 0, -1.0])
    for side_px in SIDES_PX:
        table = rows(side_px, vertices)
        own_ms = table[0][1]
        for name, milliseconds in table:
            print(f"  {name:<28}{milliseconds:>10.1f} ms{milliseconds / own_ms:>10.2f} x")


if __name__ == "__main__":
    main()
