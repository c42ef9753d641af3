"""Texture samples: a source and its targets under one light each, drawn from baked heads.

A head is shaded on its own UV map, from its baked light transport; the warp of a fitted view then resamples
the textures to the UV map of the fit, which misses the head by the errors of the fit. The face mesh, one
smooth sheet over lids and eyes, casts no shadows of lids and lashes on open eyes: they are added here.
Fringes and glasses are dark matte surfaces on the face: a texture cannot show their distance from it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.topology import GRID, UV_SIZE_MM, grid_triangles
from facerf_cli.network.batch import Batch
from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.raster.texture import bake_attributes, inpaint, normal_map, texel_centres_uv
from facerf_cli.synth.appearance.skin import draw_skin
from facerf_cli.synth.camera import SimulatedCamera, recoloured
from facerf_cli.synth.random_fields import LANDMARK_MM, Uniform, Window, mask, noise, places_mm, smooth
from facerf_cli.synth.shading import Skin, diffuse_irradiance, highlights, scatter, tilt_normals, unit_along

TEXTURE_CAMERA = SimulatedCamera(white=(1.95, 6.5), blur_px=1.85, noise=0.025)
_FLASH_SHARE = 0.2  # share of draws that are lit by a flash near the camera
_LIDS_MM, _LASHES_MM = 3.0, 7.0  # distance from the eye
_LASHES_PASS = 0.6  # share of light that passes between them
_GRAZING = 0.15  # least z of a light direction: bounds the length of a shadow
_FRINGES, _GLASSES = 0.15, 0.08  # share of faces with each
_BROW_MM = float(LANDMARK_MM[17:27, 1].mean())
_EYE_MM = (float(abs(LANDMARK_MM[36:48, 0]).mean()), float(LANDMARK_MM[36:48, 1].mean()))
_SAME_POSE_SHARE = 0.6  # share of samples whose target pose is the source pose
_SOURCE_HIGHLIGHTS = 10  # only the brightest lights of the source have highlights
_LEAST_POWER = 0.004  # lights of the source below this share of the brightest are skipped
_LEAST_FACING = 0.1  # cosine to the camera below which a texel has no weight in the loss
_VIEW_DISTANCE_M = 1.2  # distance of the crop camera from the face


@dataclass(frozen=True)
class Sample(Batch):
    """Textures of B faces with L target lights each, on the UV map of the fitted mesh, of equal exposure.

    Normals and lights are in camera space, of the source or of the target pose.
    """

    source: Tensor  # [B, 3, T, T], with invisible texels filled in
    visible: Tensor  # [B, 1, T, T]
    normals_source: Tensor  # [B, 3, T, T] of the fitted mesh
    normals_target: Tensor  # [B, 3, T, T]
    lights: Tensor  # [B, L, 3] directions
    target: Tensor  # [B, L, 3, T, T]
    weight: Tensor  # [B, 1, T, T] of the loss


class SampleSource(Protocol):
    """Source of training samples: the bank of baked heads, or a prepared dataset."""

    @property
    def provenance(self) -> dict[str, Any]:
        """Origin of the data, stored in the checkpoint; its 'licence' covers all of it."""

    @property
    def side(self) -> int:
        """Texels along a side of every field."""

    def people(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Indices for `draw` of the people to train on, and of at most `held_out` people to validate on."""

    def draw(self, people: Tensor, lights: int, generator: torch.Generator) -> Sample:
        """Draw one sample of each of the `people` [B], with `lights` target lights."""

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the mean's normals [3, T, T], visibility [L, T, T] and directions [L, 3], head frame."""


