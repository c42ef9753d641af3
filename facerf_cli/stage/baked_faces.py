"""Training samples of baked heads: skins, lights and the camera are drawn anew for every one.

The transport is baked (DESIGN, 'Baked transport'); shading happens in the head's true chart, and is then seen
through the chart of a fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.raster.texture import inpaint
from facerf_cli.stage.appearance.occluders import with_occluders
from facerf_cli.stage.appearance.skin import Skin, draw_skin
from facerf_cli.stage.appearance.window import Window
from facerf_cli.stage.lights import draw_light
from facerf_cli.stage.samples import Sample, draw_target_lights, photograph
from facerf_cli.stage.shading import bend, diffuse_irradiance, highlights, scatter, unit

_SOURCE_HIGHLIGHTS = 10  # of the source's lights, the brightest ones also shine
_VIEW_DISTANCE_M = 1.2  # of the crop camera from a face


@dataclass(frozen=True)
class Geometry:
    """One baked head (head frame): positions, normals, tangents [3, T, T]; transport in bytes."""

    positions: Tensor
    normals: Tensor
    tangents: tuple[Tensor, Tensor]
    directions: Tensor  # [L, 3]
    visibility: Tensor  # [L, T, T]
    bounce: Tensor  # [L, T, T], square roots


@dataclass(frozen=True)
class View:
    """One fitted view of a head: see stage.views."""

    rotation: Tensor  # [3, 3]
    warp: Tensor  # [T, T, 2]
    visible: Tensor  # [1, T, T] in 0..1
    normals: Tensor  # [3, T, T]

    @staticmethod
    def draw(views: dict[str, Tensor], generator: torch.Generator) -> "View":
        """A random one of a head's, as `stage.views` writes them."""
        index = int(torch.randint(len(views["rotation"]), (), generator=generator))
        return View(
            rotation=views["rotation"][index],
            warp=views["warp"][index].float().permute(1, 2, 0),
            visible=views["visible"][index][None].float() / 255,
            normals=F.normalize(views["normals"][index].float(), dim=0),
        )


def draw_sample(
    heads: Sequence[tuple[Geometry, dict[str, Tensor]]], lights: int, generator: torch.Generator
) -> Sample:
    """Draw one sample of each of B heads and its views, with `lights` target lights."""
    faces = [_draw_face(geometry, views, lights, generator) for geometry, views in heads]
    side = faces[0].normals.shape[-1]
    skin = with_occluders(draw_skin(len(faces), side, generator), Window(side), generator)
    shaded = [_shade_face(face, _one(skin, i)) for i, face in enumerate(faces)]
    source = torch.stack([s for s, _ in shaded])
    target = torch.stack([t for _, t in shaded])
    warp = torch.stack([face.warp for face in faces])
    visible = torch.stack([face.visible for face in faces])
    source = _warped(source, warp)
    target = _warped(target.flatten(1, 2), warp).view(target.shape)
    albedo = _warped(skin.albedo, warp)
    weight = torch.stack([face.weight for face in faces])
    source, target = photograph(source, target, albedo, visible, generator)
    source = torch.stack([inpaint(s, v[0]) for s, v in zip(source, visible, strict=True)])
    return Sample(
        source=source,
        visible=visible,
        normals_source=torch.stack([face.fitted_normals for face in faces]),
        normals_target=torch.stack([face.fitted_normals_target for face in faces]),
        lights=torch.stack([face.lights_camera for face in faces]),
        target=target,
        weight=weight,
    )


