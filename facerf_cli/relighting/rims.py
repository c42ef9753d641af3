"""Rims: the light from behind a person, drawn as thin as the photo's outline allows.

Such a light is seen where surfaces turn away, in a line along the outline that is thinner than the pixels of
the maps. At a distance d inside the outline it is read from a distance g(d) in the maps, and g'(d) times as
bright: along the outline's normal its integral stays what it was. g(0) = 0, g'(0) is the sharpness, and from
the reach on g(d) = d. Deeper inside, the brightness fades to 0: the network also draws such a light on cheek
and nose, where hair or the head itself blocks it.
"""

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor

from facerf_cli.image.strips import Window, enlarged, fitted
from facerf_cli.portrait.matte import shrunk
from facerf_cli.raster.texture import smoothstep

_FROM, _WHOLE = 0.35, 0.75  # -z of the directions from which on light is partly, and wholly, from behind
_SHARPNESS, _REACH = 2.0, 0.2  # g'(0), at most 4, and the reach, in extents of the face
_SMOOTH = 0.006  # standard deviation of the blur of the outline's distance, in extents of the face
_OUTSIDE = 0.015  # of the outline, in extents of the face, over which brightness fades to what it was
_FADES = (0.04, 0.16)  # distances inside the outline from which on light fades, and is none, in extents
_SIDE_PX = 640  # longest side of the photo in which distances are measured


def from_behind(directions: Tensor) -> Tensor:
    """Share [...] of lights from unit directions [..., 3] that comes from behind."""
    return smoothstep((-directions[..., 2] - _FROM) / (_WHOLE - _FROM))


class Rims:
    """Places from which a person's light from behind is read, and its brightness, by a matte [H, W].

    `face_px` is the extent of the face in the photo. The frame's border is no outline.
    """

    def __init__(self, matte: np.ndarray, face_px: float) -> None:
        self._size_px = matte.shape
        height, width = fitted(matte.shape[0], matte.shape[1], _SIDE_PX)
        inside = shrunk(matte, (height, width)) > 0.5
        self._maps = np.zeros((3, height, width), np.float32)
        self._maps[2] = 1
        if inside.all() or not inside.any():
            return
        face = face_px * height / matte.shape[0]  # in pixels of the maps
        from_outline = distance_transform_edt(inside) - 0.5, distance_transform_edt(~inside) - 0.5
        distance = np.where(inside, from_outline[0], -from_outline[1])
        distance = gaussian_filter(distance / face, _SMOOTH * face).astype(np.float32)
        inward = np.stack(np.gradient(distance)[::-1]) * face  # [2, h, w] x, y
        share = (distance / _REACH).clip(0, 1)
        more = _SHARPNESS - 1
        deeper = more * distance.clip(0) * (1 - share) ** 2
        slope = more * (1 - share) * (1 - 3 * share) * (1 + distance.clip(max=0) / _OUTSIDE).clip(0)
        self._maps[:2] = deeper * inward * face_px
        fading = smoothstep(torch.from_numpy((_FADES[1] - distance) / (_FADES[1] - _FADES[0]))).numpy()
        self._maps[2] = fading * (1 + slope * np.square(inward).sum(0).clip(max=1))

    def at(self, window: Window) -> tuple[Tensor, Tensor]:
        """Offsets [2, h, w] in pixels of the photo, x and y, and brightness [h, w]."""
        maps = enlarged(self._maps, self._size_px, window.rows)[..., window.columns]
        return torch.from_numpy(maps[:2]), torch.from_numpy(maps[2])
