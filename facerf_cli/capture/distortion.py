"""Lens distortion of calibrated cameras: OpenCV's coefficients, undone where a frame is read."""

from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.joint_fit import PosedCamera

Coefficients = tuple[float, ...]  # k1, k2, p1, p2 and, where there are five, k3
_STEPS = 64  # of the radius along which a lens is examined


def distorted(plane: Tensor, coefficients: Coefficients) -> Tensor:
    """Move points of the plane at depth 1 [..., 2] (x right, y down) as the lens does.

    OpenCV's documentation, 'Camera Calibration and 3D Reconstruction': radial and tangential distortion.
    """
    k1, k2, p1, p2, k3 = (*coefficients, 0.0)[:5]
    x, y = plane.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    aside, down = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return torch.stack([x * radial + aside, y * radial + down], -1)


def folds(camera: PosedCamera, coefficients: Coefficients) -> bool:
    """True where radial distortion brings points of the image nearer again: such a lens has no inverse."""
    k1, k2, _, _, k3 = (*coefficients, 0.0)[:5]
    corners = torch.tensor([[x, y] for x in (0.0, camera.width_px) for y in (0.0, camera.height_px)])
    r2 = (np.linspace(0, 1, _STEPS) * float(camera.to_plane(corners).norm(dim=-1).max())) ** 2
    return bool((1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) <= 0).any())


def undistorted(image: np.ndarray, camera: PosedCamera, coefficients: Coefficients) -> np.ndarray:
    """Resample an image [H, W, 3] as the same camera sees it without distortion; the border is repeated."""
    view = (camera.focal_px, camera.centre_px, camera.width_px, camera.height_px)
    pixels = torch.from_numpy(image).permute(2, 0, 1)[None]
    grid = _grid(*view, coefficients)
    flat = F.grid_sample(pixels, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return np.ascontiguousarray(flat[0].permute(1, 2, 0).numpy())


@lru_cache(maxsize=16)  # all frames of a camera share it
def _grid(
    focal_px: tuple[float, float],
    centre_px: tuple[float, float],
    width_px: int,
    height_px: int,
    coefficients: Coefficients,
) -> Tensor:
    """Place of each undistorted pixel in the distorted image [1, H, W, 2], in units of `grid_sample`."""
    focal, centre, size = (
        torch.tensor(pair, dtype=torch.float64) for pair in (focal_px, centre_px, (width_px, height_px))
    )
    rows, columns = torch.meshgrid(torch.arange(height_px) + 0.5, torch.arange(width_px) + 0.5, indexing="ij")
    plane = (torch.stack([columns, rows], -1).double() - centre) / focal
    px = distorted(plane, coefficients) * focal + centre
    return (2 * px / size - 1).float()[None]
