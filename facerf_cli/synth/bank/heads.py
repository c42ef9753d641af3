"""Bank of baked heads: light transport in UV space, views as fits to photos see them, and their samples.

Noisy landmarks set the crop and the fit of each photo, like in real ones. Unwrapping an image of the true
(u, v) then gives the warp: the true texel that each texel of the fitted UV map shows.
"""

import re
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file
from scipy.spatial.transform import Rotation
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import from_landmarks
from facerf_cli.face.fit import fit_batch
from facerf_cli.face.morphable import BUILTIN, MorphableModel, load_face_model
from facerf_cli.face.topology import (
    CONTOUR,
    GRID,
    OUTER_EYE_CORNERS,
    grid_triangles,
    grid_uv,
    landmark_weights,
)
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings, bake_transport
from facerf_cli.raster.camera import Camera, crop_camera, pose_to_rotation, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import bake_attributes, inpaint, normal_map, texel_centres_uv, unwrap
from facerf_cli.synth.bank import Files, file_of, files_in, fill
from facerf_cli.synth.bank.texture_samples import HeadFields, Sample, draw_sample, head_fields
from facerf_cli.synth.random_fields import Random

# Expression shapes that are never drawn: they do not move skin, or correct another shape.
_LEFT_OUT = ("PupilDilate", "mouthClose", "eyeLook")
_COMMON = ("jawOpen", "jaw_open", "mouthSmile", "smile")  # drawn more often, since photos show them often
_SIDE = re.compile(r"(?<!jaw)_(L|R|left|right)$")  # paired shapes; the jaw moves to one side only
_BAKE = BakeSettings(light_samples=4, bounce_samples=16)
cached_face_model = lru_cache(maxsize=2)(load_face_model)  # a worker loads a model once
_PHOTO_SIDE_PX = 1000
_FACE_SIDE_M = 0.26  # approximate side of the square of a crop, at the face
_FOCALS = (1.6, 6.0)  # range of focal lengths, in sides of the photo
_FACE_SHARES = (0.3, 0.8)  # range of the side of the crop, in sides of the photo
_LEAST_COVER = 0.9  # share of a texel that must show the face to be visible
# Landmarks of contour, brows, nose, eyes and mouth, whose errors have a common part.
LANDMARK_GROUPS = tuple(slice(*ends) for ends in pairwise((0, 17, 22, 27, 36, 42, 48, 68)))


@dataclass(frozen=True)
class HeadBakeSettings:
    """Distribution of heads, and their bake: `side` texels, `lights` in a rig rotated at random per head."""

    side: int = 128
    lights: int = 150
    identity_std: tuple[float, float] = (0.7, 1.3)  # range of the coefficients' standard deviation
    free_std: float = 0.6  # of the built-in model's deformations, which other models may not span
    neutral_share: float = 0.35
    bake: BakeSettings = _BAKE


def bake_heads(
    folder: Path,
    face_model: str,
    count: int,
    jobs: int,
    seed: int,
    settings: HeadBakeSettings = HeadBakeSettings(),
) -> None:
    """Bake `count` heads into `folder`, from 00000 (the mean face) on; keep finished ones.

    Raises InputError for heads of another face model, which would be used under the wrong name and licence.
    """
    name = load_face_model(face_model).name
    for path in files_in(folder):
        with safe_open(path, framework="pt") as file:
            baked = (file.metadata() or {}).get("face_model")
        if baked != name:
            raise InputError(f"{path}: baked from face model {baked}, not {name}; use another --bank")
    fill(folder, partial(_baked, face_model, seed, settings), range(count), jobs, {"face_model": name})


def _baked(face_model: str, seed: int, settings: HeadBakeSettings, index: int) -> Files:
    return {f"{index:05d}": bake_head(cached_face_model(face_model), index, seed, settings)}


def bake_head(model: MorphableModel, index: int, seed: int, settings: HeadBakeSettings) -> dict[str, Tensor]:
    """Bake head number `index`, a function of (model, index, seed, settings); head 0 is the mean face.

    Returns vertices [V, 3] (m, head frame), directions [L, 3], and visibility and bounce [L, T, T] in bytes;
    bounce is stored as its square root times 255.
    """
    random = np.random.default_rng([seed, index])
    alpha, beta = draw_coefficients(model, random, settings) if index else mean_coefficients(model)
    vertices = model.vertices(alpha[None], beta[None])[0]
    if index:
        basis = load_face_model(BUILTIN).identity  # a Gaussian process of smooth deformations
        weights = torch.from_numpy(random.normal(0, settings.free_std, len(basis))).float()
        vertices = vertices + torch.einsum("k,kvc->vc", weights, basis)
    triangles = grid_triangles()
    positions = bake_attributes(vertices, GRID, settings.side).permute(1, 2, 0).numpy()
    normals = normal_map(vertices, triangles, settings.side).permute(1, 2, 0).numpy()
    turn = Rotation.random(random_state=random).as_matrix() if index else np.eye(3)
    directions = np.asarray(rig_directions(settings.lights)) @ turn.T
    transport = bake_transport(
        positions,
        normals,
        vertices.numpy(),
        triangles.numpy(),
        directions,
        settings.bake,
        int(random.integers(1 << 31)),
    )
    return {
        "vertices": vertices.contiguous(),
        "directions": torch.from_numpy(directions).float(),
        "visibility": _bytes(transport.visibility),
        "bounce": _bytes(np.sqrt(transport.bounce)),
    }


