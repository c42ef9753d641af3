"""Training samples: a source texture as the pipeline would unwrap it, and its true OLAT textures.

Skins, lights and the camera are drawn anew for every sample (DESIGN, 'Baked transport').
"""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.network.reflectance import MEAN_RADIANCE
from facerf_cli.raster.texture import inpaint
from facerf_cli.stage.appearance.skin import Skin, draw_skin
from facerf_cli.stage.lights import draw_light
from facerf_cli.stage.shading import bend, diffuse_irradiance, highlights, scatter, unit

if TYPE_CHECKING:
    from facerf_cli.stage.bank import Bank

_SOURCE_HIGHLIGHTS = 10  # of the source's lights, the brightest ones also shine
_VIEW_DISTANCE_M = 1.2  # of the crop camera from a face


@dataclass(frozen=True)
class Sample:
    """B faces, L lights each; all fields in the fitted chart, camera space, normalised to the same exposure.

    source [B, 3, T, T] with unseen texels filled, visible [B, 1, T, T], normals_source and normals_target
    [B, 3, T, T] of the fitted mesh, lights [B, L, 3], target [B, L, 3, T, T], weight [B, 1, T, T] of the
    loss.
    """

    source: Tensor
    visible: Tensor
    normals_source: Tensor
    normals_target: Tensor
    lights: Tensor
    target: Tensor
    weight: Tensor

    def to(self, device: torch.device) -> "Sample":
        """The same sample on `device`."""
        return Sample(*(getattr(self, field.name).to(device) for field in fields(self)))


class SampleSource(Protocol):
    """What training draws from: the bank of baked heads, or a prepared dataset."""

    @property
    def provenance(self) -> dict[str, Any]:
        """For the checkpoint; its 'licence' is the words for the whole."""

    @property
    def side(self) -> int:
        """Texels along a side of every field."""

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Whom to train on, and at most `held_out` whom to validate on; numbers that `draw` takes."""

    def draw(self, heads: Tensor, lights: int, generator: torch.Generator) -> Sample:
        """One sample of every head in `heads` [B], with `lights` target lights."""

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        """Normals [3, T, T], visibility [L, T, T] and its directions [L, 3] of the mean face, head frame."""


def draw_sample(bank: "Bank", heads: Tensor, lights: int, generator: torch.Generator) -> Sample:
    """Draw one sample of every head in `heads` [B], with `lights` target lights."""
    faces = [_draw_face(bank, int(head), lights, generator) for head in heads]
    skin = draw_skin(len(faces), bank.side, generator)
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


def _draw_face(bank: "Bank", head: int, lights: int, generator: torch.Generator) -> _Face:
    geometry = bank.geometries[head]
    view = bank.draw_view(head, generator)
    directions = geometry.directions
    rotation_source = view.rotation
    same_pose = torch.rand((), generator=generator) < 0.6
    rotation_target = rotation_source if same_pose else bank.draw_view(head, generator).rotation
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


def draw_target_lights(in_camera: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Numbers [count] of lights [L, 3], mostly in front, as photographs are lit; some from elsewhere."""
    preference = torch.sigmoid(6 * (in_camera[:, 2] + 0.1)) + 0.05
    return torch.multinomial(preference, count, generator=generator)


def _one(skin: Skin, index: int) -> Skin:
    part = slice(index, index + 1)
    return Skin(
        skin.albedo[part],
        skin.specular[part],
        skin.roughness[part],
        skin.relief[part],
        skin.scattering_texels[part],
    )


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


def photograph(
    source: Tensor, target: Tensor, albedo: Tensor, visible: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """What a camera makes of sources [B, 3, T, T]; and these and targets [B, L, 3, T, T] exposed to train.

    Targets are scaled so that the mean of `albedo` over the visible face becomes `MEAN_RADIANCE`; see
    network.reflectance.
    """
    faces = len(source)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(faces, *(shape or (1, 1, 1)), generator=generator)

    balance = torch.exp(uniform(-0.12, 0.12, 3, 1, 1))
    grey = (uniform(0, 1) < 0.25).float()
    source, target, albedo = (
        _greyed(x, grey) for x in (source * balance, target * balance[:, None], albedo * balance)
    )
    target = target * (MEAN_RADIANCE / _mean(albedo, visible))[:, None]
    source = source / _mean(source, visible)
    clip = uniform(1.6, 6.0)
    source = _blurred((source / clip).clamp(0, 1), uniform(0, 1.2)) ** torch.exp(uniform(-0.22, 0.22))
    noise = torch.randn(source.shape, generator=generator) * uniform(0, 0.02)
    source = (source + noise * (source + 0.02).sqrt()).clamp(0, 1)
    return source / _mean(source, visible) * MEAN_RADIANCE, target


def _greyed(field: Tensor, grey: Tensor) -> Tensor:
    """Some faces [B, ..., 3, T, T] without colour."""
    mixed = field.mean(-3, keepdim=True)
    share = grey.view(-1, *([1] * (field.dim() - 1)))
    return field * (1 - share) + mixed * share


def _mean(field: Tensor, visible: Tensor) -> Tensor:
    """Mean over channels and visible texels [B, 1, 1, 1] of a field [B, 3, T, T]."""
    total = (field.mean(1, keepdim=True) * visible).sum((2, 3), keepdim=True)
    return total / visible.sum((2, 3), keepdim=True).clamp_min(1e-6) + 1e-6


def _blurred(field: Tensor, sigma: Tensor) -> Tensor:
    return scatter(field, sigma.view(-1, 1).expand(-1, 3).clamp_min(0.05))
