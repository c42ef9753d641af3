"""Neural reflectance field of a face: its texture under far and near lights and their weighted sums."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.baselines.base import Reflectance
from facerf_cli.face.head import FaceTexture
from facerf_cli.face.topology import interior_texture, region_mask
from facerf_cli.light.estimate import LightEvidence
from facerf_cli.light.light import UNIFORM_LIGHTS, PointLights
from facerf_cli.light.sphere import rig_directions
from facerf_cli.network.base import mixed_precision
from facerf_cli.network.inputs import is_grey, without_cast
from facerf_cli.network.reflectance import ReflectanceNetwork
from facerf_cli.portrait.correction import Quotient
from facerf_cli.raster.texture import bake_attributes
from facerf_cli.relighting import BalanceMode
from facerf_cli.relighting.detail import NOISE, contrast, lost_detail
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.white import WhiteBalance, without_colour_of_shade
from facerf_cli.run.memory import limit_bytes
from facerf_cli.run.threads import count, in_threads

_LIGHTS_ON_CPU = 4  # per batch: more leave the processor's cache and are slower
_LIGHT_SIDE = 128  # texels of the texture on which light is estimated
_DETAIL_PX, _VISIBLE = 4.0, 0.3  # standard deviation of the blur of detail, in texels; least visibility
SEEN_WELL = 0.9  # visibility above which a small texel shows the photo's colour


@dataclass(frozen=True, eq=False)
class Predicted:
    """A face as the network predicts it: its code, and textures [K, 3, T, T] under lights [K, 3]."""

    encoded: Any
    directions: Tensor
    textures: Tensor

    def index(self, lights: Tensor) -> Tensor:
        """Return the numbers [L] of lights [L, 3] among these, -1 for others."""
        same = (lights[:, None] == self.directions).all(-1)
        return torch.where(same.any(1), same.int().argmax(1), -1)


@dataclass(frozen=True, eq=False)
class Field:
    """Reflectance field of a face, predicted by the network and optionally corrected by the photo."""

    models: Models
    face: FaceTexture
    quotient: Quotient | None = None  # ratio image: the photo's original light reproduces the photo
    bf16: bool = False
    remove_shade_colour: bool = False  # whether the network sees the face `without_colour_of_shade`
    balance: WhiteBalance | None = None
    detail: Tensor | None = None  # factor [3, T, T] that restores detail (`with_detail`)
    known: Predicted | None = None  # of this face; it is not predicted again

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Return textures [M, 3, T, T] under M sums, [M, L, 3], of lights [L, 3]; see `Reflectance`."""
        used = shining(weights)
        used[0] |= not used.any()
        return weighted_sum(self.olats(directions[used], turn), weights[:, used])

    def olats(self, lights: Tensor, turn: Tensor | None = None) -> Iterator[Tensor]:
        """Yield batches [l, 3, T, T] of textures under one light at a time, from unit directions [L, 3].

        `turn` [3, 3] rotates the head from its pose in the photo to the target's: N_t = turn N_s (paper,
        'Network Architecture'). The encoder runs once per field, the decoder once per light.
        """
        network, face, device = self._network, self.face, self.models.device
        known = None if self.has_gradients or lights.requires_grad else self.known
        encoded = known.encoded if known else self._encode() if self.has_gradients else self._encoded
        normals = face.normals if turn is None else torch.einsum("dc,cij->dij", turn, face.normals)
        normals, grey = normals[None].to(device), is_grey(face.texture)

        def predicted(batch: Tensor) -> Tensor:
            with mixed_precision(device, self.bf16):
                olats = network.decode(encoded, normals, batch[None].to(device))[0]
            olats = olats.float().cpu()
            return olats.mean(1, keepdim=True).expand_as(olats) if grey else olats

        def decoded(batch: Tensor) -> Tensor:
            if known is None or turn is not None:
                olats = predicted(batch)
            else:
                number = known.index(batch)
                olats, new = known.textures[number], number < 0
                if new.any():
                    olats[new] = predicted(batch[new])
            olats = self._quotient.corrected(olats) if self._quotient else olats
            return olats if self._factor is None else olats * self._factor

        yield from in_threads(decoded, torch.split(lights, self._batch(len(lights))))

    def predict(self, lights: Tensor) -> Predicted:
        """Predict the face under lights [L, 3], to keep the result."""
        return Predicted(self._encoded, lights, torch.cat(list(self.olats(lights))))

    def small_under_uniform_light(self) -> Tensor:
        """Return the face's small texture [3, t, t] under uniform white light."""
        rig, share = rig_directions(UNIFORM_LIGHTS), 1 / UNIFORM_LIGHTS
        small = replace(self, face=shrunk(self.face), known=None)
        return small.relit(rig, torch.full((1, UNIFORM_LIGHTS, 3), share))[0]

    def with_detail(self, uniform: Tensor) -> "Field":
        """Return the field with the detail of the texture that the network loses (`detail.py`).

        The network keeps the same fraction of a texture's contrast at all scales, so the fraction is measured
        on `uniform` [3, t, t], the small face under uniform white light.
        """
        small, sigma = shrunk(self.face), _DETAIL_PX * uniform.shape[-1] / self.face.texture.shape[-1]
        sure = (small.visible > SEEN_WELL).float()
        photo, kept = (
            contrast(image, sure, sigma, NOISE * float(image.mean())) for image in (small.texture, uniform)
        )
        texture = self.face.texture.detach()
        weight = (self.face.visible * region_mask("skin", texture.shape[-1]) > _VISIBLE).float()
        finer = contrast(texture, weight, _DETAIL_PX, NOISE * float(texture.mean()))
        grey, colour = ((1 - _slope(*pair)) * one for one, *pair in zip(finer, photo, kept, strict=True))
        return replace(self, detail=lost_detail(grey, colour, weight, _DETAIL_PX))

    @property
    def has_gradients(self) -> bool:
        """Whether the encoded face has gradients; its graph then serves only one `backward`."""
        network: Any = self._network
        inputs = (self.face.texture, *network.parameters())
        return torch.is_grad_enabled() and any(values.requires_grad for values in inputs)

    @cached_property
    def _quotient(self) -> Quotient | None:
        return self.quotient.enlarged(self.face.texture.shape[-1]) if self.quotient else None

    @cached_property
    def _factor(self) -> Tensor | None:
        """Detail and white balance, [3, T, T] or [3, 1, 1]."""
        if self.balance is None:
            return self.detail
        gain = self.balance.gain[:, None, None]
        return gain if self.detail is None else gain * self.detail

    @cached_property
    def _encoded(self) -> Any:
        return self._encode()

    def _encode(self) -> Any:
        face, device = self.face, self.models.device
        visible, texture = face.visible[None, None], face.texture
        if self.remove_shade_colour:
            skin = face.visible * region_mask("skin", texture.shape[-1])
            texture = texture * without_colour_of_shade(texture, skin)
        texture = without_cast(texture[None], visible, self.models.source_colours)
        with mixed_precision(device, self.bf16):
            return self._network.encode(*(x.to(device) for x in (texture, face.normals[None], visible)))

    @property
    def _network(self) -> ReflectanceNetwork:
        return self.models.networks.reflectance

    def _batch(self, lights: int) -> int:
        most = _LIGHTS_ON_CPU if self.models.device.type == "cpu" else lights
        texels = self.face.texture.shape[-1] ** 2
        bytes_per_light = self._network.bytes_per_light(texels) * count()
        return max(1, min(most, limit_bytes() // bytes_per_light))


def _slope(x: Tensor, y: Tensor) -> float:
    """Return the slope of y as a multiple of x, within 0..1."""
    return float(((x * y).sum() / (x * x).sum().clamp_min(1e-9)).clamp(0, 1))


def shining(weights: Tensor) -> Tensor:
    """Return a mask [L] of the lights with a weight in [M, L, 3]; all of them if gradients are wanted."""
    return (weights.abs().sum((0, 2)) > 0) | weights.requires_grad


def photo_evidence(face: FaceTexture, keep_eyes: bool = False) -> LightEvidence:
    """Return the photo's part of the evidence for its light, still without lights.

    The mask is the interior of the face where it is clearly visible. Eyes are left out unless `keep_eyes`,
    since the field of open eyes is not learnt (paper, 'Results'). Raises InputError if too little is visible.
    """
    small = shrunk(face)
    mask = (small.visible > SEEN_WELL) & (interior_texture(_LIGHT_SIDE)[0] > 0.5)
    if not keep_eyes:
        mask &= region_mask("eyes", _LIGHT_SIDE) < 0.5
    evidence = LightEvidence(torch.zeros(0, 3), torch.zeros(0, 3, *mask.shape), small.texture, mask)
    evidence.require_a_face()
    return evidence


def shrunk(face: FaceTexture, side: int = _LIGHT_SIDE) -> FaceTexture:
    """Return the texture at another side, by default that at which light is estimated."""
    fields = torch.cat([face.texture, face.visible[None], face.normals])[None]
    small = F.interpolate(fields, (side, side), mode="area")[0]
    return FaceTexture(small[:3], small[3], F.normalize(small[4:], dim=0))


def balance_of(mode: BalanceMode, pairs: Iterable[tuple[FaceTexture, Tensor]]) -> WhiteBalance:
    """Return the white balance of a face from its textures, each with the small face under uniform light."""
    faces, uniform = zip(*((shrunk(face), relit) for face, relit in pairs), strict=True)
    skin = torch.stack([face.visible > SEEN_WELL for face in faces]) * region_mask("skin", _LIGHT_SIDE)
    photos = torch.stack([face.texture for face in faces], 1)
    return WhiteBalance.of(mode, torch.stack(uniform, 1), photos, skin)


def weighted_sum(batches: Iterable[Tensor], weights: Tensor) -> Tensor:
    """Sum batches of OLATs [L, 3, ...] by rgb weights [M, L, 3] to [M, 3, ...] (paper, 'Relighting').

    Textures are summed before they are rendered, because rendering costs more. Only one batch is in memory.
    """
    total, size, done = torch.zeros(()), torch.Size(), 0
    for olats in batches:
        if not done:
            total, size = olats.new_zeros(3, len(weights), olats[0, 0].numel()), olats.shape[2:]
        part = weights[:, done : done + len(olats)]
        add_weighted(total, part.permute(2, 0, 1), olats.flatten(2).transpose(0, 1))
        done += len(olats)
    return total.transpose(0, 1).view(len(weights), 3, *size)


def add_weighted(sums: Tensor, weights: Tensor, lights: Tensor) -> None:
    """Add images of lights [C, L, N] with weights [C, M, L] to M sums [C, M, N], in place."""
    used = (weights != 0).any(0).any(1) | weights.requires_grad
    rows = used.nonzero()[:, 0]
    sums.index_add_(1, rows, weights[:, rows] @ lights)


_APART_DEG, _MOST_STEPS = 10.0, 3  # of the grid, and steps from its middle; wider patches have wider steps
_POINT_DEG = 0.5  # half width of a patch below which a light counts as far
_SIDE = 64  # texels of the maps that mix far lights; they are smooth
_AT_ONCE = 8  # far lights per batch


def near_texture(
    reflectance: Reflectance, points: PointLights, vertices_m: Tensor, side: int, turn: Tensor | None = None
) -> Tensor:
    """Return the texture [3, side, side] of a face under a near light of rgb 1.

    Seen from the face, a near light covers a patch of directions, because each texel sees its points
    elsewhere. A grid of far lights spans the patch, and each texel mixes them bilinearly by the direction and
    distance at which it sees the light. Between the grid's directions this is an approximation; a distant
    light is exactly one far light.

    `vertices_m` [V, 3] are in camera space, already rotated by `turn`, the rotation for `Reflectance.relit`.
    """
    positions_m = bake_attributes(vertices_m, math.isqrt(len(vertices_m)), _SIDE)
    directions, weights = far_lights_of(points, positions_m)
    total = torch.zeros(3, side, side)
    for lights, maps in zip(torch.split(directions, _AT_ONCE), torch.split(weights, _AT_ONCE), strict=True):
        each = torch.eye(len(lights))[..., None].expand(-1, -1, 3)
        textures = reflectance.relit(lights, each, turn)
        wide = F.interpolate(maps[:, None], size=(side, side), mode="bilinear", align_corners=False)
        total = total + (wide * textures).sum(0)
    return total


def far_lights_of(points: PointLights, positions_m: Tensor) -> tuple[Tensor, Tensor]:
    """Return far lights that replace a near one: directions [K, 3] and weights [K, T, T] at each texel.

    Positions [3, T, T] are in camera space. The grid is regular in the angles around the direction to the
    light's middle (azimuthal equidistant), so it can span more than a half-space.
    """
    toward, irradiance = points.arriving(positions_m)  # [P, T, T, 3], [P, T, T]
    axis = -points.toward
    sides = _sides(axis)
    away = torch.stack([(toward * side).sum(-1) for side in sides], -1)
    angle = torch.atan2(away.norm(dim=-1), (toward * axis).sum(-1))
    flat_deg = torch.rad2deg(angle / away.norm(dim=-1).clamp_min(1e-9))[..., None] * away  # [P, T, T, 2]
    extent_deg = float(flat_deg.abs().max())
    steps = 0 if extent_deg < _POINT_DEG else min(math.ceil(extent_deg / _APART_DEG), _MOST_STEPS)
    apart_deg = max(_APART_DEG, extent_deg / max(steps, 1))
    cells = (flat_deg / apart_deg).clamp(-steps, steps)
    across, along = (_linear_interp_weights(cells[..., number], steps) for number in (0, 1))
    weights = torch.einsum("pij,puij,pvij->uvij", irradiance, across, along)
    offsets = torch.arange(-steps, steps + 1) * math.radians(apart_deg)
    u, v = torch.meshgrid(offsets, offsets, indexing="ij")
    radius = torch.hypot(u, v)[..., None]
    slope = torch.sinc(radius / math.pi)  # sin(radius) / radius
    directions = radius.cos() * axis + slope * (u[..., None] * sides[0] + v[..., None] * sides[1])
    used = weights.amax((2, 3)) > 0
    return directions[used], weights[used]


def _linear_interp_weights(coordinates: Tensor, steps: int) -> Tensor:
    """Return weights [P, 2 steps + 1, T, T] of coordinates [P, T, T] in -steps..steps among the integers."""
    nodes = torch.arange(-steps, steps + 1)[:, None, None]
    return (1 - (coordinates[:, None] - nodes).abs()).clamp_min(0)


def _sides(axis: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors that are orthogonal to an axis [3] and to each other."""
    helper = torch.eye(3)[int(axis.abs().argmin())]
    first = F.normalize(torch.linalg.cross(axis, helper), dim=0)
    return first, torch.linalg.cross(axis, first)
