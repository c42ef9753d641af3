"""Pictures of the bank's heads for the Geometry Network, with what its fit should find in each.

The baked face, under a skin and lights drawn anew for every picture, is seen by the cameras of `stage.views`
and cropped by landmarks as noisy as a detector's. What a photograph shows around a face stands around it:
skull, ears and neck, hair, clothes, glasses, lit plainly and without shadows. The background is left open.
"""

from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.fit import fit_batch
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import GRID, grid_uv, landmark_weights
from facerf_cli.files.atomic import atomic_path
from facerf_cli.raster.camera import Camera, crop_camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture
from facerf_cli.stage.appearance.pigments import hair_albedo
from facerf_cli.stage.appearance.skin import Skin, draw_skin
from facerf_cli.stage.baked_faces import Geometry
from facerf_cli.stage.bank import geometry_of
from facerf_cli.stage.draws import Uniform
from facerf_cli.stage.head.clothes import draw_clothes
from facerf_cli.stage.head.glasses import draw_glasses
from facerf_cli.stage.head.hair import draw_hair
from facerf_cli.stage.head.mesh import PARTS, HeadMesh, joined
from facerf_cli.stage.head.shell import shell_head
from facerf_cli.stage.lights import draw_light
from facerf_cli.stage.shading import bend, diffuse_irradiance, highlights, scatter, unit
from facerf_cli.stage.shards import in_shards
from facerf_cli.stage.views import Shot, ViewSettings, photograph_head

BRIGHTEST = 6.0  # radiance over the face's mean that a stored picture still tells
_HIGHLIGHTS = 10  # of the lights, the brightest ones also shine
_GLASSES_SHARE, _HAIR_SHARE = 0.2, 0.85
_OPEN_SHADE = 0.75  # of the light that reaches skin and cloth around the face, in place of shadows
_UNDER_CHIN_M, _UNDER_CHIN_SHADE = -0.09, 0.5
_STRANDS_SHARE = 0.15  # of the hair: enough at two millimetres a pixel, over a scalp of its colour
_SCALP_M = 0.085  # above this, or behind the ears, the skin of those with hair is scalp
_COARSE = 2  # every other vertex of the chart's grid, for the same reason
_SKIN, _HAIR, _CLOTH, _FRAME = (PARTS.index(name) for name in ("skin", "hair", "cloth", "frame"))


# The clamped cosine in spherical harmonics (Ramamoorthi and Hanrahan, *An efficient representation for
# irradiance environment maps*, 2001): the squared constants of the harmonics times pi, 2 pi / 3, pi / 4.
_LAMBERT = torch.tensor([1 / 4, *[1 / 2] * 3, *[15 / 16] * 2, 5 / 64, 15 / 16, 15 / 64])


_VIEWS = ViewSettings(crop_px=128, yaw_deg=24.0, frontal_share=0.35)


@dataclass(frozen=True)
class PictureSettings:
    """Crops of `crop_px` with a margin of `margin_px` on every side, so that they can be shifted later."""

    crop_px: int = 128
    margin_px: int = 16
    views: ViewSettings = _VIEWS


def add_pictures(
    heads: Path,
    folder: Path,
    count: int,
    jobs: int,
    seed: int,
    settings: PictureSettings = PictureSettings(),
) -> None:
    """Write `count` pictures of every baked head in `heads` to `folder`; finished heads are kept."""
    found = sorted(heads.glob("*.safetensors"))
    if not found:
        raise InputError(f"{heads}: no baked heads; let `facerf train` bake them")
    missing = [path for path in found if not (folder / path.name).exists()]
    in_shards(partial(_add_shard, folder, count, seed, settings), missing, jobs)


def _add_shard(folder: Path, count: int, seed: int, settings: PictureSettings, heads: list[Path]) -> None:
    torch.set_num_threads(1)
    for path in heads:
        tensors = picture_head(load_file(path), count, seed, int(path.stem), settings)
        with atomic_path(folder / path.name) as temporary:
            save_file(tensors, temporary)


