"""The matte of a person at the photo's own resolution, and the person's colours without the background's."""

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import uniform_filter
from torch import Tensor

_REACH = 0.03  # of the guided filter, in longest sides of the guide
_SMOOTHNESS = 2e-4  # variance of the guide's colours, sRGB in 0..1, below which the matte is smoothed
_STRETCH = 0.2  # the filter leaves this much of a soft matte on both sides of an edge; it is cut off
_COLOURS_PX = 1024  # longest side at which they are found
_COLOUR_REACH = (0.03, 0.006)  # of the means of colours, one after the other, in longest sides
_TINY = 1e-5


def refine_matte(matte: np.ndarray, guide_srgb: np.ndarray, photo_srgb: np.ndarray) -> np.ndarray:
    """Refine a matte [h, w] by the edges of a photo [H, W, 3] uint8; return it [H, W] in 0..1.

    The guide [h, w, 3] in 0..1 is the photo at the matte's size. A guided filter (He et al., *Guided image
    filtering*, 2013) in its fast form (He and Sun, 2015): a local linear function of the colour, found at the
    small size and applied at the large one.
    """
    reach = max(1, round(_REACH * max(matte.shape)))
    slope, offset = local_lines(matte, guide_srgb, reach, _SMOOTHNESS)
    size = photo_srgb.shape[:2]
    lines = enlarged(np.concatenate([slope.transpose(2, 0, 1), offset[None]]), size)
    refined = lines[3]
    for channel in range(3):
        refined += lines[channel] * photo_srgb[..., channel] / np.float32(255)
    refined = ((refined - _STRETCH) / (1 - 2 * _STRETCH)).clip(0, 1)
    return np.asarray(refined)


def local_lines(
    values: np.ndarray, guide: np.ndarray, reach: int, smoothness: float
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes [h, w, 3] and offsets [h, w] of values [h, w] as a linear function of colour around each pixel.

    `reach` is in pixels; where the variance of the colours is below `smoothness`, values are smoothed.
    """

    def mean(field: np.ndarray) -> np.ndarray:
        return np.asarray(
            uniform_filter(field, (2 * reach + 1,) * 2 + (1,) * (field.ndim - 2), mode="nearest")
        )

    colour, share = mean(guide), mean(values)
    products = guide[..., :, None] * guide[..., None, :]
    covariance = mean(products.reshape(*values.shape, 9)).reshape(products.shape)
    covariance = (
        covariance - colour[..., :, None] * colour[..., None, :] + smoothness * np.eye(3, dtype=np.float32)
    )
    common = mean(guide * values[..., None]) - colour * share[..., None]
    slope = np.linalg.solve(covariance, common[..., None])[..., 0]
    offset = share - (slope * colour).sum(-1)
    return mean(slope), mean(offset)


def person_colours(photo: np.ndarray, matte: np.ndarray) -> np.ndarray:
    """The person's own colours [H, W, 3] where a matte [H, W] mixes them with the background's.

    Means of sure colours nearby, corrected by the mixture that the photo shows (Forte, *Approximate fast
    foreground colour estimation*, 2021). The means are those of a photo of at most `_COLOURS_PX`.
    """
    height, width = matte.shape
    scale = min(1.0, _COLOURS_PX / max(matte.shape))
    size = max(1, round(height * scale)), max(1, round(width * scale))
    both = torch.from_numpy(np.dstack([photo, matte]).astype(np.float32)).permute(2, 0, 1)[None]
    small = F.interpolate(both, size, mode="area")[0].permute(1, 2, 0).numpy()
    seen, share = small[..., :3], small[..., 3]
    person = background = seen
    for reach in _COLOUR_REACH:
        span = max(3, 2 * round(reach * max(size)) + 1)
        own = _weighted_mean(person, share, span)
        background = _weighted_mean(background, 1 - share, span)
        person = _unmixed(seen, share, own, background)
    if scale < 1:
        own, background = (
            enlarged(x.transpose(2, 0, 1), matte.shape).transpose(1, 2, 0) for x in (own, background)
        )
        person = _unmixed(photo, matte, own, background)
    return np.where(matte[..., None] > 0, person, 0).astype(np.float32)


def _unmixed(seen: np.ndarray, matte: np.ndarray, own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Own colours of mixtures [h, w, 3], from likely ones of the person and of the background."""
    share = matte[..., None]
    rest = seen - share * own - (1 - share) * other
    return np.asarray((own + share * rest).clip(min=0))


def _weighted_mean(colours: np.ndarray, weight: np.ndarray, size: int) -> np.ndarray:
    """Means [H, W, 3] over squares of `size` pixels, under weights [H, W]."""
    total = uniform_filter(colours * weight[..., None], (size, size, 1), mode="nearest")
    return np.asarray(total / (uniform_filter(weight, size, mode="nearest")[..., None] + _TINY))


def enlarged(maps: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Maps [C, h, w] at another size [C, H, W]."""
    tensor: Tensor = torch.from_numpy(np.ascontiguousarray(maps, np.float32))[None]
    wide = F.interpolate(tensor, size=tuple(size), mode="bilinear", align_corners=False)
    return np.asarray(wide[0].numpy())