def _bytes(values: np.ndarray) -> Tensor:
    return torch.from_numpy((np.clip(values, 0, 1) * 255).round().astype(np.uint8))


def mean_coefficients(model: MorphableModel) -> tuple[Tensor, Tensor]:
    """Coefficients alpha [Ki] and beta [Ke] of the mean face."""
    return torch.zeros(len(model.identity)), torch.zeros(len(model.expression))


def draw_coefficients(
    model: MorphableModel, random: Random, settings: HeadBakeSettings
) -> tuple[Tensor, Tensor]:
    """Draw an identity alpha [Ki] and an expression beta [Ke] of a few shapes, nearly equal on both sides."""
    spread = random.uniform(*settings.identity_std)
    alpha = torch.from_numpy(random.normal(0, spread, len(model.identity))).float()
    beta = torch.zeros(len(model.expression))
    if random.random() < settings.neutral_share:
        return alpha, beta
    names = [name for name in model.expression_names if not name.startswith(_LEFT_OUT)]
    stems = sorted({_SIDE.sub("", name) for name in names})
    chosen = list(random.choice(stems, random.integers(1, 4), replace=False))
    chosen += [stem for stem in _COMMON if stem in stems and random.random() < 0.4]
    for stem in chosen:
        strength = random.uniform(0.1, 1.6) if stem in _COMMON[:2] else random.uniform(0.2, 2.8)
        for index, name in enumerate(model.expression_names):
            if _SIDE.sub("", name) == stem:
                beta[index] = strength * random.uniform(0.7, 1.0)
    return alpha, beta


@dataclass(frozen=True)
class ViewSettings:
    """Standard deviations of the pose, and of landmark errors in units of the inter-ocular distance."""

    crop_px: int = 256
    yaw_deg: float = 20.0
    pitch_deg: float = 9.0
    roll_deg: float = 7.0
    frontal_share: float = 0.45
    limit_deg: float = 48.0
    point_noise: float = 0.014
    group_noise: float = 0.012
    contour_noise: float = 0.03


def build_views(
    vertices: Tensor,
    fitted_with: MorphableModel,
    count: int,
    side: int,
    seed: int,
    settings: ViewSettings = ViewSettings(),
) -> dict[str, Tensor]:
    """Photograph one head [V, 3] (head frame) `count` times, and fit the photos with a face model.

    Returns rotation [W, 3, 3], the true head_to_camera; warp [W, 2, T, T] half, the true (u, v) of every
    fitted texel; visible [W, T, T] bytes; normals [W, 3, T, T] half, of the fit, camera space.
    """
    random = np.random.default_rng([seed, 1])
    photos = [photograph_head(vertices, random, settings) for _ in range(count)]
    landmarks = torch.stack([photo.landmarks_px for photo in photos])
    fits = fit_batch(fitted_with, landmarks, crop_camera(settings.crop_px))
    triangles, identity = grid_triangles(), texel_centres_uv(side).permute(2, 0, 1)
    views = []
    for photo, fitted_camera in zip(photos, fits.vertices(fitted_with).float(), strict=True):
        image, camera = _uv_image(photo), crop_camera(settings.crop_px)
        texture, visible = unwrap(image, fitted_camera, triangles, camera, side)
        on_face = texture[2].clamp_min(1e-6)
        seen = visible * (texture[2] > _LEAST_COVER)
        offset = (texture[:2] / on_face - identity) * (seen > 0)
        warp = identity + inpaint(offset, (seen > 0.3).float())  # invisible texels move as their neighbours
        views.append(
            {
                "rotation": photo.rotation,
                "warp": warp.half(),
                "visible": (seen * 255).round().byte(),
                "normals": normal_map(fitted_camera, triangles, side).half(),
            }
        )
    return {name: torch.stack([view[name] for view in views]) for name in views[0]}


@dataclass(frozen=True)
class HeadPhoto:
    """Head in front of a camera, cropped by noisy landmarks."""

    vertices_camera: Tensor  # [V, 3]
    rotation: Tensor  # [3, 3] head_to_camera
    camera: Camera  # of the crop, with the true focal length and principal point
    landmarks_px: Tensor  # [68, 2] in the crop, with the errors of a detector


