"""The masks in which a fitted face is compared, and the classes of angles that tables use."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import grid_triangles, grid_uv, interior_mask, region_mask
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture

LIGHTS_DEG = (0, 30, 60, 90, 180)  # between a light and the camera's axis
TURNS_DEG = (0, 30, 60, 180)  # of the head, from the source's pose to the target's
_NO_TURN_DEG = 0.5
_MASK_SIDE = 256  # texels of the masks


@dataclass(frozen=True, eq=False)
class CropView:
    """A fitted face in its crop [S, S]: the (u, v) of each pixel and the mask of the comparison.

    `mask` [S, S] in 0..1 is the paper's M_t where the crop shows the photo. Eyes are left out of it unless
    `keep_eyes`, since the field of open eyes is not learnt (paper, 'Results').
    """

    fit: FaceFit
    uv: Tensor
    mask: np.ndarray

    @staticmethod
    def of(model: MorphableModel, fit: FaceFit, shown: np.ndarray, keep_eyes: bool = False) -> "CropView":
        """View a fit of `model`; `shown` [S, S] in 0..1 is where the crop shows the photo.

        Raises InputError where nothing of the face is visible.
        """
        vertices = fit.vertices_camera(model)
        fragments = rasterize(vertices, grid_triangles(), fit.camera)
        uv = interpolate(grid_uv(), grid_triangles(), fragments)
        mask = interior_mask(vertices, fragments, uv, _MASK_SIDE)[0]
        if not keep_eyes:
            mask = mask * (1 - sample_texture(region_mask("eyes", _MASK_SIDE)[None], uv)[..., 0])
        inside = mask.numpy() * shown
        if not inside.max() > 0:
            raise InputError("nothing of the fitted face is visible in the image; give its --landmarks")
        return CropView(fit, uv, inside)

    def region(self, name: str) -> np.ndarray:
        """The mask [S, S] in 0..1 of a named region of the face (`face/topology.py`)."""
        return sample_texture(region_mask(name, _MASK_SIDE)[None], self.uv)[..., 0].numpy()


def angle_of(rotation: Tensor) -> float:
    """The angle in degrees of a rotation [3, 3]."""
    return float((((rotation.trace() - 1) / 2).clamp(-1, 1).acos()).rad2deg())


def angle_class(angle_deg: float) -> str:
    """'0 to 30 deg' and so on, of the angle between a light and the camera's axis."""
    return _class(angle_deg, LIGHTS_DEG)


def turn_class(angle_deg: float) -> str:
    """'none', '0 to 30 deg' and so on, of the angle by which a head is turned."""
    return "none" if angle_deg < _NO_TURN_DEG else _class(angle_deg, TURNS_DEG)


def _class(angle_deg: float, edges_deg: tuple[int, ...]) -> str:
    return next(f"{low} to {high} deg" for low, high in pairwise(edges_deg) if angle_deg <= high)
