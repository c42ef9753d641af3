"""A fit drawn over its photo, for people to judge it by."""

import numpy as np

from facerf_cli.colour import auto_exposure_ev
from facerf_cli.face.composite import photo_camera, view_face
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import CONTOUR
from facerf_cli.raster.camera import PIXEL_CENTRE, project

_CELLS = 16  # of the wire mesh, along u and along v
_SHADE, _LINE = 0.35, 0.5  # opacity of the shaded mesh and of its wires
_WIRE_COLOUR = np.array([0.1, 0.5, 1.0], np.float32)
_GIVEN_COLOUR, _FITTED_COLOUR = (0.05, 1.0, 0.1), (1.0, 0.25, 0.0)
_DOT = 1 / 160  # radius over the crop's side


def draw_fit(photo: np.ndarray, fit: FaceFit, model: MorphableModel) -> np.ndarray:
    """The linear photo [H, W, 3] at automatic exposure, with the mesh half transparent and landmarks.

    Green are the landmarks that were given, orange those of the fit (without the sliding contour).
    """
    picture = (photo * np.float32(2 ** auto_exposure_ev(photo))).clip(0, 1)
    height, width = photo.shape[:2]
    vertices = fit.vertices_camera(model)
    view = view_face(vertices, photo_camera(fit.crop, height, width), fit.crop.side_px)
    region = picture[view.window]  # a view: drawn in place
    covered = view.coverage.numpy()[..., None]
    shade = view.normal[..., 2:].clamp(0, 1).numpy()
    region += _SHADE * covered * (shade - region)
    line_px = max(1.0, fit.crop.side_px / 600)
    region += _LINE * covered * _wires(view.uv.numpy(), line_px)[..., None] * (_WIRE_COLOUR - region)
    fitted_px = project(model.landmarks(vertices[None])[0, len(CONTOUR) :], fit.camera).numpy()
    radius_px = max(1.0, _DOT * fit.crop.side_px)
    _dots(picture, fit.crop.to_photo(fit.landmarks_px.numpy()), _GIVEN_COLOUR, radius_px)
    _dots(picture, fit.crop.to_photo(fitted_px), _FITTED_COLOUR, 0.6 * radius_px)
    return picture


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


def _dots(picture: np.ndarray, points_px: np.ndarray, colour: tuple[float, ...], radius_px: float) -> None:
    """Draw antialiased discs at points [N, 2] into a picture [H, W, 3]."""
    for x, y in points_px:
        left, top = (max(0, int(centre - radius_px - 1)) for centre in (x, y))
        patch = picture[top : max(top, int(y + radius_px + 2)), left : max(left, int(x + radius_px + 2))]
        rows, columns = (np.arange(size) + PIXEL_CENTRE for size in patch.shape[:2])
        distance = np.hypot(columns[None, :] + left - x, rows[:, None] + top - y)
        patch += np.clip(radius_px + 0.5 - distance, 0, 1)[..., None] * (np.array(colour) - patch)
