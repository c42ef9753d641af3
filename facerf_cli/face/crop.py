"""Square, axis-aligned crop of a photo around a face (paper, 'Dataset').

Pixel positions follow `raster/camera.py`: centres at index + `PIXEL_CENTRE`, origin at the top-left corner.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from facerf_cli.errors import InputError
from facerf_cli.face.topology import LANDMARKS_M, TOP_M
from facerf_cli.image.strips import strips
from facerf_cli.raster.camera import PIXEL_CENTRE, Camera, crop_camera

Box = tuple[float, float, float, float]  # left, top, right, bottom in a photo's pixels
# A `from_landmarks` crop relative to a detector's box: the crop's side, and the height of its centre above
# the box's centre, both in units of the box's side.
_PER_BOX, _ABOVE_BOX = 1.48, 0.02
MARGIN = 1.28  # the crop's side relative to the extent of chin, temples and forehead
PASS_LANDMARKS = "pass its landmarks (--landmarks FILE)"
_LARGEST = 16  # largest crop side relative to the photo's longer side; bounds the cost of resampling
_SMALLEST_FACE_PX = 4.0  # landmarks within fewer pixels cannot be a face
_EYES, _MOUTH = slice(36, 48), slice(48, 68)
# Height of the hairline above the eyes, in units of the distance from the eyes to the mouth.
_EYES_M, _MOUTH_M = LANDMARKS_M[_EYES].mean(0), LANDMARKS_M[_MOUTH].mean(0)
_FOREHEAD = (TOP_M - _EYES_M[1]) / (_EYES_M[1] - _MOUTH_M[1])


@dataclass(frozen=True)
class Crop:
    """Square of `side_px` photo pixels from (x0_px, y0_px), resampled to size_px x size_px crop pixels."""

    x0_px: float
    y0_px: float
    side_px: float
    size_px: int

    @property
    def camera(self) -> Camera:
        """Fixed camera of the crop."""
        return crop_camera(self.size_px)

    @property
    def scale(self) -> float:
        """Crop pixels per photo pixel."""
        return self.size_px / self.side_px

    def of_scaled(self, scale: float) -> "Crop":
        """Return the same crop of the scaled photo."""
        return Crop(self.x0_px * scale, self.y0_px * scale, self.side_px * scale, self.size_px)

    def to_crop(self, photo_px: np.ndarray) -> np.ndarray:
        """Convert photo positions [..., 2] to crop pixels."""
        return (np.asarray(photo_px, np.float64) - (self.x0_px, self.y0_px)) * self.scale

    def to_photo(self, crop_px: np.ndarray) -> np.ndarray:
        """Convert crop positions [..., 2] to photo pixels."""
        return np.asarray(crop_px, np.float64) / self.scale + (self.x0_px, self.y0_px)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Resample an image [H, W, C] to float32 [size, size, C]; edge pixels repeat beyond the border.

        The filter is Catmull-Rom, widened if a crop pixel is larger than a photo pixel. The result is clipped
        to the range of the image region, so that radiance stays non-negative. Raises InputError for a crop
        larger than `_LARGEST` times the photo.
        """
        if image.ndim != 3:
            raise ValueError(f"image: its shape is {image.shape}, not [H, W, C]")
        longer_px = max(image.shape[:2])
        if not self.side_px <= _LARGEST * longer_px:
            raise InputError(
                f"the face is {self.side_px:.0f} pixels wide, the photo {longer_px}; {PASS_LANDMARKS}"
            )
        rows = _resampler(image.shape[0], self.y0_px, self.side_px, self.size_px)
        columns = _resampler(image.shape[1], self.x0_px, self.side_px, self.size_px)
        top, bottom = _used(rows)
        left, right = _used(columns)
        region = image[top:bottom, left:right]
        width, channels = region.shape[1:]
        tall = np.zeros((self.size_px, width * channels), np.float32)
        low, high = np.full(channels, np.inf, np.float32), np.full(channels, -np.inf, np.float32)
        for part in strips(region.shape):
            values = np.ascontiguousarray(region[part], np.float32)
            tall += rows[:, top + part.start : top + part.stop] @ values.reshape(len(values), -1)
            # reducing the rows first is many times faster
            low, high = np.minimum(low, values.min(0).min(0)), np.maximum(high, values.max(0).max(0))
        tall = tall.reshape(self.size_px, width, channels).transpose(1, 0, 2).reshape(width, -1)
        cut = (columns[:, left:right] @ tall).reshape(self.size_px, self.size_px, channels)
        bounded = np.clip(cut.transpose(1, 0, 2), low, high)
        return np.ascontiguousarray(bounded, np.float32)

    def valid(self, height_px: int, width_px: int) -> np.ndarray:
        """Return the crop pixels whose centre lies inside a photo of that size, bool [size, size]."""
        centres_px = np.arange(self.size_px) + PIXEL_CENTRE
        x, y = self.to_photo(np.stack([centres_px, centres_px], -1)).T
        return ((y >= 0) & (y <= height_px))[:, None] & ((x >= 0) & (x <= width_px))


