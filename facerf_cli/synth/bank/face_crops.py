"""Images of the bank's heads, and crops of them to train the Geometry Network, with the fit to find in each.

A baked face, with random skin and light, is photographed as in `heads.py`. Skull, ears, neck, hair, clothes
and glasses around it have simple shading without shadows. The background stays transparent.

For every sample a stored image is mirrored or not, rotated, shifted and scaled in the crop. A background and
sometimes an occluder are added, and a camera model degrades the result. The pose follows every move.
"""

import math
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor

from facerf_cli.face.fit import fit_batch
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import GRID, MIRROR_68, grid_uv
from facerf_cli.network.inputs import Batch
from facerf_cli.raster.camera import Camera, crop_camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture
from facerf_cli.synth.appearance.people import hair_albedo
from facerf_cli.synth.appearance.skin import draw_skin
from facerf_cli.synth.bank import Files, file_of, files_in, fill, split_heads
from facerf_cli.synth.bank.heads import HeadPhoto, ViewSettings, landmarks_of, photograph_head
from facerf_cli.synth.bank.texture_samples import HeadFields, draw_light, head_fields
from facerf_cli.synth.camera import Similarity, SimulatedCamera, background, occluder, recoloured, resample
from facerf_cli.synth.head.body import draw_body
from facerf_cli.synth.head.glasses import draw_glasses
from facerf_cli.synth.head.hair import draw_hair
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, joined
from facerf_cli.synth.head.shell import shell_head
from facerf_cli.synth.random_fields import Random, Uniform, generators
from facerf_cli.synth.shading import Skin, diffuse_irradiance, highlights, scatter, tilt_normals, unit_along

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
    heads: Path, folder: Path, count: int, jobs: int, seed: int, settings: ImageSettings = ImageSettings()
) -> None:
    """Write `count` images of every baked head in `heads` to `folder`; keep finished heads."""
    people = [int(path.stem) for path in files_in(heads, "no baked heads; run `facerf train` to bake them")]
    fill(folder, partial(_imaged, heads, count, seed, settings), people, jobs)


def _imaged(heads: Path, count: int, seed: int, settings: ImageSettings, index: int) -> Files:
    name = f"{index:05d}"
    return {name: image_head(load_file(file_of(heads, name)), count, seed, index, settings)}


@torch.no_grad()
def image_head(
    head: dict[str, Tensor], count: int, seed: int, index: int, settings: ImageSettings
) -> dict[str, Tensor]:
    """Render `count` images of one baked head, and fit the built-in model to their true landmarks.

    Returns pictures [W, 4, S, S] in bytes: the square root of radiance over `BRIGHTEST` times the mean of the
    face, and cover; S is crop_px + 2 margin_px. landmarks_px [W, 68, 2] in the crop. Of the fit, through the
    crop camera: rotation [W, 3, 3], translation_m [W, 3], alpha [W, Ki], beta [W, Ke].
    """
    random, generator = generators(seed, index, 2)
    fields, vertices = head_fields(head), head["vertices"]
    around = _surroundings(vertices, random)
    photos = [photograph_head(vertices, random, settings.views) for _ in range(count)]
    shifts_m = [(photo.vertices_camera - vertices @ photo.rotation.T).mean(0) for photo in photos]
    images = [
        _image(fields, around, photo, shift_m, settings, generator)
        for photo, shift_m in zip(photos, shifts_m, strict=True)
    ]
    landmarks_px = torch.stack([project(photo.true_landmarks(), photo.camera) for photo in photos])
    fit = fit_batch(load_face_model(), landmarks_px, crop_camera(settings.crop_px))
    found = {name: getattr(fit, name).float() for name in ("rotation", "translation_m", "alpha", "beta")}
    return {"pictures": torch.stack(images), "landmarks_px": landmarks_px, **found}