@torch.no_grad()
def picture_head(
    head: dict[str, Tensor], count: int, seed: int, index: int, settings: PictureSettings
) -> dict[str, Tensor]:
    """`count` pictures of one baked head.

    pictures [W, 4, S, S] bytes: square roots of radiance over `BRIGHTEST` times the face's mean, and cover;
    S is crop_px + 2 margin_px. landmarks_px [W, 68, 2] in the crop. rotation [W, 3, 3], translation_m [W, 3],
    alpha [W, Ki], beta [W, Ke]: the built-in model's fit to these landmarks, through the crop's camera.
    """
    random = np.random.default_rng([seed, index, 2])
    generator = torch.Generator().manual_seed(int(random.integers(1 << 62)))
    geometry, vertices = geometry_of(head), head["vertices"]
    around = _surroundings(vertices, random)
    shots = [photograph_head(vertices, random, settings.views) for _ in range(count)]
    pictures = torch.stack(
        [
            _picture(geometry, around, shot, _translation(vertices, shot), settings, generator)
            for shot in shots
        ]
    )
    landmarks_px = torch.stack([_true_landmarks(shot) for shot in shots])
    fit = fit_batch(load_face_model(), landmarks_px, crop_camera(settings.crop_px))
    found = {name: getattr(fit, name).float() for name in ("rotation", "translation_m", "alpha", "beta")}
    return {"pictures": pictures, "landmarks_px": landmarks_px, **found}


def _translation(vertices: Tensor, shot: Shot) -> Tensor:
    """Where the head frame's origin lies in camera space [3], m."""
    return (shot.vertices_camera - vertices @ shot.rotation.T).mean(0)


def _true_landmarks(shot: Shot) -> Tensor:
    corners, weights = landmark_weights()
    return project((shot.vertices_camera[corners] * weights[..., None]).sum(1), shot.camera)


@dataclass(frozen=True)
class _Surroundings:
    """What stands around the chart: head frame, numpy's meshes as tensors."""

    vertices: Tensor  # [N, 3]
    normals: Tensor  # [N, 3]
    triangles: Tensor  # [F, 3]
    part: Tensor  # [N], scalp under hair counts as hair


def _surroundings(vertices: Tensor, random: np.random.Generator) -> _Surroundings:
    bare = shell_head(vertices, (0.0, 0.0), 0)
    corners, weights = landmark_weights()
    landmarks_m = (vertices[corners] * weights[..., None]).sum(1).numpy()
    dressed = joined(bare, draw_clothes(bare, random))
    worn: list[HeadMesh] = []
    if random.random() < _HAIR_SHARE:
        hair, _ = draw_hair(dressed, random)
        worn += [hair] if hair else []
    if random.random() < _GLASSES_SHARE:
        worn.append(draw_glasses(bare, landmarks_m, random))
    mesh = joined(dressed, *worn)
    on_chart = (mesh.part == _SKIN) & ((mesh.uv >= 0) & (mesh.uv <= 1)).all(-1)
    shown = np.isin(mesh.part, (_SKIN, _HAIR, _CLOTH, _FRAME))
    shown &= (mesh.part != _HAIR) | (mesh.uv[:, 0] < _STRANDS_SHARE)
    kept = shown[mesh.triangles].all(-1) & ~on_chart[mesh.triangles].all(-1)
    scalp = (mesh.part == _SKIN) & ((mesh.vertices[:, 1] > _SCALP_M) | (mesh.vertices[:, 2] < -0.02))
    scalp &= (mesh.vertices[:, 1] > -0.06) & bool((mesh.part == _HAIR).any())
    part = np.where(scalp, _HAIR, mesh.part.astype(np.int64))
    used, triangles = np.unique(mesh.triangles[kept], return_inverse=True)
    return _Surroundings(
        torch.from_numpy(mesh.vertices[used]),
        torch.from_numpy(mesh.normals[used]),
        torch.from_numpy(triangles.reshape(-1, 3)).long(),
        torch.from_numpy(part[used]),
    )


def _picture(
    geometry: Geometry,
    around: _Surroundings,
    shot: Shot,
    translation_m: Tensor,
    settings: PictureSettings,
    generator: torch.Generator,
) -> Tensor:
    """One picture [4, S, S] in bytes, see `picture_head`."""
    skin = draw_skin(1, geometry.normals.shape[-1], generator)
    weights = draw_light(geometry.directions @ shot.rotation.T, generator)
    texture = _radiance(geometry, skin, weights, -shot.rotation.T @ translation_m)
    colours = _lit_plainly(around, geometry.directions, weights, _materials(around, skin, generator))
    coarse, face_triangles = _coarse_grid()
    vertices = torch.cat([shot.vertices_camera[coarse], around.vertices @ shot.rotation.T + translation_m])
    triangles = torch.cat([face_triangles, around.triangles + len(coarse)])
    fragments = rasterize(vertices, triangles, _wider(shot.camera, settings.margin_px))
    on_face = F.pad(torch.cat([grid_uv()[coarse], torch.ones(len(coarse), 1)], 1), (0, 3))
    attributes = torch.cat([on_face, F.pad(colours, (3, 0))])
    seen = interpolate(attributes, triangles, fragments)
    face = seen[..., 2:3] > 0.5
    picture = torch.where(face, sample_texture(texture, seen[..., :2]), seen[..., 3:])
    exposure = texture.mean() * BRIGHTEST
    covered = fragments.covered[..., None].float()
    stored = torch.cat([(picture / exposure).clamp(0, 1).sqrt() * covered, covered], -1)
    return (stored * 255).round().byte().permute(2, 0, 1).contiguous()