def photograph_head(vertices: Tensor, random: Random, settings: ViewSettings) -> HeadPhoto:
    """Take one random photo of a head [V, 3] (head frame)."""
    frontal = random.random() < settings.frontal_share
    spread = np.array([settings.yaw_deg, settings.pitch_deg, settings.roll_deg]) * (0.3 if frontal else 1.0)
    pose = np.clip(random.normal(0, spread), -settings.limit_deg, settings.limit_deg)
    rotation = pose_to_rotation(*(float(angle) for angle in pose))
    focal_px = _PHOTO_SIDE_PX * float(np.exp(random.uniform(*np.log(_FOCALS))))
    side_px = _PHOTO_SIDE_PX * random.uniform(*_FACE_SHARES)
    distance_m = focal_px * _FACE_SIDE_M / side_px
    centre_m = torch.tensor(
        [*(random.uniform(-0.1, 0.1, 2) * distance_m * _PHOTO_SIDE_PX / focal_px), -distance_m]
    )
    vertices_camera = vertices @ rotation.T + centre_m.float()
    photo = Camera(focal_px, _PHOTO_SIDE_PX, _PHOTO_SIDE_PX, _PHOTO_SIDE_PX / 2, _PHOTO_SIDE_PX / 2)
    corners, weights = landmark_weights()
    landmarks = (vertices_camera[corners] * weights[..., None]).sum(1)
    landmarks_px = _detected(project(landmarks, photo), random, settings)
    crop = from_landmarks(landmarks_px.numpy(), settings.crop_px)
    scale = crop.size_px / crop.side_px
    camera = Camera(
        focal_px * scale,
        crop.size_px,
        crop.size_px,
        (photo.cx_px - crop.x0_px) * scale,
        (photo.cy_px - crop.y0_px) * scale,
    )
    in_crop = torch.as_tensor(crop.to_crop(landmarks_px.numpy()), dtype=torch.float32)
    return HeadPhoto(vertices_camera, rotation, camera, in_crop)


def _detected(landmarks_px: Tensor, random: Random, settings: ViewSettings) -> Tensor:
    """Add the errors of a detector to landmarks [68, 2]: one per point, and one per part of the face."""
    eyes = landmarks_px[list(OUTER_EYE_CORNERS)]
    unit_px = float((eyes[0] - eyes[1]).norm())
    error = random.normal(0, settings.point_noise, (68, 2))
    for group in LANDMARK_GROUPS:
        error[group] += random.normal(0, settings.group_noise, 2)
    error[list(CONTOUR)] += random.normal(0, settings.contour_noise, (len(CONTOUR), 2))
    return landmarks_px + torch.from_numpy(error).float() * unit_px


def _uv_image(photo: HeadPhoto) -> Tensor:
    """Render (u, v, 1) of the true surface [3, H, W], zero off the face."""
    triangles = grid_triangles()
    fragments = rasterize(photo.vertices_camera, triangles, photo.camera)
    attributes = torch.cat([grid_uv(), torch.ones(GRID * GRID, 1)], -1)
    image = interpolate(attributes, triangles, fragments) * fragments.covered[..., None]
    return image.permute(2, 0, 1)


@dataclass(frozen=True)
class Bank:
    """Baked heads and their views, a `SampleSource`; head 0 is the mean face."""

    baked: list[HeadFields]
    views: list[dict[str, Tensor]]  # from `build_views`
    provenance: dict[str, Any]

    @property
    def side(self) -> int:
        return int(self.baked[0].normals.shape[-1])

    def people(self, held_out: int) -> tuple[Tensor, Tensor]:
        """See `SampleSource`; the mean face is in neither part."""
        return torch.arange(held_out + 1, len(self.baked)), torch.arange(1, held_out + 1)

    def draw(self, people: Tensor, lights: int, generator: torch.Generator) -> Sample:
        """Draw one sample of each of the `people` [B], with `lights` target lights."""
        chosen = [(self.baked[int(person)], self.views[int(person)]) for person in people]
        return draw_sample(chosen, lights, generator)

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return head 0's normals [3, T, T], visibility [L, T, T] and light directions [L, 3], head frame."""
        mean = self.baked[0]
        return mean.normals, mean.visibility.float() / 255, mean.directions


def add_views(heads: Path, views: Path, fitted_with: str, count: int, jobs: int, seed: int) -> None:
    """Write `count` fitted views of every baked head in `heads` to `views`; keep finished ones."""
    people, fitted = [int(path.stem) for path in files_in(heads)], load_face_model(fitted_with).name
    fill(views, partial(_viewed, heads, fitted_with, count, seed), people, jobs, {"fitted_with": fitted})


def _viewed(heads: Path, fitted_with: str, count: int, seed: int, index: int) -> Files:
    name, model = f"{index:05d}", cached_face_model(fitted_with)
    head = load_file(file_of(heads, name))
    return {name: build_views(head["vertices"], model, count, head["visibility"].shape[-1], seed + index)}


def load_bank(heads: Path, views: Path, provenance: dict[str, Any]) -> Bank:
    """Load all heads that have both a bake and views; raise InputError if there are none."""
    paths = [path for path in files_in(heads) if (views / path.name).exists()]
    if not paths:
        raise InputError(f"{heads}: no baked heads with views; run `facerf train` to build them")
    return Bank(
        [head_fields(load_file(path)) for path in paths],
        [load_file(views / path.name) for path in paths],
        provenance,
    )
