"""Images at another size."""

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.image.strips import Band, enlarged


def resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """An image [H, W, C] or [H, W] at another size, smoothed where it becomes smaller."""
    planes = torch.from_numpy(np.ascontiguousarray(image, np.float32))
    planes = planes[None] if planes.ndim == 2 else planes.permute(2, 0, 1)
    sized = F.interpolate(planes[None], (height, width), mode="bilinear", align_corners=False, antialias=True)
    plain = sized[0].permute(1, 2, 0).numpy()
    return np.ascontiguousarray(plain[..., 0] if image.ndim == 2 else plain)


def resized_rows(image: np.ndarray, size: tuple[int, int]) -> Band:
    """`resized`, by rows; those of a larger image are computed as they are asked for."""
    if size[0] < image.shape[0] or size[1] < image.shape[1]:
        small = resized(image, *size)
        return lambda rows: small[rows]
    maps = np.moveaxis(image.reshape(*image.shape[:2], -1), -1, 0)
    rest = (size[1], *image.shape[2:])
    return lambda rows: np.moveaxis(enlarged(maps, size, rows), 0, -1).reshape(-1, *rest)


def fitted(height: int, width: int, most_px: int) -> tuple[int, int]:
    """The size of a frame whose longer side is `most_px` at most."""
    scale = min(1.0, most_px / max(height, width))
    return max(1, round(height * scale)), max(1, round(width * scale))
