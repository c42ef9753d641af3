"""A fitted face rendered by a camera: (u, v), normal and position of each pixel, and a soft mask."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from facerf_cli.face.crop import Crop
from facerf_cli.face.topology import grid_triangles, grid_uv, region_mask
from facerf_cli.image.strips import Band, strips
from facerf_cli.raster.camera import Camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture, vertex_normals
from facerf_cli.run import memory

_TINY = 1e-8
_FEATHER = 0.04  # width of the mask's soft border, inward, in crop sides
_BYTES, _PHOTO_BYTES = 32, 16  # of a pixel of the view, and of a photo with its matte around it
_STRIP_BYTES, _BETWEEN = 32 << 20, 6  # of a strip of the image, and a sixth of all for what lies between
_MASK_SIDE = 256  # texels; a finer mask takes seconds to draw


@dataclass(frozen=True, eq=False)
class FaceView:
    """A fitted face rendered by its photo's camera, ready to be textured any number of times.

    All tensors cover the window [h, w] of the photo [H, W] whose first row and column are `top` and `left`.
    """

    height_px: int
    width_px: int
    top: int
    left: int
    uv: Tensor  # [h, w, 2]
    coverage: Tensor  # [h, w] 0 or 1
    mask: Tensor  # [h, w] 0..1, the face inside jaw and hairline with a soft border
    surface: Callable[[slice], Tensor]  # normals and positions [n, w, 6] of rows, camera space

    @property
    def normal(self) -> Tensor:
        """Unit normals [h, w, 3], camera space."""
        return self.surface(slice(0, len(self.uv)))[..., :3]

    @property
    def position_m(self) -> Tensor:
        """Positions [h, w, 3], camera space."""
        return self.surface(slice(0, len(self.uv)))[..., 3:]

    def render(self, texture: Tensor, rows: slice = slice(None)) -> Tensor:
        """Render a texture [C, T, T] in the window [h, w, C], or in rows of it, zero off the mesh."""
        return sample_texture(texture, self.uv[rows]) * self.coverage[rows][..., None]

    def full(self, window: Tensor) -> np.ndarray:
        """Place values of the window [h, w, ...] in the photo [H, W, ...], zero elsewhere."""
        return self.in_frame(lambda rows: window[rows], *window.shape[2:])(slice(0, self.height_px))

    def in_frame(self, of: Callable[[slice], Tensor], *channels: int) -> Band:
        """An image [H, W, ...] in the photo's frame from values of rows of the window; zero elsewhere."""

        def in_photo(rows: slice) -> np.ndarray:
            frame = np.zeros((rows.stop - rows.start, self.width_px, *channels), np.float32)
            inside = self.rows_inside(rows)
            if inside.start < inside.stop:
                frame[self.rows_of(inside, rows), self.window[1]] = of(inside).numpy()
            return frame

        return in_photo

    def rows_inside(self, rows: slice) -> slice:
        """The window's rows, counted from its own first one, among rows of the photo."""
        height = len(self.coverage)
        return slice(max(0, rows.start - self.top), max(0, min(height, rows.stop - self.top)))

    def in_photo(self, inside: slice) -> slice:
        """Rows of the window as rows of the photo."""
        return slice(inside.start + self.top, inside.stop + self.top)

    def rows_of(self, inside: slice, rows: slice) -> slice:
        """Rows of the window as counted from the first of some rows of the photo."""
        return slice(inside.start + self.top - rows.start, inside.stop + self.top - rows.start)

    @property
    def window(self) -> tuple[slice, slice]:
        """The window's rows and columns in the photo."""
        height, width = self.coverage.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)


def photo_camera(crop: Crop, height_px: int, width_px: int) -> Camera:
    """The crop's camera extended to the whole photo, in the photo's pixels."""
    half = crop.side_px / 2
    focal_px = crop.camera.focal_px / crop.scale
    return Camera(focal_px, width_px, height_px, crop.x0_px + half, crop.y0_px + half)


