"""What lies before a face on a photograph, painted into the bank's skins: fringes and the rims of glasses.

They are relit as what they are, dark and matt, not as skin. That they stand off the face, the chart cannot
tell.

Random lights for training sources: from one flash to an overcast dome, as weights of a rig.

Training samples: a source texture as the pipeline would unwrap it, and its true OLAT textures.

What all sources of samples share; `baked_faces.py` and `dataset/textures.py` make them.

Training samples of baked heads: skins, lights and the camera are drawn anew for every one.

The transport is baked (DESIGN, 'Baked transport'); shading happens in the head's true chart, and is then seen
through the chart of a fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.raster.texture import inpaint
from facerf_cli.synth.appearance.skin import Skin, draw_skin
from facerf_cli.synth.random_fields import LANDMARK_MM, Uniform, Window, noise, places_mm, smooth
from facerf_cli.synth.shading import bend, diffuse_irradiance, highlights, scatter, unit

_FRINGES, _GLASSES = 0.15, 0.08  # shares of faces
_BROW_MM = float(LANDMARK_MM[17:27, 1].mean())
_EYE_MM = (float(abs(LANDMARK_MM[36:48, 0]).mean()), float(LANDMARK_MM[36:48, 1].mean()))


def with_occluders(skin: Skin, window: Window, generator: torch.Generator) -> Skin:
    """Some of the skins under a fringe or behind glasses."""
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
    return replace(
        skin,
        albedo=skin.albedo + cover * (albedo - skin.albedo),
        roughness=skin.roughness + cover * (roughness - skin.roughness),
        relief=skin.relief * (1 - cover),
    )


def _rims(window: Window, width_mm: Tensor, height_mm: Tensor, line_mm: Tensor) -> Tensor:
    """Cover [B, 1, T, T] by two rims that wide and high (from their middles), and the bridge between them."""
    x, y = places_mm(window)
    dx, dy = x.abs() - _EYE_MM[0], y - _EYE_MM[1] - 2
    radius = ((dx / width_mm) ** 4 + (dy / height_mm) ** 4) ** 0.25  # a rounded box
    from_rim_mm = (radius - 1).abs() * torch.minimum(width_mm, height_mm)
    bridge_mm = (dy + 3).abs() + 1e3 * (x.abs() > _EYE_MM[0] - width_mm)
    half_line = line_mm.clamp_min(max(window.texel_mm) / 2)
    return smooth(1.5 - torch.minimum(from_rim_mm, bridge_mm) / half_line)


def draw_light(directions: Tensor, generator: torch.Generator) -> Tensor:
    """Weights [L, 3] of rig lights at camera-space directions [L, 3]: up to three lamps over a dome."""
    uniform = Uniform(generator)
    kind = torch.rand((), generator=generator)
    if kind < 0.2:  # a flash near the camera
        axis = F.normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.15 * torch.randn(3, generator=generator), dim=0)
        return _lamp(directions, axis, 400.0) * torch.ones(3) + 0.0015
    lamps = 1 + int(torch.randint(3, (), generator=generator))
    weights = torch.zeros(len(directions), 3)
    for lamp in range(lamps):
        axis = F.normalize(torch.randn(3, generator=generator) + torch.tensor([0.0, 0.45, 0.75]), dim=0)
        sharpness = float(torch.exp(uniform(0.3, 6.0)))
        power = 1.0 if lamp == 0 else float(torch.exp(uniform(-2.5, 0.2)))
        weights += power * _lamp(directions, axis, sharpness) * _tint(0.22, generator)
    ambient = float(torch.exp(uniform(-5.0, 0.5)))
    slope = uniform(-0.8, 0.8, 3)
    dome = (1 + directions @ slope).clamp_min(0.05)[:, None] / len(directions)
    return weights + ambient * dome * _tint(0.18, generator)


def _lamp(directions: Tensor, axis: Tensor, sharpness: float) -> Tensor:
    """A von Mises-Fisher lobe of unit sum [L, 1]."""
    return (sharpness * (directions @ axis)).softmax(0)[:, None]


def _tint(spread: float, generator: torch.Generator) -> Tensor:
    """A lamp's colour [3] along warm to cold, with a little green or magenta."""
    warm, green = torch.randn(2, generator=generator) * spread * torch.tensor([1.0, 0.3])
    return torch.exp(torch.stack([warm, green, -1.3 * warm]))


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


def draw_target_lights(in_camera: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Numbers [count] of lights [L, 3], mostly in front, as photographs are lit; some from elsewhere."""
    preference = torch.sigmoid(6 * (in_camera[:, 2] + 0.1)) + 0.05
    return torch.multinomial(preference, count, generator=generator)


def photograph(
    source: Tensor, target: Tensor, albedo: Tensor, visible: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """What a camera makes of sources [B, 3, T, T]; and these and targets [B, L, 3, T, T] exposed to train.

    Targets are scaled so that the mean of `albedo` over the visible face becomes `MEAN_RADIANCE`; see
    network.reflectance.
    """
    faces = len(source)
    uniform = Uniform(generator, (faces, 1, 1, 1))
    balance = torch.exp(uniform(-0.12, 0.12, faces, 3, 1, 1))
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
