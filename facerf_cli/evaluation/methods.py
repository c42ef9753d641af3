"""Classes of the angles that break the protocols' tables down.

The methods of a comparison: a reflectance model over a checkpoint's networks, by the name of its rows.

A fitted face in the frame of its crop: where pictures of the protocols are made and compared.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from facerf_cli.baselines import Kind
from facerf_cli.baselines.base import Explained, Reflectance
from facerf_cli.baselines.explain import explain
from facerf_cli.baselines.field import Field
from facerf_cli.errors import InputError
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import grid_triangles, grid_uv, interior_mask, region_mask
from facerf_cli.pipeline import FaceTexture, Models, explain_photo
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import inpaint, normal_map, sample_texture, unwrap

LIGHTS_DEG = (0, 30, 60, 90, 180)  # between a light and the camera's axis
TURNS_DEG = (0, 30, 60, 180)  # of the head, from the source's pose to the target's
_NO_TURN_DEG = 0.5


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


@dataclass(frozen=True, eq=False)
class Method:
    """A reflectance model under the name that its figures have."""

    name: str
    kind: Kind
    models: Models

    def reflectance(self, fit: FaceFit, face: FaceTexture, held_to_photo: bool) -> Reflectance:
        """The reflectance alone, where its light is of no use: of the field it is not estimated."""
        if self.kind == "field":
            return Field(self.models, face, explain_photo(self.models, face) if held_to_photo else None)
        return self.explained(fit, face).reflectance

    def explained(self, fit: FaceFit, face: FaceTexture, held_to_photo: bool = False) -> Explained:
        """Reflectance and light; a field that is held to its photo gives it back by construction."""
        return explain(self.kind, self.models, fit, face, held_to_photo)


def relit_by(reflectance: Reflectance, explained: Explained, turn: Tensor | None = None) -> Tensor:
    """The texture [3, T, T] of a reflectance under the light of an explained photo."""
    light = explained.light
    return reflectance.relit(light.directions, light.weights[None], turn)[0]


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

    def texture_of(self, image: np.ndarray) -> FaceTexture:
        """A picture of the crop [S, S, 3] in the chart, as `pipeline.unwrap_face` has a photo."""
        planes = torch.from_numpy(np.dstack([image, self.seen]).astype(np.float32)).permute(2, 0, 1)
        unwrapped, visible = unwrap(planes, self.vertices, grid_triangles(), self.fit.camera, TEXTURE_SIDE)
        visible = visible * (unwrapped[3] > _INSIDE)
        normals = normal_map(self.vertices, grid_triangles(), TEXTURE_SIDE)
        return FaceTexture(inpaint(unwrapped[:3], visible), visible, normals)

    def region(self, name: str) -> np.ndarray:
        """Where the crop shows a named region of the face [S, S], 0..1 (`face/topology.py`)."""
        return sample_texture(region_mask(name, TEXTURE_SIDE)[None], self.uv)[..., 0].numpy()

    def image(self, texture: Tensor) -> np.ndarray:
        """A texture [3, T, T] on the face, seen in the crop [S, S, 3]; beyond the mesh it means nothing."""
        return sample_texture(texture, self.uv).numpy()
