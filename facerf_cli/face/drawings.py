"""Drawings for visual checks: a fit over its photo, and a face model shaded as clay from eight sides."""

import math

import numpy as np
import torch
import trimesh
from torch import Tensor

from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import HEAD_PARTS, MorphableModel
from facerf_cli.face.topology import CONTOUR, grid_triangles
from facerf_cli.face.view import photo_camera, view_face
from facerf_cli.image.colour import auto_exposure_ev
from facerf_cli.raster.camera import PIXEL_CENTRE, Camera, pose_to_rotation, project
from facerf_cli.raster.rasterize import interpolate, rasterize

_CELLS = 16  # cells of the wire mesh along u and along v
_SHADE, _LINE = 0.35, 0.5  # opacity of the shaded mesh and of its wires
_WIRE_COLOUR = np.array([0.1, 0.5, 1.0], np.float32)
_TARGET_COLOUR, _FITTED_COLOUR = (0.05, 1.0, 0.1), (1.0, 0.25, 0.0)
_DOT = 1 / 160  # radius over the crop's side

POSES = 8
_COLUMNS = 4
_FACE_SPAN_DEG = 80.0  # a face without a whole head is turned this far to either side
_OVERSAMPLE = 3
_FOCAL_PER_SIDE = 4.0
_FILL = 0.9  # share of a cell that the model's bounding sphere fills
_LIGHT = torch.nn.functional.normalize(torch.tensor([-0.5, 0.6, 0.8]), dim=0)
_AMBIENT, _DIFFUSE = 0.12, 0.75
_BACKGROUND = 0.02
_COLOURS = {
    "skin": (0.62, 0.55, 0.50),
    "eye": (0.8, 0.8, 0.8),
    "mouth": (0.4, 0.16, 0.15),
    "teeth": (0.7,) * 3,
}


def draw_fit(photo: np.ndarray, fit: FaceFit, model: MorphableModel) -> np.ndarray:
    """Draw the half-transparent mesh and landmarks over a linear photo [H, W, 3] at automatic exposure.

    Green are the targets of the fit, orange its landmarks without the sliding contour.
    """
    image = (photo * np.float32(2 ** auto_exposure_ev(photo))).clip(0, 1)
    height, width = photo.shape[:2]
    vertices = fit.vertices_camera(model)
    view = view_face(vertices, photo_camera(fit.crop, height, width), fit.crop.side_px)
    region = image[view.window]  # a view: drawn in place
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
    """Opacity [h, w] in 0..1 of lines of constant u and v, about `line_px` wide on the screen."""
    lines = np.zeros(uv.shape[:2], np.float32)
    if min(lines.shape) < 2:
        return lines
    for coordinate in np.moveaxis(_CELLS * uv, -1, 0):
        down, right = np.gradient(coordinate)
        off_px = np.abs(coordinate - np.round(coordinate)) / np.maximum(np.hypot(down, right), 1e-6)
        lines = np.maximum(lines, np.clip((line_px + 1) / 2 - off_px, 0, 1))
    return lines


def _dots(image: np.ndarray, points_px: np.ndarray, colour: tuple[float, ...], radius_px: float) -> None:
    """Draw antialiased discs at points [N, 2] into an image [H, W, 3]."""
    for x, y in points_px:
        left, top = (max(0, int(centre - radius_px - 1)) for centre in (x, y))
        patch = image[top : max(top, int(y + radius_px + 2)), left : max(left, int(x + radius_px + 2))]
        rows, columns = (np.arange(size) + PIXEL_CENTRE for size in patch.shape[:2])
        distance = np.hypot(columns[None, :] + left - x, rows[:, None] + top - y)
        patch += np.clip(radius_px + 0.5 - distance, 0, 1)[..., None] * (np.array(colour) - patch)


def draw_turntable(model: MorphableModel, cell_px: int = 256) -> np.ndarray:
    """Draw the mean from eight sides, linear Rec.709 [2 cell_px, 4 cell_px, 3]: the head, or the face alone.

    A head makes a full turn, a face turns from one profile to the other; light comes from the upper left.
    """
    vertices, triangles, colours = _clay(model)
    low, high = vertices.amin(0), vertices.amax(0)
    vertices = vertices - (low + high) / 2
    whole = model.head is not None
    angles = np.arange(POSES) * 360 / POSES if whole else np.linspace(-_FACE_SPAN_DEG, _FACE_SPAN_DEG, POSES)
    normals = _normals(vertices, triangles)
    cells = [_draw(vertices, triangles, normals, colours, float(angle), cell_px) for angle in angles]
    rows = [np.concatenate(cells[at : at + _COLUMNS], 1) for at in range(0, POSES, _COLUMNS)]
    return np.concatenate(rows)


def _clay(model: MorphableModel) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices [N, 3], triangles [F, 3] and colours [N, 3] of the head or face."""
    if model.head is None:
        colours = torch.tensor(_COLOURS["skin"]).expand(len(model.mean), 3)
        return model.mean, grid_triangles(), colours
    palette = torch.tensor([_COLOURS[part] for part in HEAD_PARTS])
    return model.head.mean, model.head.triangles, palette[model.head.part.long()]


def _normals(vertices: Tensor, triangles: Tensor) -> Tensor:
    mesh = trimesh.Trimesh(vertices.numpy(), triangles.numpy(), process=False)
    return torch.from_numpy(np.array(mesh.vertex_normals, np.float32))


def _draw(
    vertices: Tensor, triangles: Tensor, normals: Tensor, colours: Tensor, yaw_deg: float, cell_px: int
) -> np.ndarray:
    """Draw one cell [cell_px, cell_px, 3], each pixel the mean of `_OVERSAMPLE`^2 samples."""
    side_px = cell_px * _OVERSAMPLE
    camera = Camera(_FOCAL_PER_SIDE * side_px, side_px, side_px, side_px / 2, side_px / 2)
    head_to_camera = pose_to_rotation(yaw_deg, 0, 0)
    radius_m = float(vertices.norm(dim=-1).max())
    # Rays along a sphere's outline are tangent to it: sin of the half angle, not tan.
    away_m = radius_m / math.sin(math.atan(_FILL / (2 * _FOCAL_PER_SIDE)))
    posed = vertices @ head_to_camera.T - torch.tensor([0, 0, away_m])
    fragments = rasterize(posed, triangles, camera)
    normal = torch.nn.functional.normalize(interpolate(normals, triangles, fragments), dim=-1)
    facing = normal @ (_LIGHT @ head_to_camera)  # the light stays with the camera
    shade = _AMBIENT + _DIFFUSE * facing.clamp(min=0)
    image = interpolate(colours, triangles, fragments) * shade[..., None]
    image = torch.where(fragments.covered[..., None], image, torch.tensor(_BACKGROUND))
    blocks = image.reshape(cell_px, _OVERSAMPLE, cell_px, _OVERSAMPLE, 3)
    return blocks.mean((1, 3)).numpy()