@dataclass(frozen=True)
class _Surroundings:
    """Mesh of everything around the face, head frame."""

    vertices: Tensor  # [N, 3]
    normals: Tensor  # [N, 3]
    triangles: Tensor  # [F, 3]
    part: Tensor  # [N] index into PARTS; scalp under hair counts as hair


def _surroundings(vertices: Tensor, random: Random) -> _Surroundings:
    """Draw clothes, hair and glasses for a head, and keep what is visible outside the face."""
    bare = shell_head(vertices, (0.0, 0.0), 0)
    landmarks_m = landmarks_of(vertices).numpy()
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
    lens, margin_px = photo.camera, settings.margin_px
    side_px = lens.width_px + 2 * margin_px
    wider = Camera(lens.focal_px, side_px, side_px, lens.cx_px + margin_px, lens.cy_px + margin_px)
    fragments = rasterize(vertices, triangles, wider)
    face_attributes = F.pad(torch.cat([grid_uv()[coarse], torch.ones(len(coarse), 1)], 1), (0, 3))
    attributes = torch.cat([face_attributes, F.pad(colours, (3, 0))])
    pixels = interpolate(attributes, triangles, fragments)  # u, v, is face, colour around the face
    is_face = pixels[..., 2:3] > 0.5
    image = torch.where(is_face, sample_texture(texture, pixels[..., :2]), pixels[..., 3:])
    exposure = texture.mean() * BRIGHTEST
    covered = fragments.covered[..., None].float()
    stored = torch.cat([(image / exposure).clamp(0, 1).sqrt() * covered, covered], -1)
    return (stored * 255).round().byte().permute(2, 0, 1).contiguous()


def _coarse_grid() -> tuple[Tensor, Tensor]:
    """Vertex ids [v] of every `_COARSE`-th row and column of the face grid, and their triangles [f, 3]."""
    ids = torch.arange(GRID * GRID).view(GRID, GRID)[::_COARSE, ::_COARSE]
    new = torch.arange(ids.numel()).view(ids.shape)
    a, b, c, d = (x.reshape(-1) for x in (new[:-1, :-1], new[:-1, 1:], new[1:, :-1], new[1:, 1:]))
    return ids.reshape(-1), torch.cat([torch.stack([a, c, d], -1), torch.stack([a, d, b], -1)])


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


_IMAGES = ImageSettings()
_OCCLUDED, _TURNED = 0.3, 0.5  # fractions of samples
_NEAREST_OCCLUDER = 0.3  # distance from the crop's middle, in sides
_CAMERA = SimulatedCamera(0.2, curve=0.3)
_TURN_DEG = 15.0  # largest turn
# Standard deviations of the shift to the right and down (sides) and of log scale: a crop is cut around a
# detector's box, see `dataset/crops.py`.
_SHIFT, _SCALE = (0.1, 0.03), 0.07


@dataclass(frozen=True)
class FaceCrops(Batch):
    """Crops of B faces as a camera gives them, and the fit that the network should find in them."""

    crops: Tensor  # [B, 3, S, S]
    landmarks_px: Tensor  # [B, 68, 2] true positions, also of hidden ones
    rotation: Tensor  # [B, 3, 3] head_to_camera
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki] of the built-in model
    beta: Tensor  # [B, Ke]


