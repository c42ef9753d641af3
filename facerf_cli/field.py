"""The neural reflectance field of one face: its texture under any single light, and any sum of lights."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.errors import UsageError
from facerf_cli.face.head import FaceTexture
from facerf_cli.face.topology import interior_texture, region_mask
from facerf_cli.light.estimate import LightEvidence, estimate_weights
from facerf_cli.light.quotient import Quotient
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.models import Models
from facerf_cli.network.inputs import without_cast
from facerf_cli.network.reflectance import ReflectanceNetwork

MEMORY_BYTES = 2 << 30  # for the prediction, by default
_LIGHTS_ON_CPU = 4  # in one batch: more leave the processor's cache and are slower
_LIGHT_SIDE, _QUOTIENT_LIGHTS = 128, 50  # texels on which light is estimated; lights for the photo's quotient
_SEEN_WELL = 0.9  # share of a small texel from which on its colour is the photo's


@dataclass(frozen=True, eq=False)
class Field:
    """The field of a face, by the network alone or corrected by a photo's quotient; a `Reflectance`."""

    models: Models
    face: FaceTexture
    quotient: Quotient | None = None
    memory_bytes: int = MEMORY_BYTES
    bf16: bool = False

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Textures [M, 3, T, T] under M sums, weights [M, L, 3], of lights [L, 3]; see `Reflectance`."""
        return weighted_sum(self.olats(directions, turn), weights)

    @torch.no_grad()
    def olats(self, lights: Tensor, turn: Tensor | None = None) -> Iterator[Tensor]:
        """Yield OLAT textures for unit camera-space lights [L, 3], in batches [l, 3, T, T].

        `turn` [3, 3] rotates the head from its pose in the photo to the target's: N_t = turn N_s (paper,
        'Network Architecture'). The encoder runs once, the decoder once a light.
        """
        network, face, device = self._network, self.face, self.models.device
        normals = face.normals if turn is None else torch.einsum("dc,cij->dij", turn, face.normals)
        normals = normals[None].to(device)
        visible = face.visible[None, None]
        texture = without_cast(face.texture[None], visible, self.models.source_colours)
        source = (texture, face.normals[None], visible)
        with torch.autocast(device.type, torch.bfloat16, enabled=self.bf16):
            encoded = network.encode(*(tensor.to(device) for tensor in source))
        for chunk in torch.split(lights, self._batch(len(lights))):
            # autocast does not enclose the yield, or it would stay on in the caller
            with torch.autocast(device.type, torch.bfloat16, enabled=self.bf16):
                olats = network.decode(encoded, normals, chunk[None].to(device))[0]
            olats = olats.float().cpu()
            yield self.quotient.corrected(olats) if self.quotient else olats

    @property
    def _network(self) -> ReflectanceNetwork:
        if self.models.network is None:
            raise UsageError(
                f"{self.models.checkpoint_name}: a checkpoint without a Reflectance Network, which the field "
                "needs; give --reflectance diffuse-sh with it, or another --checkpoint"
            )
        return self.models.network

    def _batch(self, lights: int) -> int:
        """Lights that are decoded at once."""
        most = _LIGHTS_ON_CPU if self.models.device.type == "cpu" else lights
        texels = self.face.texture.shape[-1] ** 2
        bytes_per_light = self._network.bytes_per_light(texels)
        return max(1, min(most, self.memory_bytes // bytes_per_light))


@dataclass(frozen=True, eq=False)
class OwnLight:
    """The estimated light of a photo over a coarse rig, and the field's quotient under it."""

    light: RigLight
    quotient: Quotient


def own_light(models: Models, face: FaceTexture, held: RigLight | None = None) -> OwnLight:
    """Estimate the light of a photo, on small textures, and the quotient that corrects the field to it.

    A light that is `held` over the frames of a shot, by `light_of_frames`, is not estimated again.
    """
    small, olats = _coarse_olats(models, face)
    light = _estimated([small], [olats]) if held is None else held
    quotient = Quotient.of(small.texture, weighted_sum([olats], light.weights[None])[0], small.visible)
    return OwnLight(light, quotient)


def light_of_frames(models: Models, faces: Sequence[FaceTexture]) -> RigLight:
    """Estimate one light, on small textures, from several frames of a shot together."""
    pairs = [_coarse_olats(models, face) for face in faces]
    return _estimated([small for small, _ in pairs], [olats for _, olats in pairs])


def _coarse_olats(models: Models, face: FaceTexture) -> tuple[FaceTexture, Tensor]:
    small = shrunk(face)
    return small, torch.cat(list(Field(models, small).olats(_coarse_rig())))


def _estimated(faces: Sequence[FaceTexture], olats: Sequence[Tensor]) -> RigLight:
    """The light over the coarse rig that explains what faces show well."""
    seen = [face.visible > _SEEN_WELL for face in faces]
    lit = torch.cat([one[..., mask] for one, mask in zip(olats, seen, strict=True)], -1)
    photos = torch.cat([face.texture[:, mask] for face, mask in zip(faces, seen, strict=True)], -1)
    return RigLight(_coarse_rig(), estimate_weights(lit, photos))


def photo_quotient(models: Models, face: FaceTexture) -> Quotient:
    """Compute the quotient image by which the network's field is corrected to its own photo."""
    return own_light(models, face).quotient


def photo_evidence(face: FaceTexture, keep_eyes: bool = False) -> LightEvidence:
    """The photo's side of the evidence for its light, without lights; InputError if too little is visible.

    The mask is the interior of the face where the photo shows it well. Eyes are left out unless `keep_eyes`,
    since the field of open eyes is not learnt (paper, 'Results').
    """
    small = shrunk(face)
    mask = (small.visible > _SEEN_WELL) & (interior_texture(_LIGHT_SIDE)[0] > 0.5)
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


@cache
def _coarse_rig() -> Tensor:
    return rig_directions(_QUOTIENT_LIGHTS)


def weighted_sum(batches: Iterable[Tensor], weights: Tensor) -> Tensor:
    """Sum OLATs [L, 3, ...], given in batches, by rgb weights [M, L, 3]: [M, 3, ...] (paper, 'Relighting').

    Textures are summed before they are rendered, since a render costs more.
    """
    return weighted_sums(batches, weights, lambda olats: olats)[0]


def weighted_sums(
    batches: Iterable[Tensor], weights: Tensor, *parts: Callable[[Tensor], Tensor]
) -> list[Tensor]:
    """`weighted_sum` of several functions of the same OLATs; the batches are never all held at once."""
    totals, done = [torch.zeros(()) for _ in parts], 0
    for olats in batches:
        some = weights[:, done : done + len(olats)]
        for number, part in enumerate(parts):
            values = part(olats)
            flat = torch.einsum("mlc,lcn->mcn", some, values.flatten(2))
            totals[number] = totals[number] + flat.view(*flat.shape[:2], *values.shape[2:])
        done += len(olats)
    return totals
