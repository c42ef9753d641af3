"""The matte of a person, solved at its outline, at the photo's resolution; and the person's own colours."""

import math
from functools import partial

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, maximum_filter, uniform_filter
from scipy.sparse import csr_array, dia_array

from facerf_cli.image.strips import between, box_means, enlarged, fitted, strips

_REACH_PX = 2  # of the linear functions of colour by which a matte is enlarged
_SMOOTHNESS = 1e-5  # variance of colours, sRGB in 0..1, below which the matte is smoothed
_COLOURS_PX = 512  # longest side at which they are found
_COLOUR_REACH = (0.03, 0.006)  # of the means of colours, one after the other, in longest sides
_SURE = (0.05, 0.93)  # alpha up to which a person is absent, and from which on it hides all
_OUTLINE_PX = 768  # longest side at which distances from the outline are measured
_SOLID_PX = (1.0, 3.0)  # distances from it over which a person comes to hide all, and to be absent
_LOOSE_PX = 7  # side of the square around a pixel of the classes in which hair leaves its matte as it is
_LEFT = 0.7  # of the background nearby, that a mixture holds at least
_SAME_COLOUR = 1e-5  # variance of the colours of a window, sRGB in 0..1, below which its alpha is constant
_PULL = 3e-3  # toward the expected alpha
_TOLERANCE, _MOST_STEPS = 1e-3, 200
_WINDOW = 9  # pixels
_SMALL_PX = 256  # longest side at which colours before a plain background are measured
_NEAR, _FAR = 0.1, 0.2  # sides of the squares of their means, in longest sides
_ALLOWED = 0.1  # deviation of alpha that the colours' variance would give, at which half is believed
_PLAIN_SURE = (0.02, 0.95)  # alpha up to which a pixel is background, and from which it is person
_SEEN = 0.02  # share of a square that must be sure
_TINY = 1e-5


def lifted(alpha: np.ndarray, image: np.ndarray, photo_srgb: np.ndarray) -> np.ndarray:
    """A matte [h, w] at the size of a photo [H, W, 3] uint8; `image` [h, w, 3] is the photo, small, in 0..1.

    A guided filter (He et al., *Guided image filtering*, 2013) in its fast form (He and Sun, 2015): linear
    functions of the colour around each pixel, found at the small size and applied at the large one.
    """
    maps = np.concatenate(local_lines(alpha[..., None], image, _REACH_PX, _SMOOTHNESS))
    size = photo_srgb.shape[:2]
    lifted = np.empty(size, np.float32)
    for rows in strips(size):
        lines = enlarged(maps, size, rows)
        colours = photo_srgb[rows].transpose(2, 0, 1) / np.float32(255)
        lifted[rows] = ((lines[:3] * colours).sum(0) + lines[3]).clip(0, 1)
    return lifted


