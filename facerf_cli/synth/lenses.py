"""Lenses of glasses over finished images, since nothing else here is transparent; refraction is left out."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.synth.head.mesh import HeadMesh
from facerf_cli.synth.views import StageCamera

_REFLECTANCE = 0.04  # of one surface at normal incidence: a refractive index of 1.5
_SURFACES = 2
_SHARPNESS = 150.0  # of the lobe that spreads a light of the rig over its surroundings


@dataclass(frozen=True, eq=False)
class Lenses:
    """Lenses in pixels [N] of an image [S, S], numbered row by row; their normals and views [N, 3]."""

    pixels: Tensor
    normals: Tensor
    views: Tensor


def lenses_in(lenses: HeadMesh | None, camera: StageCamera, depth_m: np.ndarray) -> Lenses:
    """Find the pixels that show lenses in front of everything else, of depth [H, W] in m, 0 for nothing."""
    if lenses is None:
        return Lenses(torch.zeros(0, dtype=torch.long), torch.zeros(0, 3), torch.zeros(0, 3))
    vertices = camera.to_camera(torch.from_numpy(lenses.vertices))
    triangles = torch.from_numpy(lenses.triangles)
    fragments = rasterize(vertices, triangles, camera.camera)
    normals = torch.from_numpy(lenses.normals) @ camera.head_to_camera.T
    surface = interpolate(torch.cat([vertices, normals], 1), triangles, fragments)
    unobstructed = torch.from_numpy(depth_m == 0) | (-surface[..., 2] < torch.from_numpy(depth_m))
    pixels = (fragments.covered & unobstructed).flatten().nonzero()[:, 0]
    position, normal = torch.split(surface.flatten(0, 1)[pixels], 3, 1)
    return Lenses(pixels, F.normalize(normal, dim=1), F.normalize(-position, dim=1))


def reflections(lenses: Lenses, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return the radiance [N, L] of each light of a rig in the lenses, and their transmittance [N].

    A light of weight 1 stands for a cell of the sphere with a radiance of pi over its solid angle
    (docs/design.md, 'Units of light').
    """
    cosine = (lenses.normals * lenses.views).sum(1)
    mirrored = 2 * cosine[:, None] * lenses.normals - lenses.views
    weights = (_SHARPNESS * mirrored @ directions.T).softmax(1)
    fresnel = _REFLECTANCE + (1 - _REFLECTANCE) * (1 - cosine.abs().clamp(0, 1)) ** 5
    reflected = _SURFACES * fresnel / (1 + fresnel)
    return reflected[:, None] * weights * (len(directions) / 4), 1 - reflected