class RenderedFaces:
    """Images of the bank's heads, held in memory as bytes, from which crops are drawn."""

    def __init__(
        self,
        folder: Path,
        backgrounds: Tensor,
        provenance: dict[str, Any],
        settings: ImageSettings = _IMAGES,
    ) -> None:
        paths = files_in(folder, "no images of heads; make them with `facerf train --stage geometry`")
        self.backgrounds, self.provenance = backgrounds, provenance
        self.settings = settings
        self.images = [load_file(path) for path in paths]

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """See `split_heads`."""
        return split_heads(len(self.images), held_out)

    def mean_translation_m(self) -> tuple[float, float, float]:
        """Mean translation of all images, the starting point of the network."""
        x, y, z = torch.cat([head["translation_m"] for head in self.images]).mean(0).tolist()
        return x, y, z

    def draw(self, head: int, side: int, generator: torch.Generator) -> FaceCrops:
        """Draw one crop of a head, [1, 3, side, side], with its fit."""
        images = self.images[head]
        index = int(torch.randint(len(images["pictures"]), (), generator=generator))
        stored = {name: tensor[index] for name, tensor in images.items()}
        if torch.rand((), generator=generator) < 0.5:
            stored = _mirrored(stored, self.settings.crop_px)
        crop_px, margin_px = self.settings.crop_px, self.settings.margin_px
        centre_px = torch.full((2,), crop_px / 2)
        crop = _draw_crop(centre_px, crop_px, generator)
        pixels = stored["pictures"].float() / 255
        pixels[:3] *= pixels[:3]
        person = resample(pixels, crop.positions_px(side) + margin_px, "zeros")
        image = recoloured(_composed(person, self.backgrounds, generator), _CAMERA.colours(generator))
        rotation, translation_m = crop.pose(centre_px, crop_px, stored["rotation"], stored["translation_m"])
        return FaceCrops(
            _CAMERA.take(image, image.mean(), generator)[None],
            side * crop.in_crop(stored["landmarks_px"])[None],
            rotation[None],
            translation_m[None],
            stored["alpha"][None],
            stored["beta"][None],
        )


def _mirrored(stored: dict[str, Tensor], crop_px: int) -> dict[str, Tensor]:
    """Mirror a stored image and its fit."""
    flip = torch.tensor([-1.0, 1.0, 1.0])
    to_alpha, to_beta = _mirrored_coefficients()
    landmarks_px = stored["landmarks_px"][torch.from_numpy(MIRROR_68)] * flip[:2]
    return {
        "pictures": stored["pictures"].flip(-1),
        "landmarks_px": landmarks_px + torch.tensor([float(crop_px), 0.0]),
        "rotation": flip[:, None] * stored["rotation"] * flip,
        "translation_m": flip * stored["translation_m"],
        "alpha": stored["alpha"] @ to_alpha,
        "beta": stored["beta"] @ to_beta,
    }


@cache  # two pseudoinverses
def _mirrored_coefficients() -> tuple[Tensor, Tensor]:
    """Matrices [Ki, Ki] and [Ke, Ke] from the built-in model's coefficients to those of the mirrored face."""
    model = load_face_model()
    maps = []
    for basis in (model.identity, model.expression):
        mirrored = basis.view(-1, GRID, GRID, 3).flip(2) * torch.tensor([-1.0, 1.0, 1.0])
        flat, image = basis.flatten(1).double(), mirrored.flatten(1).double()
        maps.append((image @ flat.T @ torch.linalg.pinv(flat @ flat.T)).float())
    return maps[0], maps[1]


def _draw_crop(centre_px: Tensor, side_px: float, generator: torch.Generator) -> Similarity:
    """Draw a crop around the place of another, as detectors cut it."""
    turns = torch.rand((), generator=generator) < _TURNED
    turn_deg = float(Uniform(generator)(-_TURN_DEG, _TURN_DEG)) * bool(turns)
    scale = math.exp(_SCALE * float(torch.randn((), generator=generator).clamp(-2, 2)))
    shift = torch.tensor(_SHIFT) * torch.randn(2, generator=generator).clamp(-2, 2)
    return Similarity.around(centre_px, side_px / scale, turn_deg, shift)


def _composed(crop: Tensor, backgrounds: Tensor, generator: torch.Generator) -> Tensor:
    """Composite a crop [4, S, S] over a background, and sometimes under an occluder: [3, S, S]."""
    side = crop.shape[-1]
    image = crop[:3] + (1 - crop[3:]) * background(backgrounds, side, generator)
    if torch.rand((), generator=generator) < _OCCLUDED:
        other = background(backgrounds, side, generator)
        image = image + occluder(side, generator, _NEAREST_OCCLUDER) * (other - image)
    return image
