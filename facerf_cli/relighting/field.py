"""The neural reflectance field of one face: its texture under any single light, and any sum of lights."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.head import FaceTexture
from facerf_cli.face.topology import interior_texture, region_mask
from facerf_cli.light.estimate import LightEvidence
from facerf_cli.light.quotient import Quotient
from facerf_cli.network.inputs import is_grey, without_cast
from facerf_cli.network.precision import mixed_precision
from facerf_cli.network.reflectance import ReflectanceNetwork
from facerf_cli.relighting.models import Models

MEMORY_BYTES = 2 << 30  # for the prediction, by default
_LIGHTS_ON_CPU = 4  # in one batch: more leave the processor's cache and are slower
_LIGHT_SIDE = 128  # texels on which light is estimated
SEEN_WELL = 0.9  # share of a small texel from which on its colour is the photo's


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
        source, grey = (texture, face.normals[None], visible), is_grey(face.texture)
        with mixed_precision(device, self.bf16):
            encoded = network.encode(*(tensor.to(device) for tensor in source))
        for chunk in torch.split(lights, self._batch(len(lights))):
            # autocast does not enclose the yield, or it would stay on in the caller
            with mixed_precision(device, self.bf16):
                olats = network.decode(encoded, normals, chunk[None].to(device))[0]
            olats = olats.float().cpu()
            olats = olats.mean(1, keepdim=True).expand_as(olats) if grey else olats
            yield self.quotient.corrected(olats) if self.quotient else olats

    @property
    def _network(self) -> ReflectanceNetwork:
        return self.models.networks.reflectance

    def _batch(self, lights: int) -> int:
        """Lights that are decoded at once."""
        most = _LIGHTS_ON_CPU if self.models.device.type == "cpu" else lights
        texels = self.face.texture.shape[-1] ** 2
        bytes_per_light = self._network.bytes_per_light(texels)
        return max(1, min(most, self.memory_bytes // bytes_per_light))


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