def draw_light(directions: Tensor, generator: torch.Generator) -> Tensor:
    """Draw weights [L, 3] of rig lights at camera-space directions [L, 3].

    A fifth of the draws are a flash near the camera; the others are one to three area lights over a dome.
    """
    uniform = Uniform(generator)
    kind = torch.rand((), generator=generator)
    if kind < _FLASH_SHARE:
        axis = F.normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.15 * torch.randn(3, generator=generator), dim=0)
        return _lobe(directions, axis, 400.0) * torch.ones(3) + 0.0015
    lobes = 1 + int(torch.randint(3, (), generator=generator))
    weights = torch.zeros(len(directions), 3)
    for lobe in range(lobes):
        axis = F.normalize(torch.randn(3, generator=generator) + torch.tensor([0.0, 0.45, 0.75]), dim=0)
        sharpness = float(torch.exp(uniform(0.3, 6.0)))
        power = 1.0 if lobe == 0 else float(torch.exp(uniform(-2.5, 0.2)))
        weights += power * _lobe(directions, axis, sharpness) * _tint(0.22, generator)
    ambient = float(torch.exp(uniform(-5.0, 0.5)))
    slope = uniform(-0.8, 0.8, 3)
    dome = (1 + directions @ slope).clamp_min(0.05)[:, None] / len(directions)
    return weights + ambient * dome * _tint(0.18, generator)


def _lobe(directions: Tensor, axis: Tensor, sharpness: float) -> Tensor:
    """Return weights [L, 1] of an area light: a von Mises-Fisher lobe of unit sum."""
    return (sharpness * (directions @ axis)).softmax(0)[:, None]


def _tint(spread: float, generator: torch.Generator) -> Tensor:
    """Draw the colour of a light [3] between warm and cold, with a little green or magenta."""
    warm, green = torch.randn(2, generator=generator) * spread * torch.tensor([1.0, 0.3])
    return torch.exp(torch.stack([warm, green, -1.3 * warm]))


