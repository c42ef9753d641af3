"""Images, photos and their heads at another size."""

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.face.crop import Crop
from facerf_cli.face.head import Head


def resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """An image [H, W, C] or [H, W] at another size, smoothed where it becomes smaller."""
    planes = torch.from_numpy(np.ascontiguousarray(image, np.float32))
    planes = planes[None] if planes.ndim == 2 else planes.permute(2, 0, 1)
    sized = F.interpolate(planes[None], (height, width), mode="bilinear", align_corners=False, antialias=True)
    plain = sized[0].permute(1, 2, 0).numpy()
    return np.ascontiguousarray(plain[..., 0] if image.ndim == 2 else plain)


def fitted(height: int, width: int, most_px: int) -> tuple[int, int]:
    """The size of a frame whose longer side is `most_px` at most."""
    scale = min(1.0, most_px / max(height, width))
    return max(1, round(height * scale)), max(1, round(width * scale))


def shrunk_photo(photo: np.ndarray, head: Head, most_px: int) -> tuple[np.ndarray, Head]:
    """A photo [H, W, 3] of `most_px` at most, and its head in the pixels of the smaller one."""
    height, width = fitted(photo.shape[0], photo.shape[1], most_px)
    if (height, width) == photo.shape[:2]:
        return photo, head
    return resized(photo, height, width), moved_head(head, 0, 0, width / photo.shape[1])


def moved_head(head: Head, left: int, top: int, scale: float) -> Head:
    """A head of a photo, in the pixels of a part of it that begins at `left`, `top` and is then scaled."""
    return replace(head, fit=replace(head.fit, crop=moved_crop(head.fit.crop, left, top, scale)))


def moved_crop(crop: Crop, left: int, top: int, scale: float) -> Crop:
    """A crop of a photo, in the pixels of a part of it that begins at `left`, `top` and is then scaled."""
    x0_px, y0_px = (crop.x0_px - left) * scale, (crop.y0_px - top) * scale
    return replace(crop, x0_px=x0_px, y0_px=y0_px, side_px=crop.side_px * scale)
