"""The neural reflectance field of one face: its texture under any light, far or near, and any sum."""

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
from facerf_cli.light.light import PointLights
from facerf_cli.light.sphere import rig_directions
from facerf_cli.network.inputs import is_grey, mixed_precision, without_cast
from facerf_cli.network.reflectance import ReflectanceNetwork
from facerf_cli.portrait.correction import Quotient
from facerf_cli.raster.texture import bake_attributes
from facerf_cli.relighting import White
from facerf_cli.relighting.detail import NOISE, contrast, lost_detail
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.white import Balance, without_colour_of_shade
from facerf_cli.run.memory import limit_bytes
from facerf_cli.run.threads import count, in_threads

_LIGHTS_ON_CPU = 4  # in one batch: more leave the processor's cache and are slower
_LIGHT_SIDE = 128  # texels on which light is estimated
_AROUND = 32  # lights that shine as even light does
_DETAIL_PX, _VISIBLE = 4.0, 0.3  # standard deviation of the blur of detail, in texels; least visibility
SEEN_WELL = 0.9  # share of a small texel from which on its colour is the photo's


@dataclass(frozen=True, eq=False)
class Field:
    """The field of a face, by the network alone or corrected by a photo's quotient; a `Reflectance`.

    With `even_shade` the network sees the face `without_colour_of_shade`, as the quotient's field does. A
    `balance` holds the gain of its white; `detail` [3, T, T] is the factor of `with_detail`.
    """

    models: Models
    face: FaceTexture
    quotient: Quotient | None = None
    bf16: bool = False
    even_shade: bool = False
    balance: Balance | None = None
    detail: Tensor | None = None

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Textures [M, 3, T, T] under M sums, weights [M, L, 3], of lights [L, 3]; see `Reflectance`."""
        used = shining(weights)
        used[0] |= not used.any()
        return weighted_sum(self.olats(directions[used], turn), weights[:, used])

    def olats(self, lights: Tensor, turn: Tensor | None = None) -> Iterator[Tensor]:
        """Yield OLAT textures for unit camera-space lights [L, 3], in batches [l, 3, T, T].

        `turn` [3, 3] rotates the head from its pose in the photo to the target's: N_t = turn N_s (paper,
        'Network Architecture'). The encoder runs once a field, the decoder once a light.
        """
        network, face, device = self._network, self.face, self.models.device
        encoded = self._encode() if self.has_gradients else self._encoded
        normals = face.normals if turn is None else torch.einsum("dc,cij->dij", turn, face.normals)
        normals, grey = normals[None].to(device), is_grey(face.texture)

        def decoded(some: Tensor) -> Tensor:
            with mixed_precision(device, self.bf16):
                olats = network.decode(encoded, normals, some[None].to(device))[0]
            olats = olats.float().cpu()
            olats = olats.mean(1, keepdim=True).expand_as(olats) if grey else olats
            olats = self.quotient.corrected(olats) if self.quotient else olats
            olats = olats if self.detail is None else olats * self.detail
            return olats if self.balance is None else olats * self.balance.gain[:, None, None]

        yield from in_threads(decoded, torch.split(lights, self._batch(len(lights))))

    def small_under_even_light(self) -> Tensor:
        """The face's small texture [3, t, t] under even white light."""
        rig = rig_directions(_AROUND)
        return replace(self, face=shrunk(self.face)).relit(rig, torch.full((1, _AROUND, 3), 1 / _AROUND))[0]

    def with_detail(self, even: Tensor) -> "Field":
        """Return the field with the detail of the texture that the network loses (`detail.py`).

        `even` [3, t, t] is the small face under even white light. How much of the contrast of its own texture
        it keeps is the same at all scales, so that it is measured there.
        """
        small, sigma = shrunk(self.face), _DETAIL_PX * even.shape[-1] / self.face.texture.shape[-1]
        sure = (small.visible > SEEN_WELL).float()
        shown, kept = (
            contrast(image, sure, sigma, NOISE * float(image.mean())) for image in (small.texture, even)
        )
        texture = self.face.texture.detach()
        weight = (self.face.visible * region_mask("skin", texture.shape[-1]) > _VISIBLE).float()
        finer = contrast(texture, weight, _DETAIL_PX, NOISE * float(texture.mean()))
        grey, colour = ((1 - _slope(*pair)) * one for one, *pair in zip(finer, shown, kept, strict=True))
        return replace(self, detail=lost_detail(grey, colour, weight, _DETAIL_PX))

    @property
    def has_gradients(self) -> bool:
        """If the encoded face has gradients, which serve one `backward` alone."""
        network: Any = self._network
        taken = (self.face.texture, *network.parameters())
        return torch.is_grad_enabled() and any(values.requires_grad for values in taken)

    @cached_property
    def _encoded(self) -> Any:
        return self._encode()

    def _encode(self) -> Any:
        """The face as the network's encoder sees it."""
        face, device = self.face, self.models.device
        visible, shown = face.visible[None, None], face.texture
        if self.even_shade:
            skin = face.visible * region_mask("skin", shown.shape[-1])
            shown = shown * without_colour_of_shade(shown, skin)
        texture = without_cast(shown[None], visible, self.models.source_colours)
        with mixed_precision(device, self.bf16):
            return self._network.encode(*(x.to(device) for x in (texture, face.normals[None], visible)))

    @property
    def _network(self) -> ReflectanceNetwork:
        return self.models.networks.reflectance

    def _batch(self, lights: int) -> int:
        """Lights that are decoded at once."""
        most = _LIGHTS_ON_CPU if self.models.device.type == "cpu" else lights
        texels = self.face.texture.shape[-1] ** 2
        bytes_per_light = self._network.bytes_per_light(texels) * count()
        return max(1, min(most, limit_bytes() // bytes_per_light))


def _slope(x: Tensor, y: Tensor) -> float:
    """Return the slope of y as a multiple of x, within 0..1."""
    return float(((x * y).sum() / (x * x).sum().clamp_min(1e-9)).clamp(0, 1))


def shining(weights: Tensor) -> Tensor:
    """The lights [L] that matter to sums of them, weights [M, L, 3]: for gradients all, else those not 0."""
    return (weights.abs().sum((0, 2)) > 0) | weights.requires_grad


def photo_evidence(face: FaceTexture, keep_eyes: bool = False) -> LightEvidence:
    """The photo's side of the evidence for its light, without lights; InputError if too little is visible.

    The mask is the interior of the face where the photo shows it well. Eyes are left out unless `keep_eyes`,
    since the field of open eyes is not learnt (paper, 'Results').
    """
    small = shrunk(face)
    mask = (small.visible > SEEN_WELL) & (interior_texture(_LIGHT_SIDE)[0] > 0.5)
    if not keep_eyes:
        mask &= region_mask("eyes", _LIGHT_SIDE) < 0.5
    evidence = LightEvidence(torch.zeros(0, 3), torch.zeros(0, 3, *mask.shape), small.texture, mask)
    evidence.require_a_face()
    return evidence


def shrunk(face: FaceTexture) -> FaceTexture:
    """The texture at the side at which light is estimated."""
    side = (_LIGHT_SIDE, _LIGHT_SIDE)
    fields = torch.cat([face.texture, face.visible[None], face.normals])[None]
    small = F.interpolate(fields, side, mode="area")[0]
    return FaceTexture(small[:3], small[3], F.normalize(small[4:], dim=0))


def balance_of(white: White, shown: Iterable[tuple[FaceTexture, Tensor]]) -> Balance:
    """The balance of a face by its photos: each a texture, and the small face under even white light."""
    faces, even = zip(*((shrunk(face), relit) for face, relit in shown), strict=True)
    skin = torch.stack([face.visible > SEEN_WELL for face in faces]) * region_mask("skin", _LIGHT_SIDE)
    photos = torch.stack([face.texture for face in faces], 1)
    return Balance.of(white, torch.stack(even, 1), photos, skin)


def weighted_sum(batches: Iterable[Tensor], weights: Tensor) -> Tensor:
    """Sum OLATs [L, 3, ...], given in batches, by rgb weights [M, L, 3]: [M, 3, ...] (paper, 'Relighting').

    Textures are summed before they are rendered, since a render costs more; the batches are never all held.
    """
    total, done = torch.zeros(()), 0
    for olats in batches:
        some = weights[:, done : done + len(olats)]
        flat = torch.einsum("mlc,lcn->mcn", some, olats.flatten(2))
        total = total + flat.view(*flat.shape[:2], *olats.shape[2:])
        done += len(olats)
    return total


_APART_DEG, _MOST_STEPS = 10.0, 3  # of the grid, and steps from its middle; wider patches have wider steps
_POINT_DEG = 0.5  # half a patch's width up to which a light is far
_SIDE = 64  # texels of the maps by which far lights are mixed: they are smooth
_AT_ONCE = 8  # far lights


def near_texture(
    reflectance: Reflectance, points: PointLights, vertices_m: Tensor, side: int, turn: Tensor | None = None
) -> Tensor:
    """The texture [3, side, side] of a face, vertices [V, 3] in camera space, under a near light of rgb 1.

    Seen from the face, a near light covers a patch of directions: each texel sees its points elsewhere. A
    grid of far lights spans the patch, and each texel mixes them bilinearly, by where it sees the light and
    how near. Between the grid's directions that is an approximation; a light far away is a far one exactly.

    `turn` is that of `Reflectance.relit`; the vertices are turned already.
    """
    positions_m = bake_attributes(vertices_m, math.isqrt(len(vertices_m)), _SIDE)
    directions, shares = far_lights_of(points, positions_m)
    total = torch.zeros(3, side, side)
    for some, maps in zip(torch.split(directions, _AT_ONCE), torch.split(shares, _AT_ONCE), strict=True):
        each = torch.eye(len(some))[..., None].expand(-1, -1, 3)
        textures = reflectance.relit(some, each, turn)
        wide = F.interpolate(maps[:, None], size=(side, side), mode="bilinear", align_corners=False)
        total = total + (wide * textures).sum(0)
    return total


def far_lights_of(points: PointLights, positions_m: Tensor) -> tuple[Tensor, Tensor]:
    """Directions [K, 3] of far lights that span a near one, and the share [K, T, T] of each at positions.

    positions [3, T, T] are in camera space. The grid is one of angles about the direction to the light's
    middle (azimuthal equidistant), so that it can span more than a half-space.
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
    across, along = (_hats(cells[..., number], steps) for number in (0, 1))
    shares = torch.einsum("pij,puij,pvij->uvij", irradiance, across, along)
    offsets = torch.arange(-steps, steps + 1) * math.radians(apart_deg)
    directions = _directions(offsets, axis, sides)
    used = shares.amax((2, 3)) > 0
    return directions[used], shares[used]


def _hats(places: Tensor, steps: int) -> Tensor:
    """Linear shares [P, 2 steps + 1, T, T] of places [P, T, T] in -steps..steps among whole numbers."""
    nodes = torch.arange(-steps, steps + 1)[:, None, None]
    return (1 - (places[:, None] - nodes).abs()).clamp_min(0)


def _directions(offsets: Tensor, axis: Tensor, sides: tuple[Tensor, Tensor]) -> Tensor:
    """Unit directions [n, n, 3] at angles [n] from an axis toward each of two sides."""
    u, v = torch.meshgrid(offsets, offsets, indexing="ij")
    angle = torch.hypot(u, v)[..., None]
    slope = torch.sinc(angle / math.pi)  # sin(angle) / angle
    return angle.cos() * axis + slope * (u[..., None] * sides[0] + v[..., None] * sides[1])


def _sides(axis: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors that are orthogonal to an axis [3] and to each other."""
    helper = torch.eye(3)[int(axis.abs().argmin())]
    first = F.normalize(torch.linalg.cross(axis, helper), dim=0)
    return first, torch.linalg.cross(axis, first)