@dataclass(frozen=True)
class _Face:
    """One head in one view, with what its source and targets need; fields [.., T, T] of the true chart."""

    normals: Tensor  # [3, T, T], head frame, as are tangents and views
    tangents: tuple[Tensor, Tensor]
    view_source: Tensor
    view_target: Tensor
    visibility: Tensor  # [L150, T, T] bytes, as is the bounce: floats only of the lights that a sample uses
    bounce: Tensor
    directions: Tensor  # [L150, 3]
    source_weights: Tensor  # [L150, 3]
    chosen: Tensor  # [L] of the target lights
    lights_camera: Tensor  # [L, 3] in the target's camera space
    warp: Tensor  # [T, T, 2] true (u, v) of every fitted texel
    visible: Tensor  # [1, T, T]
    weight: Tensor  # [1, T, T]
    fitted_normals: Tensor
    fitted_normals_target: Tensor


def _draw_face(
    geometry: Geometry, views: dict[str, Tensor], lights: int, generator: torch.Generator
) -> _Face:
    view = View.draw(views, generator)
    directions = geometry.directions
    rotation_source = view.rotation
    same_pose = torch.rand((), generator=generator) < 0.6
    rotation_target = rotation_source if same_pose else View.draw(views, generator).rotation
    turn = rotation_target @ rotation_source.T
    in_target = directions @ rotation_target.T
    chosen = draw_target_lights(in_target, lights, generator)
    view_target = _views(geometry.positions, rotation_target)
    facing = torch.einsum("cij,cij->ij", geometry.normals, view_target)
    true_facing = _warped(facing[None, None], view.warp[None])[0]
    return _Face(
        normals=geometry.normals,
        tangents=geometry.tangents,
        view_source=_views(geometry.positions, rotation_source),
        view_target=view_target,
        visibility=geometry.visibility,
        bounce=geometry.bounce,
        directions=directions,
        source_weights=draw_light(directions @ rotation_source.T, generator),
        chosen=chosen,
        lights_camera=in_target[chosen],
        warp=view.warp,
        visible=view.visible,
        weight=(true_facing > 0.1) * (0.3 + 0.7 * view.visible),
        fitted_normals=view.normals,
        fitted_normals_target=torch.einsum("dc,cij->dij", turn, view.normals),
    )


def _views(positions: Tensor, rotation: Tensor) -> Tensor:
    """Unit directions [3, T, T] from the surface to the camera, in the head frame."""
    camera_in_head = rotation.T @ torch.tensor([0.0, 0.0, _VIEW_DISTANCE_M])
    return unit(camera_in_head.view(3, 1, 1) - positions, 0)


def _one(skin: Skin, index: int) -> Skin:
    return Skin(*(getattr(skin, field.name)[index : index + 1] for field in fields(Skin)))


def _shade_face(face: _Face, skin: Skin) -> tuple[Tensor, Tensor]:
    """Source [3, T, T] and targets [L, 3, T, T] of one face in its true chart."""
    normals = bend(face.normals[None], face.tangents[0][None], face.tangents[1][None], skin.relief)
    needed = face.source_weights.sum(-1) > 0.004 * face.source_weights.sum(-1).max()
    used = torch.cat([needed.nonzero()[:, 0], face.chosen])
    cosines = torch.einsum("lc,cij->lij", face.directions[used], normals[0])
    visibility, bounce = face.visibility[used].float() / 255, (face.bounce[used].float() / 255) ** 2
    split = len(used) - len(face.chosen)
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
    bright = face.source_weights.sum(-1).topk(min(_SOURCE_HIGHLIGHTS, split)).indices
    gloss = highlights(normals, face.view_source[None], face.directions[bright][None], skin)[0] * (
        face.visibility[bright].float() / 255
    )
    source = radiance[0] + torch.einsum("lc,lij->cij", face.source_weights[bright], gloss)
    gloss = highlights(normals, face.view_target[None], face.directions[face.chosen][None], skin)[0]
    target = radiance[1:] + (gloss * visibility[split:])[:, None]
    return source, target


def _warped(fields: Tensor, warp: Tensor) -> Tensor:
    """Fields [B, C, T, T] of the true chart at the true (u, v) [B, T, T, 2] of every fitted texel."""
    return F.grid_sample(fields, 2 * warp - 1, padding_mode="border", align_corners=False)
