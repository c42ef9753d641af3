"""Cloth that the Parsing Network takes for skin or a hand: collars, elbows of dark suits.

Such a part would be lit as skin. The photo's colours tell it from the person's own skin.
"""

import numpy as np
import torch
from scipy.ndimage import binary_dilation, gaussian_gradient_magnitude, label
from torch import Tensor

from facerf_cli.image.colour import srgb_to_linear
from facerf_cli.portrait.classes import class_index
from facerf_cli.portrait.people import HeadPlace

_SKIN = [class_index(name) for name in ("skin", "neck", "hand")]
_FACE = [class_index(name) for name in ("skin", "neck", "ears", "lips", "beard")]
_HAND, _GARMENT = class_index("hand"), class_index("garment")
_MAYBE = 0.3  # share of skin in a pixel from which it is looked at
_SURE, _SURE_BESIDE = 0.9, 0.8  # shares of certain skin, in the face and beside a part
_FACE_REACH = 0.7  # of certain skin of the face from its middle, in heights of the head
_EDGE = 0.12  # change of log brightness over a pixel, at which parts end
_EDGE_PX = 3  # half the width of such an edge
_BLACK, _NOISE = 5e-4, 2e-3  # linear light that hides the chromaticity of the face, and of other parts
_DARK = 0.03  # of sRGB, below which edges are noise
_MARGIN = 1.16  # by which a ratio of channels must lie outside those of the face
_LEAST, _TOUCHES = 0.005, 0.25  # share of the person, and of the outline that borders certain skin


def with_cloth(classes: Tensor, image: Tensor, head: HeadPlace) -> Tensor:
    """Return shares [C, h, w] of the classes in which parts of skin that cannot be skin are garments.

    A part ends at edges of the photo. It is cloth if most of its chromaticities lie outside those of all of
    the face, lit and shaded, it is large enough, and little of its outline borders certain skin.

    Args:
        classes: Shares of the classes, which sum to 1.
        image: sRGB [3, h, w] in 0..1.
        head: The person's head, in pixels of the image.
    """
    shares = classes.numpy()
    red, green, blue = srgb_to_linear(image.numpy())
    face = (shares[_SKIN[0]] > _SURE) & (head.distance(green.shape) < _FACE_REACH)
    if not face.any():
        return classes
    outside = np.zeros_like(face)
    for channel in (red, blue):
        ratio = (channel[face] + _BLACK) / (green[face] + _BLACK)
        darkest, brightest = (
            (green * bound + _NOISE) / (green + _NOISE) for bound in np.quantile(ratio, (0.02, 0.98))
        )
        ratio = (channel + _NOISE) / (green + _NOISE)
        outside |= (ratio < darkest / _MARGIN) | (ratio > brightest * _MARGIN)
    person = 1 - shares[0]
    skin = shares[_SKIN].sum(0) > _MAYBE * np.maximum(person, _MAYBE)
    edges = gaussian_gradient_magnitude(np.log(image.numpy().mean(0) + _DARK), 1.0) > _EDGE
    certain = (shares[_FACE].sum(0) > _SURE_BESIDE) | (shares[_HAND] > _SURE_BESIDE)
    parts, _ = label(skin & ~edges)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    cloth = np.zeros_like(skin)
    for number in np.flatnonzero(sizes > _LEAST * person.sum()):
        part = parts == number
        if outside[part].mean() > 0.5:
            part |= binary_dilation(part, iterations=_EDGE_PX, mask=skin & outside)
            outline = binary_dilation(part) & ~part
            if certain[outline].mean() < _TOUCHES:
                cloth |= part
    given = classes.clone()
    moved = classes[_SKIN] * torch.from_numpy(cloth)
    given[_SKIN] -= moved
    given[_GARMENT] += moved.sum(0)
    return given
