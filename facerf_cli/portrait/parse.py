"""Squares of a photo as input of the Parsing Network; its classes, and its landmarks beyond the 68."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.crop import Crop
from facerf_cli.face.topology import MIRROR_68
from facerf_cli.image.strips import block_means
from facerf_cli.network.parsing import Parsing, ParsingNetwork
from facerf_cli.raster.camera import PIXEL_CENTRE

CLASSES = (
    "background",
    "skin",
    "brows",
    "eyes",
    "lips",
    "mouth",
    "hair",
    "beard",
    "ears",
    "neck",
    "glasses",
    "headwear",
    "garment",
    "hand",
)
IRIS_POINTS = 8  # on the outline of an iris, from its right end counter-clockwise
MORE_LANDMARKS = tuple(
    f"{side} {name}"
    for side in ("left", "right")  # of the image
    for name in ("iris", *(f"iris {k}" for k in range(IRIS_POINTS)), "ear top", "ear lobe", "ear back")
)
LANDMARKS = 68 + len(MORE_LANDMARKS)
LEAST_PRESENCE = 0.5  # of a head
_POOLED = 12  # margin of the middle of a crop for measuring its sharpness, in pixels
_OF_THE_FACE = ("skin", "brows", "eyes", "lips", "mouth", "beard", "ears", "neck")
_COVERED = (0.35, 0.65)  # coverage of a pixel that counts as 0, and as 1


def class_index(name: str) -> int:
    return CLASSES.index(name)


def _mirrored(name: str) -> str:
    side, part, *point = name.split(" ")
    if part == "iris" and point:
        point = [str((IRIS_POINTS // 2 - int(point[0])) % IRIS_POINTS)]
    return " ".join(["left" if side == "right" else "right", part, *point])


# Index of the landmark that each landmark becomes in a mirrored image.
MIRROR = np.concatenate(
    [MIRROR_68, 68 + np.array([MORE_LANDMARKS.index(_mirrored(name)) for name in MORE_LANDMARKS])]
)


def unit_centres(side: int) -> np.ndarray:
    """Return the pixel centres [side, side, 2] of a square, as fractions of its side."""
    at = (np.arange(side) + PIXEL_CENTRE) / side
    return np.stack(np.meshgrid(at, at), -1)


@dataclass(frozen=True)
class Square:
    """Square of a photo: its centre and side in the photo's pixels, rotated counter-clockwise."""

    x_px: float
    y_px: float
    side_px: float
    turn_rad: float = 0.0

    @staticmethod
    def around(landmarks_px: np.ndarray, sides: float, above: float = 0.0) -> "Square":
        """Return an upright square around a face with landmarks [68, 2].

        Its side, and the distance of its centre above theirs, are in extents: the larger side of their
        bounds.
        """
        low, high = landmarks_px.min(0), landmarks_px.max(0)
        extent_px = float((high - low).max())
        x_px, y_px = (low + high) / 2
        return Square(float(x_px), float(y_px) - above * extent_px, sides * extent_px)

    def to_photo(self, share: np.ndarray) -> np.ndarray:
        """Convert positions [..., 2], in fractions of the side from the corner, to the photo's pixels."""
        return (np.asarray(share) - 0.5) @ self._matrix.T + (self.x_px, self.y_px)

    def to_unit_square(self, photo_px: np.ndarray) -> np.ndarray:
        """Convert the photo's pixels [..., 2] to fractions of the side from the corner."""
        return (np.asarray(photo_px) - (self.x_px, self.y_px)) @ np.linalg.inv(self._matrix).T + 0.5

    @property
    def _matrix(self) -> np.ndarray:
        cos, sin = math.cos(self.turn_rad), math.sin(self.turn_rad)
        return self.side_px * np.array([[cos, sin], [-sin, cos]])

    def cut(self, image_srgb: np.ndarray, size_px: int, outside: float | None = None) -> Tensor:
        """Resample an sRGB image [H, W, 3], uint8 or in 0..1, to [3, size, size] in 0..1.

        Pixels outside the image repeat its border, or have the value `outside`.
        """
        height, width = image_srgb.shape[:2]
        corners = self.to_photo(np.array([[0, 0], [1, 0], [0, 1], [1, 1]]))
        step = max(1, int(self.side_px / size_px))  # photo pixels that are averaged first
        low = (np.floor(corners.min(0)).astype(int) - 2 * step).clip(0, (width - 1, height - 1))
        high = (np.ceil(corners.max(0)).astype(int) + 2 * step).clip(low + 1, (width, height))
        low = np.maximum(0, np.minimum(low, high - step))
        count = np.maximum(1, (high - low) // step)
        region = image_srgb[low[1] : low[1] + count[1] * step, low[0] : low[0] + count[0] * step]
        means = block_means(region, step if min(region.shape[:2]) >= step else 1)
        small = torch.from_numpy(means).permute(2, 0, 1)[None] / (255 if image_srgb.dtype == np.uint8 else 1)
        positions_px = self.to_photo(unit_centres(size_px))
        size = np.array(small.shape[:1:-1])
        grid = torch.from_numpy(2 * (positions_px - low) / step / size - 1).float()[None]
        cut = F.grid_sample(small, grid, padding_mode="border", align_corners=False)[0]
        if outside is None:
            return cut
        within = ((positions_px >= 0) & (positions_px <= (width, height))).all(-1)
        return torch.where(torch.from_numpy(within), cut, outside)

    def laid_over(
        self, view: Tensor, size: tuple[int, int], photo_px: tuple[int, ...], rim: float
    ) -> tuple[Tensor, Tensor]:
        """Place a view [C, S, S] of an upright square on a map [C, h, w] of a photo of H x W pixels.

        Also return its weight [h, w]: 1 well inside the square, falling to 0 at its border over `rim` sides.
        It stays 1 where the border lies outside the photo.
        """
        axes, weights = [], []
        for count, length, middle_px in zip(size, photo_px, (self.y_px, self.x_px), strict=False):
            at = ((torch.arange(count) + PIXEL_CENTRE) * length / count - middle_px) / self.side_px + 0.5
            low, high = (at / rim).clamp(0, 1), ((1 - at) / rim).clamp(0, 1)
            if middle_px < self.side_px / 2:
                low = (at >= 0).float()
            if middle_px > length - self.side_px / 2:
                high = (at <= 1).float()
            axes.append(2 * at - 1)
            weights.append(low * high)
        grid = torch.stack(torch.meshgrid(axes[1], axes[0], indexing="xy"), -1)[None]
        placed = F.grid_sample(view[None], grid, padding_mode="border", align_corners=False)[0]
        return placed, weights[0][:, None] * weights[1]


def whole_photo(image_srgb: np.ndarray, turn_rad: float = 0.0) -> Square:
    """Return the square around a whole image [H, W, 3], rotated."""
    height, width = image_srgb.shape[:2]
    return Square(width / 2, height / 2, float(max(height, width)), turn_rad)


@dataclass(frozen=True, eq=False)
class SquareView:
    """The network's view of a square: logits [C, S, S] of the classes; landmarks [N, 2] in the photo.

    error_px [N] are the landmarks' expected errors; presence in 0..1 is the probability of a head. For
    sharpness see `sharpness_of`, for unsteadiness `find.py`.
    """

    square: Square
    logits: Tensor
    landmarks_px: np.ndarray
    error_px: np.ndarray
    presence: float
    sharpness: float = 1.0
    unsteadiness: float = 0.0

    @property
    def classes(self) -> Tensor:
        """Probabilities [C, S, S] of the classes, computed at each access."""
        return self.logits.softmax(0)

    @property
    def extent_px(self) -> float:
        return float(np.ptp(self.landmarks_px[:68], axis=0).max())

    @property
    def relative_error(self) -> float:
        """Median expected error of the 68 landmarks, relative to their extent."""
        return float(np.median(self.error_px[:68])) / max(self.extent_px, 1e-6)


def sharpness_of(crops: Tensor) -> Tensor:
    """Return the contrast of finest over that of coarser detail [B] in the middle of crops [B, 3, S, S].

    In a square of 256 pixels around a face it is at least 0.4 if the face is in focus. It is 0.2 and 0.14 if
    the image is blurred by a hundredth and a fiftieth of the face's extent (standard deviation).
    """
    edge = crops.shape[-1] // 4 - _POOLED
    grey = crops[..., edge:-edge, edge:-edge].mean(1, keepdim=True)
    fine = _box_mean(_box_mean(grey, 1), 1)
    bands = grey - fine, fine - _box_mean(_box_mean(fine, 4), 4)
    high, low = (band[..., _POOLED:-_POOLED, _POOLED:-_POOLED].abs().mean((1, 2, 3)) for band in bands)
    return high / low.clamp_min(1e-4)


def _box_mean(grey: Tensor, reach: int) -> Tensor:
    return F.avg_pool2d(grey, 2 * reach + 1, 1, reach, count_include_pad=False)


@torch.inference_mode()
def look(network: ParsingNetwork, image_srgb: np.ndarray, squares: Sequence[Square]) -> list[SquareView]:
    """Run the Parsing Network on squares of an sRGB uint8 image [H, W, 3]."""
    device = next(network.parameters()).device
    crops = torch.stack([square.cut(image_srgb, network.side) for square in squares])
    sharpness = sharpness_of(crops)
    parsing = Parsing(*(part.cpu() for part in network(crops.to(device))))
    landmarks, log_error = parsing.landmarks.double(), parsing.log_error.double()
    return [
        SquareView(
            square,
            parsing.logits[index].float(),
            square.to_photo(landmarks[index].numpy()),
            log_error[index].exp().numpy() * square.side_px,
            float(parsing.presence[index].sigmoid()),
            float(sharpness[index]),
        )
        for index, square in enumerate(squares)
    ]


def uncovered(view: SquareView, crop: Crop) -> np.ndarray:
    """Return how far each pixel [S, S] of a crop shows the face, without hair, glasses or a hand, in 0..1.

    Outside of the network's view it is 1.
    """
    return _uncovered_at(view.classes, view.square.to_unit_square(_positions_px(crop)))


def uncovered_in(classes: Tensor, size_px: tuple[int, int], crop: Crop) -> np.ndarray:
    """Compute `uncovered` from the classes [C, h, w] of a whole photo of H x W pixels."""
    return _uncovered_at(classes, _positions_px(crop) / (size_px[1], size_px[0]))


def uncovered_by(matte: np.ndarray, crop: Crop) -> np.ndarray:
    """Compute `uncovered` from a matte [H, W] of the photo: other people and things cover the face."""
    return uncovered_fraction(1 - crop.apply(matte[..., None])[..., 0])


def _positions_px(crop: Crop) -> np.ndarray:
    """Return the centres [S, S, 2] of a crop's pixels in the photo."""
    centres = (np.arange(crop.size_px) + PIXEL_CENTRE) / crop.scale
    return np.stack(np.meshgrid(centres + crop.x0_px, centres + crop.y0_px), -1)


def _uncovered_at(classes: Tensor, positions: np.ndarray) -> np.ndarray:
    """Sample at positions [S, S, 2], in fractions of the width and height of classes [C, h, w]."""
    grid = torch.from_numpy(2 * positions - 1).float()[None]
    sampled = F.grid_sample(covering(classes)[None, None], grid, align_corners=False)[0, 0]
    return uncovered_fraction(sampled.numpy())


def covering(classes: Tensor) -> Tensor:
    """Return the coverage [h, w] by classes [C, h, w] that are not of the face."""
    of_face = torch.tensor([name in _OF_THE_FACE for name in CLASSES])
    return classes[~of_face].sum(0).float()


def uncovered_fraction(covered: np.ndarray) -> np.ndarray:
    """Return the visibility in 0..1 of a face covered by a fraction of other things."""
    low, high = _COVERED
    return (1 - (covered - low) / (high - low)).clip(0, 1)
