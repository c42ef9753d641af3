"""The matte of a person before a plain background, such as a studio's: solved from colours alone.

Where the colours of person F and background B nearby are known and differ by more than they vary, a pixel
I = a F + (1 - a) B has one answer, a = (B - I) . (B - F) / |B - F|^2. The background must be plain far
around: what stands in it beside the person, as a tree does, could be the person's as well.
"""

import numpy as np

from facerf_cli.image.strips import enlarged, fitted
from facerf_cli.portrait.matte import shrunk, weighted_mean

_SMALL_PX = 256  # longest side at which colours are measured
_NEAR, _FAR = 0.1, 0.2  # sides of the squares of their means, in longest sides
_ALLOWED = 0.1  # deviation of alpha that the colours' variance would give, at which half is believed
_SURE = (0.02, 0.95)  # alpha up to which a pixel is background, and from which it is person
_SEEN = 0.02  # share of a square that must be sure


def solved_before_plain_background(alpha: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Solve a matte [H, W] of a scene-linear image [H, W, 3] again, where it is unsure before a plain one."""
    size = fitted(alpha.shape[0], alpha.shape[1], _SMALL_PX)
    matte, image = shrunk(alpha, size), shrunk(linear, size)
    near, far = (2 * round(share * max(size) / 2) + 1 for share in (_NEAR, _FAR))
    is_person, is_background = (matte > _SURE[1]).astype(np.float32), (matte < _SURE[0]).astype(np.float32)
    person, person_varies, person_seen = _colours(image, is_person, near)
    background, background_varies, background_seen = _colours(image, is_background, near)
    _, varies_far, _ = _colours(image, is_background, far)
    contrast = np.square(background - person).sum(-1)
    variance = (person_varies + np.maximum(background_varies, varies_far)) / contrast.clip(min=1e-9)
    trust = np.exp2(-variance / _ALLOWED**2) * ((person_seen > _SEEN) & (background_seen > _SEEN))
    maps = np.concatenate([person, background, contrast[..., None], trust[..., None]], -1)
    own, other, apart, trust = np.split(enlarged(maps.transpose(2, 0, 1), alpha.shape), [3, 6, 7])
    along = ((other - linear.transpose(2, 0, 1)) * (other - own)).sum(0)
    solved = (along / apart[0].clip(min=1e-9)).clip(0, 1)
    unsure = (alpha > 0) & (alpha < 1)
    return np.asarray(alpha + unsure * trust[0] * (solved - alpha), np.float32)


def _colours(image: np.ndarray, sure: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means [h, w, 3] and variances [h, w] of an image's sure pixels over squares, and the share of those."""
    mean = weighted_mean(image, sure, size)
    squares = weighted_mean(np.square(image), sure, size)
    seen = weighted_mean(sure[..., None], np.ones_like(sure), size)[..., 0]
    return mean, (squares - mean**2).clip(min=0).sum(-1), seen
