"""Render a fitted face to (u, v), normals, positions and a soft mask, and draw a fit over its photo."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import CONTOUR, grid_triangles, grid_uv, region_mask
from facerf_cli.image.colour import auto_exposure_ev
from facerf_cli.image.strips import Window, strips
from facerf_cli.raster.camera import PIXEL_CENTRE, Camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture, smoothstep, vertex_normals

_TINY = 1e-8
_FEATHER = 0.04  # inward width of the mask's soft border, as a fraction of the crop's side
_MASK_SIDE = 256  # texels; a finer mask takes seconds to draw
# Drawings.
_CELLS = 16  # cells of the wire mesh along u and along v
_SHADE, _LINE = 0.35, 0.5  # opacity of the shaded mesh and of its wires
_WIRE_COLOUR = np.array([0.1, 0.5, 1.0], np.float32)
_TARGET_COLOUR, _FITTED_COLOUR = (0.05, 1.0, 0.1), (1.0, 0.25, 0.0)
_DOT = 1 / 160  # radius over the crop's side


@dataclass(frozen=True, eq=False)
class FaceView:
    """Fitted face rendered by its photo's camera; tensors cover the window [h, w] of the photo [H, W]."""

    size_px: tuple[int, int]  # of the photo
    window: Window
    uv: Tensor  # [h, w, 2]
    coverage: Tensor  # [h, w] 0 or 1
    mask: Tensor  # [h, w] in 0..1, the face inside jaw and hairline with a soft border
    vertices_camera: Tensor  # [V, 3]
    camera: Camera  # of the window

    def surface(self, rows: slice) -> Tensor:
        """Compute unit normals and positions [n, w, 6] in rows of the window; camera space, metres."""
        if rows.start == rows.stop:
            return torch.zeros(0, self.camera.width_px, 6)
        triangles = grid_triangles()
        attributes = torch.cat([vertex_normals(self.vertices_camera, triangles), self.vertices_camera], 1)
        fragments = rasterize(self.vertices_camera, triangles, rows_of_camera(self.camera, rows))
        normal, position_m = torch.split(interpolate(attributes, triangles, fragments), 3, -1)
        return torch.cat([F.normalize(normal, dim=-1), position_m], -1)

    @property
    def normal(self) -> Tensor:
        """Unit normals [h, w, 3] in camera space."""
        return self.surface(slice(0, len(self.uv)))[..., :3]

    def render(self, texture: Tensor, part: Window | slice = slice(None)) -> Tensor:
        """Render a texture [C, T, T] in the window [h, w, C] or a part of it; zero outside the mesh."""
        return sample_texture(texture, self.uv[part]) * self.coverage[part][..., None]

    def full(self, values: Tensor) -> np.ndarray:
        """Place values of the window [h, w, ...] in the photo [H, W, ...], zero elsewhere."""
        return Window(*(slice(0, length) for length in self.size_px)).framed(
            values.detach().numpy(), self.window
        )


def photo_camera(crop: Crop, height_px: int, width_px: int) -> Camera:
    """Extend the crop's camera to the whole photo, in the photo's pixels."""
    half = crop.side_px / 2
    focal_px = crop.camera.focal_px / crop.scale
    return Camera(focal_px, width_px, height_px, crop.x0_px + half, crop.y0_px + half)


def view_face(vertices_camera: Tensor, camera: Camera, side_px: float) -> FaceView:
    """Render the mesh [V, 3] with a camera; `side_px` is the crop's side in the camera's pixels."""
    top, left, window_camera = face_window(vertices_camera, camera)
    triangles = grid_triangles()
    size = window_camera.height_px, window_camera.width_px
    uv, coverage, mask = torch.empty(*size, 2), torch.empty(size), torch.empty(size)
    region = region_mask("face", _MASK_SIDE)[None]
    for rows in strips(size):
        fragments = rasterize(vertices_camera, triangles, rows_of_camera(window_camera, rows))
        uv[rows] = interpolate(grid_uv(), triangles, fragments)
        coverage[rows] = fragments.covered.float()
        mask[rows] = sample_texture(region, uv[rows])[..., 0]
    inside = (mask * coverage > 0.02).numpy()
    if not inside.all():  # soften the UV mask, which is steep in the image where the face turns away
        edge_px = torch.from_numpy(distance_transform_edt(inside)).float()
        mask = mask * smoothstep(edge_px / max(_FEATHER * side_px, 1))
    window = Window(slice(top, top + size[0]), slice(left, left + size[1]))
    photo_px = camera.height_px, camera.width_px
    return FaceView(photo_px, window, uv, coverage, mask, vertices_camera, window_camera)


