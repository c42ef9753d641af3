"""A prior for the class of ears, which are small: the network's own landmarks tell where they must be.

Ears get the benefit of the doubt near the line through the landmarks of top, back and lobe. Odds are
multiplied, so that what the network is sure of (hair over the ears, a hat) stays.
"""

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from facerf_cli.portrait.classes import MORE_LANDMARKS, class_index
from facerf_cli.portrait.parse import Seen

_LIFT = 1.25  # logarithm of the largest factor of the odds
_WIDTH = 0.045  # standard deviation of the distance from the line, in extents of the landmarks
_REACH = 3.0  # in these, beyond which nothing changes
_OTHERS = [class_index(name) for name in ("background", "skin", "hair", "neck")]
_LINES = [
    [68 + MORE_LANDMARKS.index(f"{side} ear {part}") for part in ("top", "back", "lobe")]
    for side in ("left", "right")
]


def with_ears(classes: Tensor, seen: Seen, places_px: np.ndarray) -> Tensor:
    """Classes [C, h, w] with likelier ears at pixels that lie at places [h, w, 2] in the photo.

    Shares move between ears and background, skin, hair and neck; others stay.
    """
    lifted, ears = classes.clone(), class_index("ears")
    other = classes[_OTHERS].sum(0)
    both = classes[ears] + other
    likelier = classes[ears] * torch.from_numpy(np.exp(_LIFT * _nearness(seen, places_px))).float()
    lifted[ears] = both * likelier / (likelier + other).clamp_min(1e-9)
    lifted[_OTHERS] *= (both - lifted[ears]) / other.clamp_min(1e-9)
    return lifted


def _nearness(seen: Seen, places_px: np.ndarray) -> np.ndarray:
    """Nearness [h, w] in 0..1 of places [h, w, 2] to the lines of both ears."""
    near = np.zeros(places_px.shape[:2])
    width_px = _WIDTH * max(seen.extent_px, 1.0)
    for line in (seen.landmarks_px[ear] for ear in _LINES):
        low, high = line.min(0) - _REACH * width_px, line.max(0) + _REACH * width_px
        around = ((places_px > low) & (places_px < high)).all(-1)
        apart = np.min([_distance(places_px[around], *pair) for pair in pairwise(line)], 0)
        near[around] = np.maximum(near[around], np.exp(-0.5 * (apart / width_px) ** 2))
    return near


def _distance(places: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distance [N] of places [N, 2] from the segment between two points [2]."""
    along = end - start
    share = (((places - start) @ along) / max(float(along @ along), 1e-9)).clip(0, 1)
    return np.asarray(np.linalg.norm(places - start - share[..., None] * along, axis=-1))
