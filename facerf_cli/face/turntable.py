"""A face model seen from eight sides, shaded as clay: what `facerf face-model show` draws."""

import math

import numpy as np
import torch
import trimesh
from torch import Tensor

from facerf_cli.face.head_model import HEAD_PARTS
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import grid_triangles
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.raster.rasterize import interpolate, rasterize

POSES = 8
_COLUMNS = 4
_FACE_SPAN_DEG = 80.0  # a face without a head behind it is turned this far to either side
_OVERSAMPLE = 3
_FOCAL_PER_SIDE = 4.0
_FILL = 0.9  # of a cell, by the model's sphere
_LIGHT = torch.nn.functional.normalize(torch.tensor([-0.5, 0.6, 0.8]), dim=0)
_AMBIENT, _DIFFUSE = 0.12, 0.75
_BACKGROUND = 0.02
_COLOURS = {
    "skin": (0.62, 0.55, 0.50),
    "eye": (0.8, 0.8, 0.8),
    "mouth": (0.4, 0.16, 0.15),
    "teeth": (0.7,) * 3,
}


def draw_turntable(model: MorphableModel, cell_px: int = 256) -> np.ndarray:
    """The mean from eight sides, linear Rec.709 [2 cell_px, 4 cell_px, 3]: its head, or the face alone.

    A head turns once around, a face from one profile to the other; light comes from the upper left.
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
    """Vertices [N, 3], triangles [F, 3] and colours [N, 3] of what is drawn."""
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
    """One cell [cell_px, cell_px, 3], its pixels averaged over `_OVERSAMPLE`^2 samples."""
    side_px = cell_px * _OVERSAMPLE
    camera = Camera(_FOCAL_PER_SIDE * side_px, side_px, side_px, side_px / 2, side_px / 2)
    head_to_camera = pose_to_rotation(yaw_deg, 0, 0)
    radius_m = float(vertices.norm(dim=-1).max())
    # A sphere's outline is where rays touch it: sin of the half angle, not tan.
    away_m = radius_m / math.sin(math.atan(_FILL / (2 * _FOCAL_PER_SIDE)))
    posed = vertices @ head_to_camera.T - torch.tensor([0, 0, away_m])
    fragments = rasterize(posed, triangles, camera)
    normal = torch.nn.functional.normalize(interpolate(normals, triangles, fragments), dim=-1)
    facing = normal @ (_LIGHT @ head_to_camera)  # the light stays with the camera
    shade = _AMBIENT + _DIFFUSE * facing.clamp(min=0)
    picture = interpolate(colours, triangles, fragments) * shade[..., None]
    picture = torch.where(fragments.covered[..., None], picture, torch.tensor(_BACKGROUND))
    blocks = picture.reshape(cell_px, _OVERSAMPLE, cell_px, _OVERSAMPLE, 3)
    return blocks.mean((1, 3)).numpy()
