"""Portraits for training: whole people whose light, skin and clothes differ in every photo.

`bake_portrait` photographs a person once and keeps what does not depend on light and appearance: the facets
of the image with their surface, and how much of each rig light reaches them. `photograph` shades them with
any appearance under any lights, in a few hundredths of a second, with the truth beside it.
"""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.light.mesh_transport import bake_mesh
from facerf_cli.light.sh import sh_basis
from facerf_cli.light.transport import BakeSettings
from facerf_cli.raster.camera import project
from facerf_cli.synth.appearance.materials import Appearance, sample
from facerf_cli.synth.bake_renderer import irradiance_factors
from facerf_cli.synth.facets import facets_of
from facerf_cli.synth.head.body import clearance_m
from facerf_cli.synth.head.labels import CLASSES
from facerf_cli.synth.head.mesh import PARTS
from facerf_cli.synth.shading import Strands, strand_cosines, strand_highlights, unit, widened_lobes
from facerf_cli.synth.stage_cameras import StageCamera
from facerf_cli.synth.subjects import Subject
from facerf_cli.synth.truth import truth_of

_BOUNCE_ORDER = 3  # of the spherical harmonics that hold bounced light
_HIGHLIGHTS = 12  # only the brightest lights have highlights
_LEAST_COSINE = 0.05  # below it a facet's visibility cannot be derived from its irradiance
_HAIR = PARTS.index("hair")


@dataclass(frozen=True, eq=False)
class BakedPortrait:
    """One image [S, S] of a person, as N facets: parts of the mesh in a pixel; vectors in camera space.

    pixel [N] int32, row by row; share [N] float16 of the pixel; part [N] uint8; uv [N, 2] float32 of the
    part's texture; normals, tangents [N, 3] and spread [N] (variance of the normals) float16; positions_m
    [N, 3] float32; direct [N, L] uint8, of 255: visibility of each light, on surfaces times n.l; bounce
    [N, 16] float16: spherical harmonics of the light after one bounce off white surroundings; directions
    [L, 3] of the lights; classes [S, S, C] uint8: shares, of 255; landmarks_px [68 + M, 2]; rotation [3, 3]:
    head_to_camera.
    """

    pixel: Tensor
    share: Tensor
    part: Tensor
    uv: Tensor
    normals: Tensor
    tangents: Tensor
    spread: Tensor
    positions_m: Tensor
    direct: Tensor
    bounce: Tensor
    directions: Tensor
    classes: Tensor
    landmarks_px: Tensor
    rotation: Tensor

    @property
    def side_px(self) -> int:
        """Side of the image."""
        return len(self.classes)


@dataclass(frozen=True, eq=False)
class PortraitPhoto:
    """A photo [3, S, S] over black, scene-linear, and its truth; alpha [S, S], classes [C, S, S] in 0..1."""

    image: Tensor
    alpha: Tensor
    classes: Tensor
    albedo: Tensor  # [3, S, S] times alpha
    normals: Tensor  # [3, S, S] unit, camera space; 0 off the person


def bake_portrait(
    subject: Subject, camera: StageCamera, directions: np.ndarray, settings: BakeSettings, seed: int
) -> BakedPortrait:
    """Bake what a camera sees of a person under lights from world-space `directions` [L, 3]."""
    mesh = subject.mesh
    transport = bake_mesh(
        mesh.vertices,
        mesh.normals,
        mesh.triangles,
        directions,
        settings,
        seed,
        wanted=(mesh.normals @ camera.head_to_camera.numpy()[2]) > -0.3,
        two_sided=mesh.part == _HAIR,
        clearance_m=clearance_m(mesh),
    )
    facets, shares, pixels = facets_of(mesh, subject.appearance, camera, relief=False)
    direct, bounce = irradiance_factors(mesh, transport)
    basis = sh_basis(torch.from_numpy(directions).float() @ camera.head_to_camera.T.float(), _BOUNCE_ORDER)
    direct = np.where((mesh.part == _HAIR)[:, None], transport.visibility.T, direct)
    seen = facets.corners @ direct[facets.vertices]
    bounced = torch.from_numpy(facets.corners @ bounce[facets.vertices])
    rotation = camera.head_to_camera.float()
    points = torch.from_numpy(facets.corners @ mesh.vertices[facets.vertices]).float()
    truth = truth_of(mesh, subject.appearance, camera)
    landmarks = np.concatenate([subject.landmarks_world, list(subject.more_landmarks_world.values())])
    landmarks_camera = torch.from_numpy(landmarks).float() @ rotation.T + camera.translation_m
    owner = np.repeat(pixels, np.diff(shares.indptr))
    return BakedPortrait(
        pixel=torch.from_numpy(owner).int(),
        share=torch.from_numpy(shares.data).half(),
        part=facets.part.byte(),
        uv=facets.uv,
        normals=(facets.normals @ rotation.T).half(),
        tangents=(facets.tangents @ rotation.T).half(),
        spread=facets.spread.half(),
        positions_m=points @ rotation.T + camera.translation_m.float(),
        direct=torch.from_numpy((255 * seen).round().clip(0, 255).astype(np.uint8)),
        bounce=(bounced @ torch.linalg.pinv(basis).T).half(),
        directions=torch.from_numpy(directions).float() @ rotation.T,
        classes=torch.from_numpy((255 * truth.classes).round().astype(np.uint8)),
        landmarks_px=project(landmarks_camera, camera.camera),
        rotation=rotation @ subject.head_to_world.float(),
    )


