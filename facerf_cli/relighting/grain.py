"""The photo's detail in every part of a relit image: pores, stubble, weave, edges of collars.

A field's gain carries the photo's detail, but its bias, the light that comes round corners and highlights are
maps of few pixels. So what of a relit image R is finer than these maps becomes the photo's own detail D:

    R' = w D G(R) + (1 - w) R,    log D = log A / G(A) + f (log B / G(B) - log A / G(A))

G is a blur inside the person. A is the photo without its light by the guided gain, which knows the edges of
the photo's shadows and takes some of its grain for them; B by the coarse gain, which knows neither. f is 1
where the detail of B is faint, as grain is, and 0 where it is strong, as edges are. w is 0 in hair, whose
strands show the photo's own light, where the photo is nearly black, and at strong edges, where R is sharp
(`edges.py`) and G, which mixes both sides, would draw lines. R' is linear in R: layers add up.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.image.strips import STRIP_PX, box_means, strips

_BLUR = 0.5  # reach of G, in pixels of the maps
_DARK = (0.02, 0.08)  # A at which w is 0, and 1, in units of the person's mean
_FAINT = 0.1  # strength of detail, root mean square of its logarithm, at which f is 1 / e
_STRONG = 0.4  # strength of detail at which w is 1 / e where R is sharpened
_LARGEST = 8.0  # of A / G(A)
_TINY, _MOST = 1e-6, 6e4  # of A in units of its mean
_STRIP_PX = 4 * STRIP_PX  # of the photo, whose detail is read at a time


@dataclass(frozen=True, eq=False)
class GrainRows:
    """Rows and columns of the photo, rows around that reach into them, and where they are among these.

    `inside` [h, w] is the person there, and `reached` [h, w, 1] the share of the blur that is inside.
    """

    rows: slice
    columns: slice
    wide: slice
    own: slice
    inside: np.ndarray
    reached: np.ndarray


class Grain:
    """Gives an image the detail of luminances A and B, where `share` [H, W] is not 0.

    Args:
        flat: Gives A and B [h, W, 2] of some rows.
        share: That of w.
        map_px: Side of the maps' pixels in those of the photo.
        sharpened: Gives the share [h, W, 1] of R that is sharp at edges.
    """

    def __init__(
        self,
        flat: Callable[[slice], np.ndarray],
        share: np.ndarray,
        map_px: float,
        sharpened: Callable[[slice], np.ndarray],
    ) -> None:
        self._inside = share > 0
        self._reach = max(1, round(_BLUR * map_px))
        self.margin = 2 * self._reach  # pixels that reach into one
        values = np.zeros((*share.shape, 2), np.float16)  # 0 where nobody is seen, as detail is
        unit, total, count = 0.0, 0.0, 0
        for rows in self._seen_strips(STRIP_PX):
            light = flat(rows)
            inside = light[self._inside[rows], 0]
            total, count = total + float(inside.sum()), count + len(inside)
            if (
                not unit and total > 0
            ):  # near enough to the mean for half floats, which it rounds no other way
                unit = 2.0 ** round(math.log2(total / count))
            values[rows] = (light / (unit or 1)).clip(max=_MOST)
        scale = np.float32((unit or 1) * max(count, 1) / max(total, _TINY))
        self._weight, self._detail = (np.zeros(share.shape, np.float16) for _ in range(2))
        for rows in self._seen_strips(_STRIP_PX):
            wide, own = self._around(rows, 2 * self.margin)
            at = wide, seen_columns(self._inside[wide], self.margin)
            sharp = sharpened(wide)[:, at[1], 0]
            weight, detail = self._read(values[at] * scale, share[at], sharp, self._inside[at])
            self._weight[rows, at[1]], self._detail[rows, at[1]] = weight[own], detail[own]

    def _seen_strips(self, strip_px: int) -> Iterator[slice]:
        """The strips in which some of the person is seen: of a crowd's people few."""
        return (rows for rows in strips(self._inside.shape, strip_px) if self._inside[rows].any())

    def _read(
        self, values: np.ndarray, share: np.ndarray, sharp: np.ndarray, inside: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Weight w and detail D [h, W] of some rows of A and B [h, W, 2], in units of the mean of A."""
        reached = self._reached(inside)
        low = self._blurred(values, inside, reached)
        seen = (low[..., 0] - _DARK[0]) / (_DARK[1] - _DARK[0])
        logs = np.log((values / low.clip(min=_TINY)).clip(1 / _LARGEST, _LARGEST))
        guided, coarse = logs[..., 0], logs[..., 1]
        power = self._blurred(coarse[..., None] ** 2, inside, reached)[..., 0]
        faint, calm = (np.exp(-power / strength**2) for strength in (_FAINT, _STRONG))
        weight = share * seen.clip(0, 1) * (1 - sharp * (1 - calm))
        return weight, np.exp(guided + faint * (coarse - guided))

    def _around(self, rows: slice, margin: int) -> tuple[slice, slice]:
        """Rows with those around them, and where they are among these."""
        start, stop, _ = rows.indices(len(self._inside))
        wide = slice(max(0, start - margin), min(len(self._inside), stop + margin))
        return wide, slice(start - wide.start, stop - wide.start)

    def observe(self, rows: slice, columns: slice = slice(None)) -> GrainRows:
        """Read the person in rows of the photo, and in those around them; beyond the columns is nothing."""
        wide, own = self._around(rows, self.margin)
        inside = self._inside[wide, columns]
        return GrainRows(rows, columns, wide, own, inside, self._reached(inside))

    def given(self, relit: np.ndarray, seen: GrainRows) -> np.ndarray:
        """Observed pixels [h, w, 3] of a relit image with the detail; `relit` are those of `seen.wide`."""
        low, pixels = self._blurred(relit, seen.inside, seen.reached)[seen.own], relit[seen.own]
        weight, detail = (values[seen.rows, seen.columns, None] for values in (self._weight, self._detail))
        return np.asarray(pixels + weight * (detail * low - pixels))

    def given_to(self, relit: Tensor, seen: GrainRows) -> Tensor:
        """`given` of a tensor, with gradients."""
        inside, reached = map(torch.from_numpy, (seen.inside, seen.reached))
        planes, span = (relit * inside[..., None]).permute(2, 0, 1), 2 * self._reach + 1
        for _ in range(2):
            planes = F.avg_pool2d(F.pad(planes, [self._reach] * 4, mode="replicate"), span, 1)
        low, pixels = (planes.permute(1, 2, 0) / reached)[seen.own], relit[seen.own]
        halves = (values[seen.rows, seen.columns, None] for values in (self._weight, self._detail))
        weight, detail = (torch.from_numpy(values).float() for values in halves)
        return (1 - weight) * pixels + weight * detail * low

    def _blurred(self, values: np.ndarray, inside: np.ndarray, reached: np.ndarray) -> np.ndarray:
        """Some rows of an image [h, W, C], blurred inside the person, by two boxes."""
        return self._means(values * inside[..., None]) / reached

    def _reached(self, inside: np.ndarray) -> np.ndarray:
        """Share [h, W, 1] of the blur that is inside."""
        return self._means(inside[..., None].astype(np.float32)).clip(min=_TINY)

    def _means(self, values: np.ndarray) -> np.ndarray:
        return box_means(box_means(values, self._reach), self._reach)


def seen_columns(shown: np.ndarray, margin: int) -> slice:
    """Columns in which a part of an image [h, W] is not 0, with a margin around; at least one."""
    at = np.flatnonzero(shown.any(0))
    first, last = (int(at[0]), int(at[-1])) if len(at) else (0, 0)
    return slice(max(0, first - margin), min(shown.shape[1], last + 1 + margin))
