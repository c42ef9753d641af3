"""A fitted face in the frame of its crop: where pictures of the protocols are made and compared."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.interior import interior_mask
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.regions import region_mask
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.pipeline import FaceTexture
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import inpaint, normal_map, sample_texture, unwrap

TEXTURE_SIDE = 256  # as the verbs have it
_INSIDE = 0.9  # of the pixels that a texel shows, the share that must be face


@dataclass(frozen=True, eq=False)
class View:
    """A face in its crop [S, S]: mesh [V, 3] in camera space, the (u, v) that each pixel sees, and the mask.

    `mask` [S, S] in 0..1 is the paper's M_t; without `keep_eyes` the eyes are left out of it, for the field
    of open eyes is not learnt (paper, 'Results').
    """

    fit: FaceFit
    vertices: Tensor
    uv: Tensor
    mask: np.ndarray
    seen: np.ndarray  # [S, S] in 0..1: where the crop's picture shows the head

    @staticmethod
    def of(model: MorphableModel, fit: FaceFit, seen: np.ndarray, keep_eyes: bool = False) -> "View":
        """See a fitted face; `model` is the one that was fitted."""
        vertices = fit.vertices_camera(model)
        fragments = rasterize(vertices, grid_triangles(), fit.camera)
        uv = interpolate(grid_uv(), grid_triangles(), fragments)
        mask = interior_mask(vertices, fragments, uv, TEXTURE_SIDE)[0]
        if not keep_eyes:
            mask = mask * (1 - sample_texture(region_mask("eyes", TEXTURE_SIDE)[None], uv)[..., 0])
        inside = mask.numpy() * seen
        if not inside.max() > 0:
            raise InputError("nothing of the fitted face is seen in the picture; there is nothing to compare")
        return View(fit, vertices, uv, inside, seen)

    def texture_of(self, picture: np.ndarray) -> FaceTexture:
        """A picture of the crop [S, S, 3] in the chart, as `pipeline.unwrap_face` has a photo."""
        planes = torch.from_numpy(np.dstack([picture, self.seen]).astype(np.float32)).permute(2, 0, 1)
        unwrapped, visible = unwrap(planes, self.vertices, grid_triangles(), self.fit.camera, TEXTURE_SIDE)
        visible = visible * (unwrapped[3] > _INSIDE)
        normals = normal_map(self.vertices, grid_triangles(), TEXTURE_SIDE)
        return FaceTexture(inpaint(unwrapped[:3], visible), visible, normals)

    def region(self, name: str) -> np.ndarray:
        """Where the crop shows a named region of the face [S, S], 0..1 (`face/regions.py`)."""
        return sample_texture(region_mask(name, TEXTURE_SIDE)[None], self.uv)[..., 0].numpy()

    def picture(self, texture: Tensor) -> np.ndarray:
        """A texture [3, T, T] on the face, seen in the crop [S, S, 3]; beyond the mesh it means nothing."""
        return sample_texture(texture, self.uv).numpy()