def photograph(portrait: BakedPortrait, appearance: Appearance, weights: Tensor) -> PortraitPhoto:
    """Shade a portrait under weights [L, 3] of its lights; no light scatters under the skin."""
    part = portrait.part.long()
    surface = sample(appearance, part, portrait.uv)
    normals, views = portrait.normals.float(), unit(-portrait.positions_m, 1)
    hair = part == _HAIR
    strands = Strands(
        portrait.tangents.float()[hair], views[hair], surface.specular[hair], surface.roughness[hair]
    )
    direct = portrait.direct.float()
    direct[hair] *= strand_cosines(strands.tangents, normals[hair], portrait.directions)
    lit = direct @ (weights / 255)
    basis = sh_basis(portrait.directions, _BOUNCE_ORDER)
    bounced = (portrait.bounce.float() @ (basis.T @ weights)).clamp_min(0)
    radiance = surface.albedo * (lit + surface.albedo.mean(0) * bounced)
    bright = weights.sum(1).topk(min(_HIGHLIGHTS, len(weights))).indices
    lights, power, visible = (
        portrait.directions[bright],
        weights[bright],
        portrait.direct[:, bright].float() / 255,
    )
    gloss = widened_lobes(
        normals[~hair],
        views[~hair],
        lights,
        surface.specular[~hair],
        surface.roughness[~hair],
        portrait.spread.float()[~hair],
    )
    n_dot_l = (normals[~hair] @ lights.T).clamp_min(_LEAST_COSINE)
    radiance[~hair] += (gloss * (visible[~hair] / n_dot_l).clamp(0, 1)) @ power
    white, coloured = (lobe * visible[hair] @ power for lobe in strand_highlights(strands, lights))
    radiance[hair] += white + coloured * surface.albedo[hair]
    share, pixel = portrait.share.float()[:, None], portrait.pixel.long()
    columns = torch.cat([radiance, surface.albedo, normals], 1) * share
    side = portrait.side_px
    summed = torch.zeros(side * side, columns.shape[1]).index_add_(0, pixel, columns)
    image, albedo, normal = summed.T.view(3, 3, side, side)
    classes = portrait.classes.permute(2, 0, 1).float() / 255
    alpha = torch.zeros(side * side).index_add_(0, pixel, share[:, 0]).view(side, side)
    return PortraitPhoto(image, alpha, classes, albedo, unit(normal, 0))


def save_portrait(path: Path, portrait: BakedPortrait) -> None:
    """Write a portrait, whole or not at all."""
    tensors = {field.name: getattr(portrait, field.name).contiguous() for field in fields(portrait)}
    with atomic_path(path) as temporary:
        save_file(tensors, temporary)


def load_portrait(path: Path) -> BakedPortrait:
    """Read a portrait; raise InputError where the file is not one."""
    try:
        portrait = BakedPortrait(**load_file(path))
    except Exception as error:  # safetensors raises its own kinds
        raise InputError(f"{path}: not a portrait; bake it again ({type(error).__name__})") from None
    if portrait.classes.shape[-1] != len(CLASSES):
        raise InputError(f"{path}: a portrait of another version; bake it again")
    return portrait