def local_lines(
    values: np.ndarray, guide: np.ndarray, reach: int, smoothness: float
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes [3 K, h, w] and offsets [K, h, w] of values [h, w, K] as linear functions of colours nearby.

    `reach` is in pixels; where the variance of the colours is below `smoothness`, values are smoothed.
    """
    mean = partial(box_means, reach=reach)
    colour, share = mean(guide), mean(values)
    covariance, common = (
        mean(guide[..., :, None] * other[..., None, :]) - colour[..., :, None] * of_other[..., None, :]
        for other, of_other in ((guide, colour), (values, share))
    )
    slope = np.linalg.solve(covariance + smoothness * np.eye(3, dtype=np.float32), common)  # [h, w, 3, K]
    offset = share - (slope * colour[..., None]).sum(-2)
    return mean(slope).transpose(3, 2, 0, 1).reshape(-1, *share.shape[:2]), mean(offset).transpose(2, 0, 1)


def solid(matte: np.ndarray, loose: np.ndarray) -> np.ndarray:
    """A matte [H, W] that is 1 inside its outline and 0 outside, but for a share [h, w] of loose hair.

    Skin and cloth hide what is behind them, and end at their outline. But a jaw that shines in the light of
    the background has a colour between both, and of a dark background a matte holds a haze. In hair, too,
    what is nearly sure is sure: a hundredth of a bright wall shows as speckles on a dark suit.
    """
    size, (first, last) = fitted(matte.shape[0], matte.shape[1], _OUTLINE_PX), _SOLID_PX
    inside = shrunk(matte, size) > 0.5
    tight = 1 - enlarged(maximum_filter(loose, _LOOSE_PX)[None], size)[0]
    deep = [
        ((distance_transform_edt(part) - first) / (last - first)).clip(0, 1) for part in (inside, ~inside)
    ]
    found = np.empty_like(matte)
    for rows in strips(matte.shape):
        filled, cleared = enlarged(np.stack(deep) * tight, matte.shape, rows)
        sure = ((matte[rows] - _SURE[0]) / (_SURE[1] - _SURE[0])).clip(0, 1)
        found[rows] = (sure + filled * (1 - sure)) * (1 - cleared)
    return found


class PersonColours:
    """The person's own colours [H, W, 3] where a matte [H, W] mixes them with the background's, by rows.

    Means of sure colours nearby, corrected by the mixture that the photo shows (Forte, *Approximate fast
    foreground colour estimation*, 2021). The means are those of a photo of at most `_COLOURS_PX`. A colour is
    no brighter than the mixture allows that holds most of the background nearby, too: where the matte is a
    mere haze, relighting takes no more than that from a dark background.
    """

    def __init__(self, photo: np.ndarray, matte: np.ndarray) -> None:
        self.shape = photo.shape
        self._photo, self._matte = photo, matte
        size = fitted(matte.shape[0], matte.shape[1], _COLOURS_PX)
        mixture, share = shrunk(photo, size), shrunk(matte, size)
        person = own = background = mixture
        for reach in _COLOUR_REACH:
            span = max(3, 2 * round(reach * max(size)) + 1)
            own = weighted_mean(person, share, span)
            background = weighted_mean(background, 1 - share, span)
            person = _unmixed(mixture, share, own, background)
        self._means = np.concatenate([own, background], -1)
        self.small = person * (share > 0)[..., None]  # [h, w, 3], of at most `_COLOURS_PX`

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        """Some rows [h, W, 3]."""
        photo, matte = self._photo[rows], self._matte[rows]
        found = photo * (matte > 0)[..., None]
        mixed = np.nonzero((matte > 0) & (matte < 1))
        if len(mixed[0]):
            y = mixed[0] + rows.indices(self.shape[0])[0]
            own, background = np.split(_looked_up(self._means, y, mixed[1], self.shape), 2, -1)
            mixture, share = photo[mixed], matte[mixed]
            own = _unmixed(mixture, share, own, background)
            left = _LEFT * (1 - share[:, None]) * np.minimum(background, mixture)
            found[mixed] = np.minimum(own, (mixture - left) / share[:, None])
        return found


def _looked_up(maps: np.ndarray, y: np.ndarray, x: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Values [N, C] of maps [h, w, C], enlarged to `size` as by `enlarged`, at rows y and columns x."""
    (top, bottom, down), (left, right, along) = (
        between(at, small, large) for at, small, large in zip((y, x), maps.shape, size, strict=False)
    )
    along = along[:, None]
    above = maps[top, left] + along * (maps[top, right] - maps[top, left])
    below = maps[bottom, left] + along * (maps[bottom, right] - maps[bottom, left])
    return np.asarray(above + down[:, None] * (below - above))


def shrunk(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Means of the pixels of an image [H, W] or [H, W, C] at another size, float32."""
    across, down = (_averages(*pair) for pair in zip(image.shape, size, strict=False))
    flat = np.zeros((size[0], math.prod(image.shape[1:])), np.float32)
    for rows in strips(image.shape):
        part = np.ascontiguousarray(image[rows], np.float32)
        into = slice(rows.start * size[0] // len(image), -(-rows.stop * size[0] // len(image)))
        flat[into] += across[into, rows] @ part.reshape(len(part), -1)
    sides = np.moveaxis(flat.reshape(size[0], *image.shape[1:]), 1, 0)
    found = down @ np.ascontiguousarray(sides).reshape(image.shape[1], -1)
    return np.ascontiguousarray(np.moveaxis(found.reshape(size[1], size[0], *image.shape[2:]), 0, 1))


def _averages(large: int, small: int) -> csr_array:
    """Weights [small, large] of the mean over the pixels that each smaller one touches."""
    starts = np.arange(small) * large // small
    ends = -(-(np.arange(1, small + 1) * large) // small)
    counts = ends - starts
    columns = np.concatenate([np.arange(*pair) for pair in zip(starts, ends, strict=True)])
    weights = np.repeat(1 / counts, counts).astype(np.float32)
    return csr_array((weights, columns, np.concatenate([[0], counts.cumsum()])), shape=(small, large))


def _unmixed(mixture: np.ndarray, matte: np.ndarray, own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Own colours of mixtures [h, w, 3], from likely ones of the person and of the background."""
    share = matte[..., None]
    rest = mixture - share * own - (1 - share) * other
    return np.asarray((own + share * rest).clip(min=0))


def weighted_mean(colours: np.ndarray, weight: np.ndarray, size: int) -> np.ndarray:
    """Means [H, W, 3] over squares of `size` pixels, under weights [H, W]."""
    total = uniform_filter(colours * weight[..., None], (size, size, 1), mode="nearest")
    return np.asarray(total / (uniform_filter(weight, size, mode="nearest")[..., None] + _TINY))


def solve_matte(image_srgb: np.ndarray, expected: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """Find alpha [H, W] in 0..1 where it is unknown [H, W]; elsewhere it is as expected [H, W].

    Closed-form matting (Levin et al., *A closed-form solution to natural image matting*, 2008).

    Around each pixel alpha is a linear function of the colour of the image [H, W, 3] in 0..1. Only windows of
    3 x 3 pixels that touch unknown ones are looked at, so the cost goes with their number.
    """
    alpha = np.array(expected, np.float64)
    if not unknown.any() or min(unknown.shape) < 3:
        return alpha.astype(np.float32)
    pixels = _windows(unknown)
    affinity = _affinities(image_srgb.reshape(-1, 3)[pixels])
    count = int(unknown.sum())
    number = np.full(unknown.size, -1)
    number[unknown.ravel()] = np.arange(count)
    rows, columns = (
        np.broadcast_to(number[pixels][sides], affinity.shape)
        for sides in (np.s_[:, :, None], np.s_[:, None])
    )
    inner, border = (rows >= 0) & (columns >= 0), (rows >= 0) & (columns < 0)
    laplacian = csr_array((affinity[inner], (rows[inner], columns[inner])), (count, count))
    known = np.broadcast_to(alpha.ravel()[pixels][:, None], affinity.shape)
    right = -np.bincount(rows[border], affinity[border] * known[border], count)
    start = alpha[unknown]
    system = laplacian + dia_array((np.full((1, count), _PULL), [0]), (count, count))
    alpha[unknown] = _conjugate_gradients(system, right + _PULL * start, start).clip(0, 1)
    return alpha.astype(np.float32)


def _conjugate_gradients(system: csr_array, right: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Solve a symmetric positive definite system [N, N], preconditioned by its diagonal."""
    found, rest = start.copy(), right - system @ start
    inverse, along, before = 1 / system.diagonal(), np.zeros_like(right), np.inf
    for _ in range(_MOST_STEPS):
        if np.linalg.norm(rest) <= _TOLERANCE * np.linalg.norm(right):  # of nothing, too
            break
        scaled = inverse * rest
        now = rest @ scaled
        along = scaled + now / before * along
        moved = system @ along
        step = now / (along @ moved)
        found += step * along
        rest -= step * moved
        before = now
    return found


def _windows(unknown: np.ndarray) -> np.ndarray:
    """Numbers [N, 9] of the pixels of each window that touches an unknown pixel."""
    middle = binary_dilation(unknown, np.ones((3, 3)))
    middle[[0, -1], :] = middle[:, [0, -1]] = False
    offsets = np.arange(-1, 2)[:, None] * unknown.shape[1] + np.arange(-1, 2)
    return np.flatnonzero(middle)[:, None] + offsets.ravel()


def _affinities(colours: np.ndarray) -> np.ndarray:
    """The matting Laplacian's entries [N, 9, 9] of windows with colours [N, 9, 3] (equation 12)."""
    centred = colours.astype(np.float64) - colours.mean(1, keepdims=True)
    covariance = centred.transpose(0, 2, 1) @ centred / _WINDOW + _SAME_COLOUR / _WINDOW * np.eye(3)
    alike = centred @ np.linalg.inv(covariance) @ centred.transpose(0, 2, 1)
    return np.asarray(np.eye(_WINDOW) - (1 + alike) / _WINDOW)


def solved_before_plain_background(alpha: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Solve a matte [H, W] of a scene-linear image [H, W, 3] again, where it is unsure before a plain one.

    Where the colours of person F and background B nearby are known and differ by more than they vary, a pixel
    I = a F + (1 - a) B has one answer, a = (B - I) . (B - F) / |B - F|^2. The background must be plain far
    around: what stands in it beside the person, as a tree does, could be the person's as well.
    """
    size = fitted(alpha.shape[0], alpha.shape[1], _SMALL_PX)
    matte, image = shrunk(alpha, size), shrunk(linear, size)
    near, far = (2 * round(share * max(size) / 2) + 1 for share in (_NEAR, _FAR))
    is_person = (matte > _PLAIN_SURE[1]).astype(np.float32)
    is_background = (matte < _PLAIN_SURE[0]).astype(np.float32)
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
