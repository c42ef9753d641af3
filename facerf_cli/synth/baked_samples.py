"""Training samples of baked heads, with random skin, light and camera.

The light transport is baked. A head is shaded on its own UV map; the warp of a fitted view then resamples the
textures to the UV map of the fit, which misses the head by the errors of the fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.raster.texture import inpaint
from facerf_cli.synth.appearance.skin import Skin, draw_skin
from facerf_cli.synth.head_fields import HeadFields
from facerf_cli.synth.occluders import with_occluders
from facerf_cli.synth.random_fields import Window
from facerf_cli.synth.shading import diffuse_irradiance, highlights, scatter, tilt_normals, unit
from facerf_cli.synth.texture_samples import Sample, draw_light, draw_target_lights, simulate_camera

_SAME_POSE_SHARE = 0.6  # share of samples whose target pose is the source pose
_SOURCE_HIGHLIGHTS = 10  # only the brightest lights of the source have highlights
_LEAST_POWER = 0.004  # lights of the source below this share of the brightest are skipped
_LEAST_FACING = 0.1  # cosine to the camera below which a texel has no weight in the loss
_VIEW_DISTANCE_M = 1.2  # distance of the crop camera from the face


def draw_sample(
    heads: Sequence[tuple[HeadFields, dict[str, Tensor]]], lights: int, generator: torch.Generator
) -> Sample:
    """Draw one sample of each of B heads and its views, with `lights` target lights."""
    faces = [_draw_face(head, views, lights, generator) for head, views in heads]
    side = faces[0].head.normals.shape[-1]
    skin = with_occluders(draw_skin(len(faces), side, generator), Window(side), generator)
    shaded = [_shade_face(face, _single_skin(skin, i)) for i, face in enumerate(faces)]
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
    """One fitted view of a head, from `views.build_views`."""

    rotation: Tensor  # [3, 3] head_to_camera
    warp: Tensor  # [T, T, 2] true (u, v) of every fitted texel
    visible: Tensor  # [1, T, T] in 0..1
    normals: Tensor  # [3, T, T] of the fit, camera space

    @staticmethod
    def draw(views: dict[str, Tensor], generator: torch.Generator) -> "_FittedView":
        """Draw one of a head's views."""
        index = int(torch.randint(len(views["rotation"]), (), generator=generator))
        return _FittedView(
            rotation=views["rotation"][index],
            warp=views["warp"][index].float().permute(1, 2, 0),
            visible=views["visible"][index][None].float() / 255,
            normals=F.normalize(views["normals"][index].float(), dim=0),
        )


@dataclass(frozen=True)
class _LitFace:
    """One head with its view, source light and target lights; fields [..., T, T] on the true UV map."""

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
    return unit(camera_in_head.view(3, 1, 1) - positions, 0)


def _single_skin(skin: Skin, index: int) -> Skin:
    """One of a batch of skins, as a batch of one."""
    return Skin(*(getattr(skin, field.name)[index : index + 1] for field in fields(Skin)))


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