def from_landmarks(landmarks_px: np.ndarray, size_px: int) -> Crop:
    """Crop around landmarks [68, 2] in photo pixels, including chin, temples, forehead and a margin."""
    landmarks_px = check_landmarks(landmarks_px)
    up = landmarks_px[_EYES].mean(0) - landmarks_px[_MOUTH].mean(0)
    forehead_px = landmarks_px[[0, *range(17, 27), 16]]
    # Moving brows and temples along the face's up direction includes the forehead at any roll.
    along = (forehead_px - landmarks_px[_EYES].mean(0)) @ up / (up @ up)
    points = np.concatenate([landmarks_px, forehead_px + (_FOREHEAD - along)[:, None] * up])
    low, high = points.min(0), points.max(0)
    side_px = MARGIN * float((high - low).max())
    x0_px, y0_px = (low + high - side_px) / 2
    return Crop(float(x0_px), float(y0_px), side_px, size_px)


def from_box(box_px: Box, size_px: int) -> Crop:
    """Crop around a detector's box, approximately like `from_landmarks` for the same face."""
    left, top, right, bottom = box_px
    box_side_px = (right - left + bottom - top) / 2
    if not 0 < box_side_px < math.inf:
        raise InputError(f"box {box_px}: not a face box; use left, top, right and bottom in pixels")
    side_px = _PER_BOX * box_side_px
    x_px, y_px = (left + right) / 2, (top + bottom) / 2 - _ABOVE_BOX * box_side_px
    return Crop(x_px - side_px / 2, y_px - side_px / 2, side_px, size_px)


def box_of(crop: Crop) -> Box:
    """Return the box for which `from_box` returns this crop."""
    box_side_px = crop.side_px / _PER_BOX
    x_px = crop.x0_px + crop.side_px / 2
    y_px = crop.y0_px + crop.side_px / 2 + _ABOVE_BOX * box_side_px
    half_px = box_side_px / 2
    return x_px - half_px, y_px - half_px, x_px + half_px, y_px + half_px


def check_landmarks(landmarks_px: np.ndarray) -> np.ndarray:
    """Return the landmarks as float64 [68, 2]; raises InputError if they cannot be a face."""
    landmarks_px = np.asarray(landmarks_px, np.float64)
    if landmarks_px.shape != (68, 2):
        raise InputError(f"landmarks: their shape is {landmarks_px.shape}; use 68 pairs of x and y")
    if not np.isfinite(landmarks_px).all():
        raise InputError("landmarks: some values are not finite; detect them again or correct the file")
    eyes_to_mouth_px = np.linalg.norm(landmarks_px[_EYES].mean(0) - landmarks_px[_MOUTH].mean(0))
    if min(np.ptp(landmarks_px, axis=0).min(), eyes_to_mouth_px) < _SMALLEST_FACE_PX:
        raise InputError("landmarks: they lie on one point or line; use a face of at least a few pixels")
    return landmarks_px


def check_in_photo(landmarks_px: np.ndarray, height_px: int, width_px: int) -> np.ndarray:
    """Return the landmarks [68, 2]; raises InputError if they probably belong to another photo or unit.

    Their median must lie in the photo and their extent within twice its size; the border may cut a face.
    """
    middle_px, extent_px = np.median(landmarks_px, 0), np.ptp(landmarks_px, axis=0).max()
    inside = (middle_px >= 0).all() and (middle_px <= (width_px, height_px)).all()
    if not inside or extent_px > 2 * max(height_px, width_px):
        raise InputError(
            f"landmarks: outside the image: around ({middle_px[0]:.0f}, {middle_px[1]:.0f}) and "
            f"{extent_px:.0f} pixels wide, in a photo of {width_px} x {height_px}; use the photo's landmarks"
        )
    return landmarks_px


def _resampler(length: int, start_px: float, side_px: float, size_px: int) -> csr_array:
    """Return the weights [size, length] of one-dimensional Catmull-Rom resampling with repeated ends."""
    step = side_px / size_px
    width = max(step, 1.0)  # photo pixels per unit of the kernel
    centres_px = start_px + (np.arange(size_px) + PIXEL_CENTRE) * step
    taps = math.ceil(4 * width) + 1
    index = np.floor(centres_px - PIXEL_CENTRE - 2 * width).astype(np.int64)[:, None] + np.arange(taps + 1)
    weights = _catmull_rom((index + PIXEL_CENTRE - centres_px[:, None]) / width)
    weights /= weights.sum(1, keepdims=True)
    row = np.broadcast_to(np.arange(size_px)[:, None], index.shape)
    entries = (weights.ravel().astype(np.float32), (row.ravel(), index.clip(0, length - 1).ravel()))
    return csr_array(entries, shape=(size_px, length))


def _catmull_rom(x: np.ndarray) -> np.ndarray:
    x = np.abs(x)
    inner = 1.5 * x**3 - 2.5 * x**2 + 1
    outer = -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
    return np.where(x < 1, inner, np.where(x < 2, outer, 0.0))


def _used(weights: csr_array) -> tuple[int, int]:
    """Return the range of photo pixels that any crop pixel reads."""
    used = weights.indices[weights.data != 0]
    return int(used.min()), int(used.max()) + 1