def view_face(vertices_camera: Tensor, camera: Camera, side_px: float) -> FaceView:
    """Render the mesh [V, 3] with a camera; `side_px` is the crop's side in the camera's pixels."""
    top, left, window = _window(vertices_camera, camera)
    needed = camera.height_px * camera.width_px * _PHOTO_BYTES + window.height_px * window.width_px * _BYTES
    needed += needed // _BETWEEN + _STRIP_BYTES
    memory.require(f"a face of {window.width_px} x {window.height_px} pixels", needed, "a smaller photo")
    triangles = grid_triangles()
    size = window.height_px, window.width_px
    uv, coverage, mask = torch.empty(*size, 2), torch.empty(size), torch.empty(size)
    region = region_mask("face", _MASK_SIDE)[None]
    for rows in strips(size):
        fragments = rasterize(vertices_camera, triangles, _rows_of(window, rows))
        uv[rows] = interpolate(grid_uv(), triangles, fragments)
        coverage[rows] = fragments.covered.float()
        mask[rows] = sample_texture(region, uv[rows])[..., 0]
    inside = (mask * coverage > 0.02).numpy()
    if not inside.all():  # where the face turns away the UV mask is steep in the image, so it is softened
        edge_px = torch.from_numpy(distance_transform_edt(inside)).float()
        mask = mask * smooth(edge_px / max(_FEATHER * side_px, 1))
    attributes = torch.cat([vertex_normals(vertices_camera, triangles), vertices_camera], 1)

    def surface(rows: slice) -> Tensor:
        fragments = rasterize(vertices_camera, triangles, _rows_of(window, rows))
        normal, position_m = torch.split(interpolate(attributes, triangles, fragments), 3, -1)
        return torch.cat([F.normalize(normal, dim=-1), position_m], -1)

    return FaceView(camera.height_px, camera.width_px, top, left, uv, coverage, mask, surface)


def _rows_of(camera: Camera, rows: slice) -> Camera:
    """The camera of some rows of an image."""
    height_px, cy_px = rows.stop - rows.start, camera.cy_px - rows.start
    return Camera(camera.focal_px, camera.width_px, height_px, camera.cx_px, cy_px)


def _window(vertices_camera: Tensor, camera: Camera) -> tuple[int, int, Camera]:
    """First row and column of the part of the image around the mesh (and a pixel more), and its camera."""
    in_front = torch.cat([vertices_camera[:, :2], vertices_camera[:, 2:].clamp(max=-_TINY)], 1)
    x, y = project(in_front, camera).T
    left, right = (int(v.floor().clamp(0, camera.width_px - 1)) for v in (x.min() - 1, x.max() + 1))
    top, bottom = (int(v.floor().clamp(0, camera.height_px - 1)) for v in (y.min() - 1, y.max() + 1))
    width, height = right + 1 - left, bottom + 1 - top
    return top, left, Camera(camera.focal_px, width, height, camera.cx_px - left, camera.cy_px - top)


def smooth(x: Tensor) -> Tensor:
    """Smooth step of 0..1, flat at both ends."""
    x = x.clamp(0, 1)
    return x * x * (3 - 2 * x)


def see_face(vertices_camera: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Rasterize the mesh [V, 3]: the (u, v) of each pixel [H, W, 2] and the coverage [H, W], 0 or 1."""
    fragments = rasterize(vertices_camera, grid_triangles(), camera)
    return interpolate(grid_uv(), grid_triangles(), fragments), fragments.covered.float()


def render_face(textures: Tensor, uv: Tensor, coverage: Tensor) -> Tensor:
    """Images [N, C, H, W] of textures [N, C, T, T] on a face seen by `see_face`, black off the mesh."""
    images = sample_texture(textures.flatten(0, 1), uv) * coverage[..., None]  # [H, W, N C]
    return images.permute(2, 0, 1).reshape(*textures.shape[:2], *coverage.shape)
