"""The photo's detail in every part of a relit image: pores, stubble, weave, edges of collars.

A field's gain carries the photo's detail, but its bias, the light that comes round corners and highlights are
maps of few pixels. So what of a relit image R is finer than these maps becomes the photo's own detail D:

    R' = w D G(R) + (1 - w) R,    log D = log A / G(A) + f (log B / G(B) - log A / G(A))

G is a blur inside the person. A is the photo without its light by the guided gain, which knows the edges of
the photo's shadows and takes some of its grain for them; B by the coarse gain, which knows neither. f is 1
where the detail of B is faint, as grain is, and 0 where it is strong, as edges are. w is 0 in hair, whose
strands show the photo's own light, and where the photo is nearly black. R' is linear in R: layers add up.
"""

import numpy as np
from scipy.ndimage import uniform_filter

from facerf_cli.image.strips import Band, whole

_BLUR = 0.5  # reach of G, in pixels of the maps
_DARK = (0.02, 0.08)  # A at which w is 0, and 1, in units of the person's mean
_FAINT = 0.1  # strength of detail, root mean square of its logarithm, at which f is 1 / e
_LARGEST = 8.0  # of A / G(A)
_TINY = 1e-6


class Grain:
    """Gives an image the detail of luminances A and B, `flat` [H, W, 2], where `share` [H, W] is not 0.

    `share` is that of w; `map_px` is the side of the maps' pixels in those of the photo.
    """

    def __init__(self, flat: Band, share: np.ndarray, map_px: float) -> None:
        self._inside = (share > 0).astype(np.float32)
        self._reach = max(1, round(_BLUR * map_px))
        values = whole(flat, *share.shape)
        low = self._blurred(values, slice(None))
        mean = float((values[..., 0] * self._inside).sum() / max(float(self._inside.sum()), 1.0))
        seen = (low[..., 0] / max(mean, _TINY) - _DARK[0]) / (_DARK[1] - _DARK[0])
        logs = np.log((values / low.clip(min=_TINY)).clip(1 / _LARGEST, _LARGEST))
        guided, coarse = logs[..., 0], logs[..., 1]
        faint = np.exp(-self._blurred(coarse[..., None] ** 2, slice(None))[..., 0] / _FAINT**2)
        self._weight = (share * seen.clip(0, 1)).astype(np.float16)
        self._detail = np.exp(guided + faint * (coarse - guided)).astype(np.float16)

    def given(self, relit: Band) -> Band:
        """A relit image [H, W, 3], by rows, with the detail."""
        margin = 2 * self._reach

        def of(rows: slice) -> np.ndarray:
            start, stop, _ = rows.indices(len(self._inside))
            wide = slice(max(0, start - margin), min(len(self._inside), stop + margin))
            own = slice(start - wide.start, stop - wide.start)
            pixels = relit(wide)
            low, pixels = self._blurred(pixels, wide)[own], pixels[own]
            return np.asarray(
                pixels + self._weight[rows, :, None] * (self._detail[rows, :, None] * low - pixels)
            )

        return of

    def _blurred(self, values: np.ndarray, rows: slice) -> np.ndarray:
        """Some rows of an image [h, W, C], blurred inside the person, by two boxes."""
        inside = self._inside[rows][..., None]
        size = (2 * self._reach + 1, 2 * self._reach + 1, 1)

        def blurred(image: np.ndarray) -> np.ndarray:
            return np.asarray(
                uniform_filter(uniform_filter(image, size, mode="nearest"), size, mode="nearest")
            )

        return blurred(values * inside) / blurred(inside).clip(min=_TINY)