def rows_of_camera(camera: Camera, rows: slice) -> Camera:
    """Restrict a camera to some rows of its image."""
    height_px, cy_px = rows.stop - rows.start, camera.cy_px - rows.start
    return Camera(camera.focal_px, camera.width_px, height_px, camera.cx_px, cy_px)


def face_window(vertices_camera: Tensor, camera: Camera) -> tuple[int, int, Camera]:
    """Return the first row and column of the image window around the mesh, with a margin, and its camera."""
    in_front = torch.cat([vertices_camera[:, :2], vertices_camera[:, 2:].clamp(max=-_TINY)], 1)
    x, y = project(in_front, camera).T
    left, right = (int(v.floor().clamp(0, camera.width_px - 1)) for v in (x.min() - 1, x.max() + 1))
    top, bottom = (int(v.floor().clamp(0, camera.height_px - 1)) for v in (y.min() - 1, y.max() + 1))
    width, height = right + 1 - left, bottom + 1 - top
    return top, left, Camera(camera.focal_px, width, height, camera.cx_px - left, camera.cy_px - top)


def see_face(vertices_camera: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Rasterize the mesh [V, 3] to (u, v) [H, W, 2] and coverage [H, W], 0 or 1."""
    fragments = rasterize(vertices_camera, grid_triangles(), camera)
    return interpolate(grid_uv(), grid_triangles(), fragments), fragments.covered.float()


def render_face(textures: Tensor, uv: Tensor, coverage: Tensor) -> Tensor:
    """Render textures [N, C, T, T] on the pixels of `see_face` to [N, C, H, W], black outside the mesh."""
    images = sample_texture(textures.flatten(0, 1), uv) * coverage[..., None]  # [H, W, N C]
    return images.permute(2, 0, 1).reshape(*textures.shape[:2], *coverage.shape)


def draw_fit(photo: np.ndarray, fit: FaceFit, model: MorphableModel) -> np.ndarray:
    """Draw the half-transparent mesh and landmarks over a linear photo [H, W, 3] at automatic exposure.

    The fit's targets are green; its landmarks, without the sliding contour, are orange.
    """
    image = (photo * np.float32(2 ** auto_exposure_ev(photo))).clip(0, 1)
    height, width = photo.shape[:2]
    vertices = fit.vertices_camera(model)
    view = view_face(vertices, photo_camera(fit.crop, height, width), fit.crop.side_px)
    region = image[view.window]  # drawn in place
    covered = view.coverage.numpy()[..., None]
    shade = view.normal[..., 2:].clamp(0, 1).numpy()
    region += _SHADE * covered * (shade - region)
    line_px = max(1.0, fit.crop.side_px / 600)
    region += _LINE * covered * _wires(view.uv.numpy(), line_px)[..., None] * (_WIRE_COLOUR - region)
    fitted_px = project(model.landmarks(vertices[None])[0, len(CONTOUR) :], fit.camera).numpy()
    radius_px = max(1.0, _DOT * fit.crop.side_px)
    _dots(image, fit.crop.to_photo(fit.landmarks_px.numpy()), _TARGET_COLOUR, radius_px)
    _dots(image, fit.crop.to_photo(fitted_px), _FITTED_COLOUR, 0.6 * radius_px)
    return image


def _wires(uv: np.ndarray, line_px: float) -> np.ndarray:
    """Compute the opacity [h, w] in 0..1 of lines of constant u and v, about `line_px` wide in the image."""
    lines = np.zeros(uv.shape[:2], np.float32)
    if min(lines.shape) < 2:
        return lines
    for coordinate in np.moveaxis(_CELLS * uv, -1, 0):
        down, right = np.gradient(coordinate)
        distance_px = np.abs(coordinate - np.round(coordinate)) / np.maximum(np.hypot(down, right), 1e-6)
        lines = np.maximum(lines, np.clip((line_px + 1) / 2 - distance_px, 0, 1))
    return lines


def _dots(image: np.ndarray, points_px: np.ndarray, colour: tuple[float, ...], radius_px: float) -> None:
    """Draw antialiased discs at points [N, 2] into an image [H, W, 3]."""
    for x, y in points_px:
        left, top = (max(0, int(centre - radius_px - 1)) for centre in (x, y))
        patch = image[top : max(top, int(y + radius_px + 2)), left : max(left, int(x + radius_px + 2))]
        rows, columns = (np.arange(size) + PIXEL_CENTRE for size in patch.shape[:2])
        distance = np.hypot(columns[None, :] + left - x, rows[:, None] + top - y)
        patch += np.clip(radius_px + 0.5 - distance, 0, 1)[..., None] * (np.array(colour) - patch)
