"""Depth of a person at the photo's own resolution.

Where the proxy covers a pixel, it is the proxy's: it jumps at chin and nose, and lies between no two
surfaces. Hair, hats and cloth beyond the proxy continue it, head and body apart: hair next to the neck is as
far away as the head, a sleeve as the bust. The background gives nothing.
"""

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.view import photo_camera, rows_of_camera
from facerf_cli.image.strips import enlarged
from facerf_cli.portrait.classes import class_index
from facerf_cli.portrait.person import SeenPerson
from facerf_cli.raster.camera import Camera, rays_of_rows
from facerf_cli.raster.rasterize import front_facing, rasterize
from facerf_cli.raster.texture import blurred, inpaint

_BODY = [class_index(name) for name in ("neck", "garment", "hand")]
_STEADY_PX = 1.5  # blur of their shares, pixels of the classes
_OTHERS = 1e-6  # weight of head for body, and of body for head: counts where nothing else is near


class Surface:
    """The surface that a photo of some size shows of a person."""

    def __init__(self, person: SeenPerson, size_px: tuple[int, int]) -> None:
        self._proxy, self._size_px = person.proxy, size_px
        self._camera = photo_camera(person.fit.crop, *size_px)
        outside = front_facing(person.proxy.vertices, person.proxy.triangles)
        self._outside = person.proxy.triangles[outside]
        self._beyond = self._continued(person.segmentation.classes)

    def depth_m(self, rows: slice) -> np.ndarray:
        """Distance [h, W, 1] along the camera's axis in some rows of the photo."""
        seen = self._seen(rows_of_camera(self._camera, rows))
        head, body, lead = enlarged(self._beyond.numpy(), self._size_px, rows)
        return np.where(seen.isfinite(), seen, np.where(lead > 0, head, body))[..., None]

    def position_m(self, rows: slice) -> np.ndarray:
        """Places [h, W, 3] in camera space in some rows of the photo."""
        return self.depth_m(rows) * rays_of_rows(self._camera, self._size_px, rows).numpy()

    def _seen(self, camera: Camera) -> Tensor:
        """Depth of the proxy's outer side [h, w]; infinite where nothing of it is seen."""
        return rasterize(self._proxy.vertices, self._outside, camera).depth_m

    def _continued(self, classes: Tensor) -> Tensor:
        """Depth of head and of body, continued, and the lead of the head in the classes [3, h, w]."""
        height, width = classes.shape[1:]
        scale = width / self._size_px[1], height / self._size_px[0]
        whole = self._camera
        seen = self._seen(
            Camera(whole.focal_px * scale[0], width, height, whole.cx_px * scale[0], whole.cy_px * scale[1])
        )
        body = classes[_BODY].sum(0)
        head = 1 - classes[0] - body
        weights = torch.stack([head + _OTHERS * body, body + _OTHERS * head]).clamp(0, 1) * seen.isfinite()
        depth = seen.nan_to_num(posinf=0).expand(2, 1, -1, -1)
        return torch.cat([inpaint(depth, weights)[:, 0], blurred((head - body)[None], _STEADY_PX)])
