"""Images of the bank's heads to train the Geometry Network, each with the fit that it should find.

A baked face, with random skin and light, is photographed as in `heads.py`. Skull, ears, neck, hair, clothes
and glasses around it have simple shading without shadows. The background stays transparent.
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
from facerf_cli.run.workers import in_shards
from facerf_cli.synth.appearance.people import hair_albedo
from facerf_cli.synth.appearance.skin import Skin, draw_skin
from facerf_cli.synth.bank.heads import HeadPhoto, ViewSettings, photograph_head
from facerf_cli.synth.bank.texture_samples import HeadFields, draw_light, head_fields
from facerf_cli.synth.head.body import draw_body
from facerf_cli.synth.head.glasses import draw_glasses
from facerf_cli.synth.head.hair import draw_hair
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, joined
from facerf_cli.synth.head.shell import shell_head
from facerf_cli.synth.random_fields import Uniform
from facerf_cli.synth.shading import diffuse_irradiance, highlights, scatter, tilt_normals, unit_along

BRIGHTEST = 6.0  # largest stored radiance, over the mean radiance of the face
_HIGHLIGHTS = 10  # only the brightest lights have highlights
_LEAST_POWER = 0.004  # lights below this share of the brightest are skipped
_GLASSES_SHARE, _HAIR_SHARE = 0.2, 0.85
_OPEN_SHADE = 0.75  # share of the light that reaches skin and cloth around the face, in place of shadows
_UNDER_CHIN_M, _UNDER_CHIN_SHADE = -0.09, 0.5  # height below which skin is darker, and by how much
_STRANDS_SHARE = 0.15  # of the hair's strands: enough at 2 mm per pixel, over a scalp of their colour
_SCALP_M, _SCALP_BACK_M, _SCALP_LOW_M = 0.085, -0.02, -0.06  # skin above or behind, and not below, is scalp
_BODY_EDGE_M = 0.02  # mean length of an edge of body and garment
_COARSE = 2  # every other vertex of the face grid, enough at this resolution
_SKIN, _HAIR, _CLOTH, _FRAME = (PARTS.index(name) for name in ("skin", "hair", "cloth", "frame"))
# The clamped cosine in spherical harmonics (Ramamoorthi and Hanrahan, *An efficient representation for
# irradiance environment maps*, 2001): squared constants of the basis, times pi, 2 pi / 3 and pi / 4.
_LAMBERT = torch.tensor([1 / 4, *[1 / 2] * 3, *[15 / 16] * 2, 5 / 64, 15 / 16, 15 / 64])
_VIEWS = ViewSettings(crop_px=128, yaw_deg=24.0, frontal_share=0.35)


@dataclass(frozen=True)
class ImageSettings:
    """Size of stored crops: `crop_px`, with a margin of `margin_px` on every side for later shifts."""

    crop_px: int = 128
    margin_px: int = 16
    views: ViewSettings = _VIEWS


def add_head_images(
    heads: Path,
    folder: Path,
    count: int,
    jobs: int,
    seed: int,
    settings: ImageSettings = ImageSettings(),
) -> None:
    """Write `count` images of every baked head in `heads` to `folder`; keep finished heads."""
    found = sorted(heads.glob("*.safetensors"))
    if not found:
        raise InputError(f"{heads}: no baked heads; run `facerf train` to bake them")
    missing = [path for path in found if not (folder / path.name).exists()]
    in_shards(partial(_add_shard, folder, count, seed, settings), missing, jobs)


def _add_shard(folder: Path, count: int, seed: int, settings: ImageSettings, heads: list[Path]) -> None:
    torch.set_num_threads(1)
    for path in heads:
        tensors = image_head(load_file(path), count, seed, int(path.stem), settings)
        with atomic_path(folder / path.name) as temporary:
            save_file(tensors, temporary)


@torch.no_grad()
def image_head(
    head: dict[str, Tensor], count: int, seed: int, index: int, settings: ImageSettings
) -> dict[str, Tensor]:
    """Render `count` images of one baked head, and fit the built-in model to their true landmarks.

    Returns pictures [W, 4, S, S] in bytes: the square root of radiance over `BRIGHTEST` times the mean of the
    face, and cover; S is crop_px + 2 margin_px. landmarks_px [W, 68, 2] in the crop. Of the fit, through the
    crop camera: rotation [W, 3, 3], translation_m [W, 3], alpha [W, Ki], beta [W, Ke].
    """
    random = np.random.default_rng([seed, index, 2])
    generator = torch.Generator().manual_seed(int(random.integers(1 << 62)))
    fields, vertices = head_fields(head), head["vertices"]
    around = _surroundings(vertices, random)
    photos = [photograph_head(vertices, random, settings.views) for _ in range(count)]
    images = [
        _image(fields, around, photo, _translation(vertices, photo), settings, generator) for photo in photos
    ]
    landmarks_px = torch.stack([_true_landmarks(photo) for photo in photos])
    fit = fit_batch(load_face_model(), landmarks_px, crop_camera(settings.crop_px))
    found = {name: getattr(fit, name).float() for name in ("rotation", "translation_m", "alpha", "beta")}
    return {"pictures": torch.stack(images), "landmarks_px": landmarks_px, **found}


def _translation(vertices: Tensor, photo: HeadPhoto) -> Tensor:
    """Translation [3] of head_to_camera, in metres."""
    return (photo.vertices_camera - vertices @ photo.rotation.T).mean(0)


def _true_landmarks(photo: HeadPhoto) -> Tensor:
    """Project the landmarks [68, 2] of the true mesh."""
    corners, weights = landmark_weights()
    return project((photo.vertices_camera[corners] * weights[..., None]).sum(1), photo.camera)


@dataclass(frozen=True)
class _Surroundings:
    """Mesh of everything around the face, head frame."""

    vertices: Tensor  # [N, 3]
    normals: Tensor  # [N, 3]
    triangles: Tensor  # [F, 3]
    part: Tensor  # [N] index into PARTS; scalp under hair counts as hair


def _surroundings(vertices: Tensor, random: np.random.Generator) -> _Surroundings:
    """Draw clothes, hair and glasses for a head, and keep what is visible outside the face."""
    bare = shell_head(vertices, (0.0, 0.0), 0)
    corners, weights = landmark_weights()
    landmarks_m = (vertices[corners] * weights[..., None]).sum(1).numpy()
    dressed, _ = draw_body(bare, random, _BODY_EDGE_M)
    worn: list[HeadMesh] = []
    if random.random() < _HAIR_SHARE:
        hair, _ = draw_hair(dressed, random)
        worn += [hair] if hair else []
    if random.random() < _GLASSES_SHARE:
        worn.append(draw_glasses(bare, landmarks_m, random).frame)
    mesh = joined(dressed, *worn)
    on_face = (mesh.part == _SKIN) & ((mesh.uv >= 0) & (mesh.uv <= 1)).all(-1)
    shown = np.isin(mesh.part, (_SKIN, _HAIR, _CLOTH, _FRAME))
    shown &= (mesh.part != _HAIR) | (mesh.uv[:, 0] < _STRANDS_SHARE)
    kept = shown[mesh.triangles].all(-1) & ~on_face[mesh.triangles].all(-1)
    scalp = (mesh.part == _SKIN) & ((mesh.vertices[:, 1] > _SCALP_M) | (mesh.vertices[:, 2] < _SCALP_BACK_M))
    scalp &= (mesh.vertices[:, 1] > _SCALP_LOW_M) & bool((mesh.part == _HAIR).any())
    part = np.where(scalp, _HAIR, mesh.part.astype(np.int64))
    used, triangles = np.unique(mesh.triangles[kept], return_inverse=True)
    return _Surroundings(
        torch.from_numpy(mesh.vertices[used]),
        torch.from_numpy(mesh.normals[used]),
        torch.from_numpy(triangles.reshape(-1, 3)).long(),
        torch.from_numpy(part[used]),
    )


def _image(
    fields: HeadFields,
    around: _Surroundings,
    photo: HeadPhoto,
    translation_m: Tensor,
    settings: ImageSettings,
    generator: torch.Generator,
) -> Tensor:
    """Render one image [4, S, S] in bytes, as `image_head` describes."""
    skin = draw_skin(1, fields.normals.shape[-1], generator)
    weights = draw_light(fields.directions @ photo.rotation.T, generator)
    texture = _face_radiance(fields, skin, weights, -photo.rotation.T @ translation_m)
    colours = _diffuse_radiance(around, fields.directions, weights, _materials(around, skin, generator))
    coarse, face_triangles = _coarse_grid()
    vertices = torch.cat([photo.vertices_camera[coarse], around.vertices @ photo.rotation.T + translation_m])
    triangles = torch.cat([face_triangles, around.triangles + len(coarse)])
    fragments = rasterize(vertices, triangles, _with_margin(photo.camera, settings.margin_px))
    face_attributes = F.pad(torch.cat([grid_uv()[coarse], torch.ones(len(coarse), 1)], 1), (0, 3))
    attributes = torch.cat([face_attributes, F.pad(colours, (3, 0))])
    pixels = interpolate(attributes, triangles, fragments)  # u, v, is face, colour around the face
    is_face = pixels[..., 2:3] > 0.5
    image = torch.where(is_face, sample_texture(texture, pixels[..., :2]), pixels[..., 3:])
    exposure = texture.mean() * BRIGHTEST
    covered = fragments.covered[..., None].float()
    stored = torch.cat([(image / exposure).clamp(0, 1).sqrt() * covered, covered], -1)
    return (stored * 255).round().byte().permute(2, 0, 1).contiguous()


@cache
def _coarse_grid() -> tuple[Tensor, Tensor]:
    """Vertex ids [v] of every `_COARSE`-th row and column of the face grid, and their triangles [f, 3]."""
    ids = torch.arange(GRID * GRID).view(GRID, GRID)[::_COARSE, ::_COARSE]
    new = torch.arange(ids.numel()).view(ids.shape)
    a, b, c, d = (x.reshape(-1) for x in (new[:-1, :-1], new[:-1, 1:], new[1:, :-1], new[1:, 1:]))
    return ids.reshape(-1), torch.cat([torch.stack([a, c, d], -1), torch.stack([a, d, b], -1)])


def _with_margin(camera: Camera, margin_px: int) -> Camera:
    side_px = camera.width_px + 2 * margin_px
    return Camera(camera.focal_px, side_px, side_px, camera.cx_px + margin_px, camera.cy_px + margin_px)


def _face_radiance(fields: HeadFields, skin: Skin, weights: Tensor, camera_m: Tensor) -> Tensor:
    """Radiance texture [3, T, T] of a baked face from `camera_m` (head frame) under rig weights [L, 3]."""
    normals = tilt_normals(
        fields.normals[None], fields.tangents[0][None], fields.tangents[1][None], skin.relief
    )
    power = weights.sum(-1)
    used = (power > _LEAST_POWER * power.max()).nonzero()[:, 0]
    visibility, bounce = fields.visibility[used].float() / 255, (fields.bounce[used].float() / 255) ** 2
    cosines = torch.einsum("lc,cij->lij", fields.directions[used], normals[0])
    albedo = skin.albedo[0]
    irradiance = diffuse_irradiance(visibility, bounce, cosines, albedo, weights[used])
    radiance = albedo * scatter(irradiance[None], skin.scattering_texels)[0]
    bright = power.topk(min(_HIGHLIGHTS, len(used))).indices
    views = unit_along(camera_m.view(3, 1, 1) - fields.positions, 0)
    gloss = highlights(normals, views[None], fields.directions[bright][None], skin)[0]
    return radiance + torch.einsum("lc,lij->cij", weights[bright], gloss * fields.visibility[bright] / 255)


def _materials(around: _Surroundings, skin: Skin, generator: torch.Generator) -> Tensor:
    """Draw the albedo [N, 3] of the surroundings: mean skin colour, and random hair, cloth and frames."""
    uniform = Uniform(generator, (1,))
    side = skin.albedo.shape[-1]
    mean_skin = skin.albedo[0, :, side // 4 : side * 5 // 8, side // 4 : side * 3 // 4].mean((1, 2))
    albedo = mean_skin.expand(len(around.part), 3).clone()
    grey = (torch.rand(1, generator=generator) < 0.2).float() * uniform(0.2, 1)
    hair = hair_albedo(torch.exp(uniform(-1.5, 2.1)), uniform(0, 0.6), grey)[0]
    strands = around.part == _HAIR
    albedo[strands] = hair * uniform(0.6, 1.4, int(strands.sum()), 1)
    albedo[around.part == _CLOTH] = uniform(0.02, 0.7, 3)
    albedo[around.part == _FRAME] = uniform(0.01, 0.3, 3)
    return albedo


def _diffuse_radiance(around: _Surroundings, directions: Tensor, weights: Tensor, albedo: Tensor) -> Tensor:
    """Radiance [N, 3] of matte surfaces under lights [L, 3], without shadows; hair is lit more evenly."""
    irradiance = _harmonics(around.normals) @ (_LAMBERT[:, None] * (_harmonics(directions).T @ weights))
    ambient = weights.sum(0) / 4
    irradiance = torch.where((around.part == _HAIR)[:, None], 0.6 * irradiance + 0.4 * ambient, irradiance)
    low = ((_UNDER_CHIN_M - around.vertices[:, 1]) / 0.03).clamp(0, 1) * (around.part == _SKIN)
    shade = _OPEN_SHADE * (1 - low * (1 - _UNDER_CHIN_SHADE))
    return albedo * irradiance.clamp_min(0) * shade[:, None]


def _harmonics(directions: Tensor) -> Tensor:
    """Real spherical harmonics up to degree 2 [N, 9]; `_LAMBERT` holds their constants."""
    x, y, z = directions.unbind(-1)
    second = (x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y)
    return torch.stack([torch.ones_like(x), y, z, x, *second], -1)
