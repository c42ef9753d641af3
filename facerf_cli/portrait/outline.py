"""The outline of a person where the network is unsure of it, by the colours that are sure on its two sides.

A tree's trunk next to a cheek, or the sky between hair and ear, may look like a part of the person to the
network. Their colours are like those of the background around, which tips the balance.
"""

import numpy as np
import torch
from scipy.spatial import cKDTree
from skimage.color import rgb2lab
from torch import Tensor

from facerf_cli.portrait.regions import depth_px, joined_to

# Shares of the person from which on, well inside it, a pixel is sure, and up to which it is background.
_SURE, _BACKGROUND = 0.9, 0.1
_INSIDE = 0.1  # how far inside the person, in extents of the landmarks
_NEAREST, _APART = 4, 4  # sure pixels that a pixel is compared with, of every fourth one
_EXTENT = 0.1  # difference of colour, in Lab / 100, as large as one of places by an extent of the landmarks
_SPREAD = 0.06  # of the colours of one thing, in Lab / 100
_MOST, _LEAST_SHARE = 3.0, 0.02  # largest logit of the colours; least share of either side in the network's


def with_outline(classes: Tensor, image: Tensor, extent_px: float) -> Tensor:
    """Classes [C, h, w] whose matte follows the colours of an sRGB image [3, h, w] in 0..1 near the outline.

    `extent_px` is the extent of the landmarks in its pixels. The network's logit of the person is added to
    that of the colours, whose distances to sure colours of both sides are taken as normally distributed.
    Colours add no islands.
    """
    person = 1 - classes[0].numpy()
    sure, background = depth_px(person > _SURE) > _INSIDE * extent_px, person < _BACKGROUND
    unsure = ~(sure | background)
    y, x = np.mgrid[: person.shape[0], : person.shape[1]]
    compared = (x + y) % _APART == 0
    if not unsure.any() or min(np.sum(sure & compared), np.sum(background & compared)) < _NEAREST:
        return classes
    places = np.stack([x, y], -1) * (_EXTENT / extent_px)
    seen = np.concatenate([rgb2lab(image.permute(1, 2, 0).numpy()) / 100, places], -1)

    def squared_distance(known: np.ndarray) -> np.ndarray:
        nearest = cKDTree(seen[known & compared]).query(seen[unsure], range(1, _NEAREST + 1), workers=-1)[0]
        return np.square(nearest).mean(1)

    colours = (squared_distance(background) - squared_distance(sure)) / (2 * _SPREAD**2)
    share = torch.from_numpy(person)
    logit = share.clamp(_LEAST_SHARE, 1 - _LEAST_SHARE).logit()
    logit[unsure] += torch.from_numpy(colours.clip(-_MOST, _MOST)).float()
    changed = torch.where(torch.from_numpy(unsure), logit.sigmoid(), share)
    found = changed.numpy() > 0.5
    islands = torch.from_numpy(found & ~joined_to(found, sure))
    changed = torch.where(islands, torch.minimum(changed, share), changed)
    return torch.cat([1 - changed[None], classes[1:] * (changed / share.clamp_min(1e-6))])
