"""Pictures of the bank's heads for the Geometry Network, with what its fit should find in each.

The baked face, under a skin and lights drawn anew for every picture, is seen by the cameras of `stage.views`
and cropped by landmarks as noisy as a detector's. What a photograph shows around a face stands around it:
skull, ears and neck, hair, clothes, glasses, lit plainly and without shadows. The background is left open.

Training crops for the Geometry Network: the bank's pictures as photographs, drawn anew for every sample.

A stored picture (`stage.face_pictures`) is mirrored or not, turned, shifted and scaled in the crop; a
background comes behind it and something may hide a part of it; then a camera takes it, as careless as
photographers are. The pose that belongs to the crop follows every move.
"""

import math
from dataclasses import dataclass, fields
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.fit import fit_batch
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import GRID, MIRROR_68, grid_uv, landmark_weights
from facerf_cli.files.atomic import atomic_path
from facerf_cli.raster.camera import CROP_FOCAL_PER_SIDE, PIXEL_CENTRE, Camera, crop_camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture
from facerf_cli.synth.appearance.pigments import hair_albedo
from facerf_cli.synth.appearance.skin import Skin, draw_skin
from facerf_cli.synth.head.clothes import draw_clothes
from facerf_cli.synth.head.glasses import draw_glasses
from facerf_cli.synth.head.hair import draw_hair
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, joined
from facerf_cli.synth.head.shell import shell_head
from facerf_cli.synth.heads_bank import geometry_of
from facerf_cli.synth.random_fields import Uniform
from facerf_cli.synth.shading import bend, diffuse_irradiance, highlights, scatter, unit
from facerf_cli.synth.texture_samples import Geometry, draw_light
from facerf_cli.synth.views import Shot, ViewSettings, photograph_head
from facerf_cli.workers import in_shards

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
class ImageSettings:
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
    settings: ImageSettings = ImageSettings(),
) -> None:
    """Write `count` pictures of every baked head in `heads` to `folder`; finished heads are kept."""
    found = sorted(heads.glob("*.safetensors"))
    if not found:
        raise InputError(f"{heads}: no baked heads; let `facerf train` bake them")
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
    images = torch.stack(
        [_image(geometry, around, shot, _translation(vertices, shot), settings, generator) for shot in shots]
    )
    landmarks_px = torch.stack([_true_landmarks(shot) for shot in shots])
    fit = fit_batch(load_face_model(), landmarks_px, crop_camera(settings.crop_px))
    found = {name: getattr(fit, name).float() for name in ("rotation", "translation_m", "alpha", "beta")}
    return {"pictures": images, "landmarks_px": landmarks_px, **found}


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


def _image(
    geometry: Geometry,
    around: _Surroundings,
    shot: Shot,
    translation_m: Tensor,
    settings: ImageSettings,
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
    image = torch.where(face, sample_texture(texture, seen[..., :2]), seen[..., 3:])
    exposure = texture.mean() * BRIGHTEST
    covered = fragments.covered[..., None].float()
    stored = torch.cat([(image / exposure).clamp(0, 1).sqrt() * covered, covered], -1)
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


_IMAGES = ImageSettings()
_FACE_DEPTH_M = 0.11  # of the face before the head frame's origin
_OCCLUDED, _GREY, _TURNED = 0.3, 0.25, 0.5  # shares of samples
_TURN_DEG, _SHIFT, _SCALE = 15.0, 0.02, 0.04  # shift as a share of the crop's side, scale of the logarithm


@dataclass(frozen=True)
class FaceCrops:
    """Crops of B faces, scene-linear at any exposure, with the fit that should be found in them."""

    crops: Tensor  # [B, 3, S, S]
    landmarks_px: Tensor  # [B, 68, 2], the true ones, also where they are hidden
    rotation: Tensor  # [B, 3, 3] head_to_camera
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki] of the built-in model
    beta: Tensor  # [B, Ke]

    def to(self, device: torch.device) -> "FaceCrops":
        """The same crops on `device`."""
        return FaceCrops(*(getattr(self, field.name).to(device) for field in fields(self)))


