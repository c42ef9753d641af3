"""The time of one frame of the face mesh, next to embree's ray casting and the textbook loop over triangles.

    python benchmarks/rasterize.py [--sides 256 512]

The face turns from frame to frame, so embree builds its tree for each; "trace only" leaves that out. Times
are multiples of `rasterize`'s.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from _common import arguments, best_s
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from torch import Tensor

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.raster.camera import (
    PIXEL_CENTRE,
    Camera,
    crop_camera,
    pixel_centres_px,
    pixel_rays,
    pose_to_rotation,
    project,
)
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.raster.texture import render_texture, unwrap

TEXTURE_SIDE = 256
_ROUNDS = 5


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--sides", type=int, nargs="+", default=[256, 512], help="of the frame, in pixels")
    given = parser.parse_args()
    pose = pose_to_rotation(25, 5, 3)
    vertices = load_face_model("builtin").mean @ pose.T + torch.tensor([0.0, 0, -1.0])
    for side_px in given.sides:
        report(side_px, vertices)


def report(side_px: int, vertices: Tensor) -> None:
    """Print how often all agree on the triangle of a pixel, and their times."""
    camera, triangles = crop_camera(side_px), grid_triangles()
    texture, image = torch.rand(3, TEXTURE_SIDE, TEXTURE_SIDE), torch.rand(3, side_px, side_px)
    rays = pixel_rays(pixel_centres_px(camera), camera).reshape(-1, 3).numpy()
    scene = embree_scene(vertices, triangles)
    ways: dict[str, Callable[[], Any]] = {
        "rasterize": lambda: rasterize(vertices, triangles, camera),
        "embree, tree and trace": lambda: embree_triangles(embree_scene(vertices, triangles), rays),
        "embree, trace only": lambda: embree_triangles(scene, rays),
        "render_texture": lambda: render_texture(texture, vertices, triangles, grid_uv(), camera),
        "render_texture and backward": lambda: with_gradients(vertices, texture, camera),
        f"unwrap to {TEXTURE_SIDE}": lambda: unwrap(image, vertices, triangles, camera, TEXTURE_SIDE),
    }
    seconds, results = best_s(ways, _ROUNDS)
    looped_s, looped = best_s(
        {"loop over triangles": lambda: loop_over_triangles(vertices, triangles, camera)}, 1
    )
    fragments = rasterize(vertices, triangles, camera)
    covered, ours = fragments.covered.numpy(), fragments.triangle.numpy()
    hit = results["embree, trace only"].reshape(side_px, side_px)
    agree = [float((ours == other)[covered].mean()) for other in (hit, looped["loop over triangles"])]
    print(
        f"{side_px} px: {covered.sum()} pixels covered; same triangle as embree in {agree[0]:.3%}, "
        f"as the loop in {agree[1]:.3%}"
    )
    for name, value in {**seconds, **looped_s}.items():
        print(f"  {name:<28}{1000 * value:>10.1f} ms{value / seconds['rasterize']:>10.2f} x")


def embree_scene(vertices: Tensor, triangles: Tensor) -> rtcore_scene.EmbreeScene:
    """Build embree's tree."""
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices.numpy(), triangles.numpy().astype(np.int32))
    return scene


def embree_triangles(scene: rtcore_scene.EmbreeScene, rays: np.ndarray) -> np.ndarray:
    """The triangle [P] that each ray [P, 3] from the camera hits; embree finds the barycentrics as well."""
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
        y, x = np.mgrid[y0 : min(y1, camera.height_px), x0 : min(x1, camera.width_px)] + PIXEL_CENTRE
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
    """Render a texture and run backward to the vertices."""
    leaf = vertices.clone().requires_grad_()
    image, _ = render_texture(texture, leaf, grid_triangles(), grid_uv(), camera)
    image.sum().backward()  # type: ignore[no-untyped-call]


if __name__ == "__main__":
    main()
