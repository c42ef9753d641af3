"""Lenses of glasses: they reflect the lights, and let the rest through straight.

They lie over finished images, since nothing else here is transparent. What they refract is left out.
"""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.synth.head.mesh import HeadMesh
from facerf_cli.synth.stage_cameras import StageCamera

_REFLECTANCE = 0.04  # of one surface at normal incidence: a refractive index of 1.5
_SURFACES = 2
_SHARPNESS = 150.0  # of the lobe in which a light of the rig stands for its surroundings


@dataclass(frozen=True, eq=False)
class Lenses:
    """Pixels [N] of an image [S, S], row by row, that show lenses; their normals and views [N, 3]."""

    pixels: Tensor
    normals: Tensor
    views: Tensor


def lenses_in(lenses: HeadMesh, camera: StageCamera, depth_m: np.ndarray) -> Lenses:
    """Find the pixels that show lenses before everything else, whose depth [H, W] (m) is 0 for nothing."""
    rotation = camera.head_to_camera.float()
    vertices = torch.from_numpy(lenses.vertices).float() @ rotation.T + camera.translation_m.float()
    triangles = torch.from_numpy(lenses.triangles).long()
    fragments = rasterize(vertices, triangles, camera.camera)
    normals = torch.from_numpy(lenses.normals).float() @ rotation.T
    found = interpolate(torch.cat([vertices, normals], 1), triangles, fragments)
    nothing_before = torch.from_numpy(depth_m == 0) | (-found[..., 2] < torch.from_numpy(depth_m))
    pixels = (fragments.covered & nothing_before).flatten().nonzero()[:, 0]
    place, normal = torch.split(found.flatten(0, 1)[pixels], 3, 1)
    return Lenses(pixels, F.normalize(normal, dim=1), F.normalize(-place, dim=1))


def over_lenses(images: Tensor, lenses: Lenses, directions: Tensor) -> Tensor:
    """Lay lenses over images [L, 3, H, W] of single lights, from directions [L, 3] in camera space."""
    seen, transmitted = reflections(lenses, directions)
    flat = images.flatten(2).clone()
    flat[..., lenses.pixels] = flat[..., lenses.pixels] * transmitted + seen.T[:, None]
    return flat.view_as(images)


def reflections(lenses: Lenses, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Radiance [N, L] that lenses reflect of each light of a rig, and share [N] that they let through.

    A light of weight 1 stands for a cell of the sphere with a radiance of pi over its solid angle
    (docs/design.md, 'Units of light').
    """
    cosine = (lenses.normals * lenses.views).sum(1)
    mirrored = 2 * cosine[:, None] * lenses.normals - lenses.views
    share = (_SHARPNESS * mirrored @ directions.T).softmax(1)
    fresnel = _REFLECTANCE + (1 - _REFLECTANCE) * (1 - cosine.abs().clamp(0, 1)) ** 5
    reflected = _SURFACES * fresnel / (1 + fresnel)
    return reflected[:, None] * share * (len(directions) / 4), 1 - reflected