@cache
def _coarse_grid() -> tuple[Tensor, Tensor]:
    """Vertex ids [v] of every `_COARSE`-th row and column of the grid, and triangles [f, 3] of these."""
    ids = torch.arange(GRID * GRID).view(GRID, GRID)[::_COARSE, ::_COARSE]
    own = torch.arange(ids.numel()).view(ids.shape)
    a, b, c, d = (x.reshape(-1) for x in (own[:-1, :-1], own[:-1, 1:], own[1:, :-1], own[1:, 1:]))
    return ids.reshape(-1), torch.cat([torch.stack([a, c, d], -1), torch.stack([a, d, b], -1)])


def _wider(camera: Camera, margin_px: int) -> Camera:
    side_px = camera.width_px + 2 * margin_px
    return Camera(camera.focal_px, side_px, side_px, camera.cx_px + margin_px, camera.cy_px + margin_px)


def _radiance(geometry: Geometry, skin: Skin, weights: Tensor, camera_m: Tensor) -> Tensor:
    """Texture [3, T, T] of a baked face seen from `camera_m` (head frame) under rig lights [L, 3]."""
    normals = bend(
        geometry.normals[None], geometry.tangents[0][None], geometry.tangents[1][None], skin.relief
    )
    power = weights.sum(-1)
    used = (power > 0.004 * power.max()).nonzero()[:, 0]
    visibility, bounce = geometry.visibility[used].float() / 255, (geometry.bounce[used].float() / 255) ** 2
    cosines = torch.einsum("lc,cij->lij", geometry.directions[used], normals[0])
    albedo = skin.albedo[0]
    irradiance = diffuse_irradiance(visibility, bounce, cosines, albedo, weights[used])
    radiance = albedo * scatter(irradiance[None], skin.scattering_texels)[0]
    bright = power.topk(min(_HIGHLIGHTS, len(used))).indices
    views = unit(camera_m.view(3, 1, 1) - geometry.positions, 0)
    gloss = highlights(normals, views[None], geometry.directions[bright][None], skin)[0]
    return radiance + torch.einsum("lc,lij->cij", weights[bright], gloss * geometry.visibility[bright] / 255)


def _materials(around: _Surroundings, skin: Skin, generator: torch.Generator) -> Tensor:
    """Albedo [N, 3] of what stands around: this skin's mean, and hair, cloth and frames of random colours."""
    uniform = Uniform(generator, (1,))
    side = skin.albedo.shape[-1]
    middle = skin.albedo[0, :, side // 4 : side * 5 // 8, side // 4 : side * 3 // 4].mean((1, 2))
    albedo = middle.expand(len(around.part), 3).clone()
    grey = (torch.rand(1, generator=generator) < 0.2).float() * uniform(0.2, 1)
    hair = hair_albedo(torch.exp(uniform(-1.5, 2.1)), uniform(0, 0.6), grey)[0]
    strands = around.part == _HAIR
    albedo[strands] = hair * uniform(0.6, 1.4, int(strands.sum()), 1)
    albedo[around.part == _CLOTH] = uniform(0.02, 0.7, 3)
    albedo[around.part == _FRAME] = uniform(0.01, 0.3, 3)
    return albedo


def _lit_plainly(around: _Surroundings, directions: Tensor, weights: Tensor, albedo: Tensor) -> Tensor:
    """Radiance [N, 3] of matt surfaces under lights [L, 3] without shadows; light goes around hair."""
    irradiance = _harmonics(around.normals) @ (_LAMBERT[:, None] * (_harmonics(directions).T @ weights))
    ambient = weights.sum(0) / 4
    irradiance = torch.where((around.part == _HAIR)[:, None], 0.6 * irradiance + 0.4 * ambient, irradiance)
    low = ((_UNDER_CHIN_M - around.vertices[:, 1]) / 0.03).clamp(0, 1) * (around.part == _SKIN)
    shade = _OPEN_SHADE * (1 - low * (1 - _UNDER_CHIN_SHADE))
    return albedo * irradiance.clamp_min(0) * shade[:, None]


def _harmonics(directions: Tensor) -> Tensor:
    """Real spherical harmonics up to degree 2 [N, 9], without their constants, which `_LAMBERT` has."""
    x, y, z = directions.unbind(-1)
    second = (x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y)
    return torch.stack([torch.ones_like(x), y, z, x, *second], -1)