class RenderedFaces:
    """The pictures of a bank's heads, held in memory as bytes, from which crops are drawn."""

    def __init__(
        self,
        folder: Path,
        provenance: dict[str, Any],
        settings: ImageSettings = _IMAGES,
    ) -> None:
        paths = sorted(folder.glob("*.safetensors"))
        if not paths:
            raise InputError(f"{folder}: no pictures of heads; let `facerf train --stage geometry` make them")
        self.provenance = provenance
        self.settings = settings
        self.images = [load_file(path) for path in paths]

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Indices of the heads to train on, and of the first `held_out` after the mean face."""
        return torch.arange(held_out + 1, len(self.images)), torch.arange(1, held_out + 1)

    def mean_translation_m(self) -> tuple[float, float, float]:
        """Mean translation of all heads, where the network starts from."""
        x, y, z = torch.cat([head["translation_m"] for head in self.images]).mean(0).tolist()
        return x, y, z

    def draw(self, head: int, side: int, generator: torch.Generator) -> FaceCrops:
        """One crop of a head, of that many pixels along each side."""
        stored = self.images[head]
        index = int(torch.randint(len(stored["pictures"]), (), generator=generator))
        own = {name: tensor[index] for name, tensor in stored.items()}
        if torch.rand((), generator=generator) < 0.5:
            own = _mirrored(own, self.settings.crop_px)
        move = _Move.draw(generator)
        crop = move.image(own["pictures"], side, self.settings)
        rotation, translation_m = move.pose(own["rotation"], own["translation_m"])
        return FaceCrops(
            _photographed(_composed(crop, generator), generator)[None],
            side * move.points(own["landmarks_px"] / self.settings.crop_px)[None],
            rotation[None],
            translation_m[None],
            own["alpha"][None],
            own["beta"][None],
        )


def _mirrored(own: dict[str, Tensor], crop_px: int) -> dict[str, Tensor]:
    """The same head seen in a mirror."""
    flip = torch.tensor([-1.0, 1.0, 1.0])
    by_alpha, by_beta = _mirrored_coefficients()
    landmarks_px = own["landmarks_px"][torch.from_numpy(MIRROR_68)] * flip[:2]
    return {
        "pictures": own["pictures"].flip(-1),
        "landmarks_px": landmarks_px + torch.tensor([float(crop_px), 0.0]),
        "rotation": flip[:, None] * own["rotation"] * flip,
        "translation_m": flip * own["translation_m"],
        "alpha": own["alpha"] @ by_alpha,
        "beta": own["beta"] @ by_beta,
    }


@cache
def _mirrored_coefficients() -> tuple[Tensor, Tensor]:
    """[Ki, Ki] and [Ke, Ke] that turn the built-in model's coefficients into those of the mirror image."""
    model = load_face_model()
    maps = []
    for basis in (model.identity, model.expression):
        mirrored = basis.view(-1, GRID, GRID, 3).flip(2) * torch.tensor([-1.0, 1.0, 1.0])
        flat, image = basis.flatten(1).double(), mirrored.flatten(1).double()
        maps.append((image @ flat.T @ torch.linalg.pinv(flat @ flat.T)).float())
    return maps[0], maps[1]