def draw_target_lights(in_camera: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw indices [count] of lights at directions [L, 3], mostly in front of the face, like in photos."""
    return torch.multinomial(in_front(in_camera), count, generator=generator)


def in_front(in_camera: Tensor) -> Tensor:
    """Return weights [L] of lights at directions [L, 3] as photos have them: mostly in front of the face."""
    return torch.sigmoid(6 * (in_camera[:, 2] + 0.1)) + 0.05


def simulate_camera(
    source: Tensor, target: Tensor, albedo: Tensor, visible: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Simulate a camera on sources [B, 3, T, T], and expose sources and targets [B, L, 3, T, T] for training.

    Sources get a colour cast, clipping, blur, a tone curve and noise, and a mean of `MEAN_RADIANCE`. Targets
    get the same cast, and the scale that makes the mean albedo of the visible face `MEAN_RADIANCE`.
    """
    colours = torch.stack([TEXTURE_CAMERA.colours(generator) for _ in source])
    source, albedo = recoloured(source, colours), recoloured(albedo, colours)
    target = recoloured(target, colours[:, None]) * (MEAN_RADIANCE / _mean(albedo, visible))[:, None]
    means = _mean(source, visible)
    photos = [TEXTURE_CAMERA.take(*one, generator) for one in zip(source, means, strict=True)]
    return exposed(torch.stack(photos), visible), target


def exposed(source: Tensor, visible: Tensor) -> Tensor:
    """Scale textures [B, 3, T, T] to a mean of `MEAN_RADIANCE` over the visible texels [B, 1, T, T]."""
    return source / _mean(source, visible) * MEAN_RADIANCE


def _mean(field: Tensor, visible: Tensor) -> Tensor:
    """Mean over channels and visible texels [B, 1, 1, 1] of a field [B, 3, T, T]."""
    total = (field.mean(1, keepdim=True) * visible).sum((2, 3), keepdim=True)
    return total / visible.sum((2, 3), keepdim=True).clamp_min(1e-6) + 1e-6


@dataclass(frozen=True)
class HeadFields:
    """Baked head in UV space, head frame; transport is stored in bytes."""

    positions: Tensor  # [3, T, T], m
    normals: Tensor  # [3, T, T]
    tangents: tuple[Tensor, Tensor]  # [3, T, T] each, unit, along u and v
    directions: Tensor  # [L, 3] toward the lights
    visibility: Tensor  # [L, T, T], times 255
    bounce: Tensor  # [L, T, T], square root times 255


def head_fields(head: dict[str, Tensor]) -> HeadFields:
    """Build the fields of one baked head from the tensors of `heads.bake_head`."""
    side = head["visibility"].shape[-1]
    positions = bake_attributes(head["vertices"], GRID, side)
    normals = normal_map(head["vertices"], grid_triangles(), side)
    along_u, along_v = (F.normalize(torch.gradient(positions, dim=dim)[0], dim=0) for dim in (-1, -2))
    lit = head["visibility"] * lid_shadows(head["directions"], side)
    visibility = lit.round().byte()
    return HeadFields(positions, normals, (along_u, along_v), head["directions"], visibility, head["bounce"])


def lid_shadows(directions: Tensor, side: int) -> Tensor:
    """Compute the share of light [L, T, T] that passes lids and lashes, from directions [L, 3], head frame.

    A point of the eye is lit where a ray toward the light leaves through the opening. Elsewhere it is 1.
    """
    opening = mask(Window(side), "eyes", 1.5)  # [1, 1, T, T]
    rows = opening[0, 0].amax(1).nonzero()[:, 0]
    band = slice(int(rows[0]), int(rows[-1]) + 1)  # rows of the eyes
    slope = directions[:, :2] / directions[:, 2:].clamp_min(_GRAZING)  # sideways shift per unit of height
    aside_uv = slope * torch.tensor([1.0, -1.0]) / torch.as_tensor(UV_SIZE_MM, dtype=torch.float32)
    lids, lashes = (_moved(opening, reach_mm * aside_uv, band) for reach_mm in (_LIDS_MM, _LASHES_MM))
    passed = lids * (_LASHES_PASS + (1 - _LASHES_PASS) * lashes)
    through = torch.ones(len(directions), side, side)
    through[:, band] -= opening[0, :, band] * (1 - passed)
    return through


def _moved(field: Tensor, by_uv: Tensor, rows: slice) -> Tensor:
    """Sample rows of a field [1, 1, T, T] at texel centres moved by offsets [L, 2]: [L, R, T]."""
    places = texel_centres_uv(field.shape[-1])[rows] + by_uv[:, None, None]
    return F.grid_sample(field.expand(len(by_uv), -1, -1, -1), 2 * places - 1, align_corners=False)[:, 0]


def with_occluders(skin: Skin, window: Window, generator: torch.Generator) -> Skin:
    """Cover some of the skins by a fringe or by glasses."""
    count = len(skin.albedo)
    uniform = Uniform(generator, (count, 1, 1, 1))
    fringed, spectacled = uniform(0, 1) < _FRINGES, uniform(0, 1) < _GLASSES
    strands = noise(count, window, (1.5, 40), generator, octaves=2)
    ragged = noise(count, window, (10, 30), generator, octaves=2)
    _, y = places_mm(window)
    lower_mm = _BROW_MM + uniform(-35, 8) + 4 * ragged
    fringe = smooth((lower_mm - y) / 4 + 0.5 + 0.4 * strands) * fringed
    colour = uniform(0.01, 0.12) * (1 + 0.35 * strands).clamp(0.3, 2) * uniform(0.6, 1, count, 3, 1, 1)
    rims = _rims(window, uniform(17, 25), uniform(11, 20), uniform(0.6, 1.8)) * spectacled
    skin = _covered(skin, fringe, colour, 0.5)
    return _covered(skin, rims, uniform(0.005, 0.3, count, 3, 1, 1).expand_as(skin.albedo), 0.25)


def _covered(skin: Skin, cover: Tensor, albedo: Tensor, roughness: float) -> Skin:
    """Blend the skin toward a flat surface by its cover [B, 1, T, T]."""
    return replace(
        skin,
        albedo=skin.albedo + cover * (albedo - skin.albedo),
        roughness=skin.roughness + cover * (roughness - skin.roughness),
        relief=skin.relief * (1 - cover),
    )


def _rims(window: Window, width_mm: Tensor, height_mm: Tensor, line_mm: Tensor) -> Tensor:
    """Return the coverage [B, 1, T, T] of two rims, of given half widths and heights, and their bridge."""
    x, y = places_mm(window)
    dx, dy = x.abs() - _EYE_MM[0], y - _EYE_MM[1] - 2
    radius = ((dx / width_mm) ** 4 + (dy / height_mm) ** 4) ** 0.25  # a rounded rectangle
    from_rim_mm = (radius - 1).abs() * torch.minimum(width_mm, height_mm)
    bridge_mm = (dy + 3).abs() + 1e3 * (x.abs() > _EYE_MM[0] - width_mm)
    half_line = line_mm.clamp_min(max(window.texel_mm) / 2)
    return smooth(1.5 - torch.minimum(from_rim_mm, bridge_mm) / half_line)


def draw_sample(
    heads: Sequence[tuple[HeadFields, dict[str, Tensor]]], lights: int, generator: torch.Generator
) -> Sample:
    """Draw one sample of each of B heads and its views, with `lights` target lights."""
    faces = [_draw_face(head, views, lights, generator) for head, views in heads]
    side = faces[0].head.normals.shape[-1]
    skin = with_occluders(draw_skin(len(faces), side, generator), Window(side), generator)
    shaded = [_shade_face(face, skin.part(slice(k, k + 1))) for k, face in enumerate(faces)]
    source = torch.stack([s for s, _ in shaded])
    target = torch.stack([t for _, t in shaded])
    warp = torch.stack([face.view.warp for face in faces])
    visible = torch.stack([face.view.visible for face in faces])
    source = _warped(source, warp)
    target = _warped(target.flatten(1, 2), warp).view(target.shape)
    albedo = _warped(skin.albedo, warp)
    weight = torch.stack([face.weight for face in faces])
    source, target = simulate_camera(source, target, albedo, visible, generator)
    source = torch.stack([inpaint(s, v[0]) for s, v in zip(source, visible, strict=True)])
    return Sample(
        source=source,
        visible=visible,
        normals_source=torch.stack([face.view.normals for face in faces]),
        normals_target=torch.stack([face.fitted_normals_target for face in faces]),
        lights=torch.stack([face.lights_camera for face in faces]),
        target=target,
        weight=weight,
    )


@dataclass(frozen=True)
class _FittedView:
    """Fitted view of a head, from `heads.build_views`."""

    rotation: Tensor  # [3, 3] head_to_camera
    warp: Tensor  # [T, T, 2] true (u, v) of every fitted texel
    visible: Tensor  # [1, T, T] in 0..1
    normals: Tensor  # [3, T, T] of the fit, camera space

    @staticmethod
    def draw(views: dict[str, Tensor], generator: torch.Generator) -> "_FittedView":
        index = int(torch.randint(len(views["rotation"]), (), generator=generator))
        return _FittedView(
            rotation=views["rotation"][index],
            warp=views["warp"][index].float().permute(1, 2, 0),
            visible=views["visible"][index][None].float() / 255,
            normals=F.normalize(views["normals"][index].float(), dim=0),
        )


@dataclass(frozen=True)
class _LitFace:
    """Head with its view, source light and target lights; fields [..., T, T] on the true UV map."""

    head: HeadFields
    view: _FittedView
    to_source: Tensor  # [3, T, T] unit directions to the camera, head frame
    to_target: Tensor  # [3, T, T]
    source_weights: Tensor  # [L, 3] of the rig lights
    target_lights: Tensor  # [l] indices of rig lights
    lights_camera: Tensor  # [l, 3] directions of the target lights, camera space of the target
    weight: Tensor  # [1, T, T] on the fitted UV map
    fitted_normals_target: Tensor  # [3, T, T] on the fitted UV map, camera space of the target


def _draw_face(
    head: HeadFields, views: dict[str, Tensor], lights: int, generator: torch.Generator
) -> _LitFace:
    view = _FittedView.draw(views, generator)
    rotation_source = view.rotation
    same_pose = torch.rand((), generator=generator) < _SAME_POSE_SHARE
    rotation_target = rotation_source if same_pose else _FittedView.draw(views, generator).rotation
    turn = rotation_target @ rotation_source.T
    directions_target = head.directions @ rotation_target.T
    target_lights = draw_target_lights(directions_target, lights, generator)
    to_target = _to_camera(head.positions, rotation_target)
    facing = torch.einsum("cij,cij->ij", head.normals, to_target)
    fitted_facing = _warped(facing[None, None], view.warp[None])[0]
    return _LitFace(
        head=head,
        view=view,
        to_source=_to_camera(head.positions, rotation_source),
        to_target=to_target,
        source_weights=draw_light(head.directions @ rotation_source.T, generator),
        target_lights=target_lights,
        lights_camera=directions_target[target_lights],
        weight=(fitted_facing > _LEAST_FACING) * (0.3 + 0.7 * view.visible),
        fitted_normals_target=torch.einsum("dc,cij->dij", turn, view.normals),
    )


def _to_camera(positions: Tensor, rotation: Tensor) -> Tensor:
    """Unit directions [3, T, T] from the surface to the camera, in the head frame."""
    camera_in_head = rotation.T @ torch.tensor([0.0, 0.0, _VIEW_DISTANCE_M])
    return unit_along(camera_in_head.view(3, 1, 1) - positions, 0)


def _shade_face(face: _LitFace, skin: Skin) -> tuple[Tensor, Tensor]:
    """Shade the source [3, T, T] and the targets [l, 3, T, T] of one face on its true UV map."""
    head = face.head
    normals = tilt_normals(head.normals[None], head.tangents[0][None], head.tangents[1][None], skin.relief)
    power = face.source_weights.sum(-1)
    needed = power > _LEAST_POWER * power.max()
    used = torch.cat([needed.nonzero()[:, 0], face.target_lights])
    cosines = torch.einsum("lc,cij->lij", head.directions[used], normals[0])
    visibility, bounce = head.visibility[used].float() / 255, (head.bounce[used].float() / 255) ** 2
    split = len(used) - len(face.target_lights)  # lights of the source come first
    albedo = skin.albedo[0]
    irradiance = [
        diffuse_irradiance(
            visibility[:split], bounce[:split], cosines[:split], albedo, face.source_weights[used[:split]]
        )
    ]
    white = torch.ones(1, 3)
    for k in range(split, len(used)):
        one = slice(k, k + 1)
        irradiance.append(diffuse_irradiance(visibility[one], bounce[one], cosines[one], albedo, white))
    scattered = scatter(torch.stack(irradiance), skin.scattering_texels.expand(len(irradiance), 3))
    radiance = albedo * scattered
    bright = power.topk(min(_SOURCE_HIGHLIGHTS, split)).indices
    gloss = highlights(normals, face.to_source[None], head.directions[bright][None], skin)[0] * (
        head.visibility[bright].float() / 255
    )
    source = radiance[0] + torch.einsum("lc,lij->cij", face.source_weights[bright], gloss)
    target_directions = head.directions[face.target_lights]
    gloss = highlights(normals, face.to_target[None], target_directions[None], skin)[0]
    target = radiance[1:] + (gloss * visibility[split:])[:, None]
    return source, target


def _warped(texture: Tensor, warp: Tensor) -> Tensor:
    """Resample textures [B, C, T, T] from the true UV map to the fitted one by its warp [B, T, T, 2]."""
    return F.grid_sample(texture, 2 * warp - 1, padding_mode="border", align_corners=False)