@dataclass(frozen=True)
class _Move:
    """A turn about the crop's middle, then a scale and a shift in units of its side."""

    angle: float  # radians, counter-clockwise on screen
    scale: float
    shift: Tensor  # [2], to the right and down

    @staticmethod
    def draw(generator: torch.Generator) -> "_Move":
        turned = bool(torch.rand((), generator=generator) < _TURNED)
        angle = math.radians(_TURN_DEG) * (2 * float(torch.rand((), generator=generator)) - 1) * turned
        scale = math.exp(_SCALE * float(torch.randn((), generator=generator).clamp(-2, 2)))
        return _Move(angle, scale, _SHIFT * torch.randn(2, generator=generator).clamp(-2, 2))

    def _matrix(self) -> Tensor:
        """[2, 2] on (right, down)."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        return self.scale * torch.tensor([[cos, sin], [-sin, cos]])

    def points(self, share: Tensor) -> Tensor:
        """Where points [N, 2], as shares of the crop's side, go."""
        return (share - 0.5) @ self._matrix().T + 0.5 + self.shift

    def image(self, stored: Tensor, side: int, settings: ImageSettings) -> Tensor:
        """The moved crop [4, side, side] of a stored picture [4, P, P]: linear colour and cover."""
        centre = (torch.arange(side) + PIXEL_CENTRE) / side
        y, x = torch.meshgrid(centre, centre, indexing="ij")
        source = (torch.stack([x, y], -1) - 0.5 - self.shift) @ torch.linalg.inv(self._matrix()).T + 0.5
        whole_px = settings.crop_px + 2 * settings.margin_px
        grid = 2 * (source * settings.crop_px + settings.margin_px) / whole_px - 1
        linear = stored.float() / 255
        linear[:3] *= linear[:3]
        return F.grid_sample(linear[None], grid[None], align_corners=False)[0]

    def pose(self, rotation: Tensor, translation_m: Tensor) -> tuple[Tensor, Tensor]:
        """The pose in the crop camera after the move; shift and scale as they act on the face's own depth."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        turn = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
        turned = turn @ translation_m
        before_m = -turned[2] - _FACE_DEPTH_M
        after_m = before_m / self.scale
        offset_m = self.shift * torch.tensor([1.0, -1.0]) * after_m / CROP_FOCAL_PER_SIDE
        return turn @ rotation, torch.cat([turned[:2] + offset_m, -(after_m + _FACE_DEPTH_M)[None]])


def _composed(crop: Tensor, generator: torch.Generator) -> Tensor:
    """A crop [4, S, S] before a random background, and in some behind a random thing: [3, S, S]."""
    side = crop.shape[-1]
    image = crop[:3] + (1 - crop[3:]) * _texture(side, generator)
    if torch.rand((), generator=generator) < _OCCLUDED:
        hidden = _patch(side, generator)
        image = image + hidden * (_texture(side, generator) - image)
    return image


def _texture(side: int, generator: torch.Generator) -> Tensor:
    """Random colours [3, S, S]: even, or blotches and strokes of a random size, or with straight edges."""
    uniform = Uniform(generator)
    colour = torch.exp(uniform(-4.5, -0.5) + 0.35 * torch.randn(3, 1, 1, generator=generator))
    cells = torch.randint(2, 40, (2,), generator=generator).tolist()
    contrast = uniform(0, 1) ** 2 * 1.2
    grey = torch.randn(1, 1, *cells, generator=generator) + 0.4 * torch.randn(
        1, 3, *cells, generator=generator
    )
    hard = bool(torch.rand((), generator=generator) < 0.3)
    field = (
        F.interpolate(grey, (side, side), mode="nearest")
        if hard
        else F.interpolate(grey, (side, side), mode="bilinear", align_corners=False)
    )
    return colour * torch.exp(contrast * field[0])


def _patch(side: int, generator: torch.Generator) -> Tensor:
    """Cover [1, S, S] by an ellipse that lies mostly toward the crop's border."""
    uniform = Uniform(generator)
    angle, distance = uniform(0, 2 * math.pi), uniform(0.3, 0.6)
    centre = 0.5 + distance * torch.stack([angle.cos(), angle.sin()])
    radii, tilt = uniform(0.06, 0.22, 2), uniform(0, math.pi)
    along = (torch.arange(side) + PIXEL_CENTRE) / side
    y, x = torch.meshgrid(along - centre[1], along - centre[0], indexing="ij")
    a, b = x * tilt.cos() + y * tilt.sin(), y * tilt.cos() - x * tilt.sin()
    return ((1 - (a / radii[0]) ** 2 - (b / radii[1]) ** 2) * 8 + 0.5).clamp(0, 1)[None]


def _photographed(image: Tensor, generator: torch.Generator) -> Tensor:
    """What a camera makes of a linear picture [3, S, S]: colour cast, clipping, blur, tone curve, noise."""
    uniform = Uniform(generator)
    image = image * torch.exp(uniform(-0.2, 0.2, 3, 1, 1))
    if torch.rand((), generator=generator) < _GREY:
        image = image.mean(0, keepdim=True).expand(3, -1, -1)
    clip = uniform(1.6, 6.0) * image.mean().clamp_min(1e-4)
    image = (image / clip).clamp(0, 1)
    image = _blurred(image, float(uniform(0, 1.3))) ** torch.exp(uniform(-0.3, 0.3))
    noise = torch.randn(image.shape, generator=generator) * uniform(0, 0.04) ** 1.2
    return (image + noise * (image + 0.02).sqrt()).clamp(0, 1)


def _blurred(image: Tensor, sigma_px: float) -> Tensor:
    """A picture [3, S, S] under a Gaussian; as two products, which is quickest at this size."""
    at = torch.arange(image.shape[-1])
    kernel = torch.exp(-0.5 * ((at[:, None] - at) / max(sigma_px, 0.05)) ** 2)
    kernel = kernel / kernel.sum(1, keepdim=True)
    return kernel @ image @ kernel.T
