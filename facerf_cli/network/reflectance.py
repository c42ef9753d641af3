"""Base class of the Reflectance Networks.

A new form is one file with a `ReflectanceNetwork`, and one line in `checkpoint.REFLECTANCE_FORMS`;
`reflectance_paper.py` is the shortest.
"""

from typing import Any

from torch import Tensor

from facerf_cli.network.base import SavedNetwork

_DECODER_CHANNELS = 220  # that a decoder holds at once for each light, at its working side
_TEXTURE_CHANNELS = 16  # that its output holds at once for each light, at the texture's side


class ReflectanceNetwork(SavedNetwork):
    """Predict OLAT textures from a texture, its normals and lights (paper, 'Network Architecture').

    The encoder runs once per face, the decoder once per light. Lights and normals are in camera space; all
    textures are scene-linear.
    """

    rig_lights: int = 0  # number of lights whose shadows on the mean face are stored; 0: needs no mean face

    @property
    def has_mean_face(self) -> bool:
        """Whether the mean face is stored."""
        return False

    def set_mean_face(self, normals: Tensor, visibility: Tensor, directions: Tensor) -> None:
        """Store the mean face (head frame): normals [3, T, T], visibility [L, T, T], directions [L, 3].

        A form without a mean face ignores it. Raises ValueError if L is not `rig_lights`.
        """

    def encode(self, texture: Tensor, normals_source: Tensor, visible: Tensor) -> Any:
        """Encode linear textures and camera-space normals [B, 3, T, T]; visible [B, 1, T, T] in 0..1.

        The result is for `decode`; its `exposure` [B, 1, 1, 1] is the textures' divisor.
        """
        raise NotImplementedError

    def decode(self, encoded: Any, normals_target: Tensor, lights: Tensor) -> Tensor:
        """Decode non-negative OLAT textures [B, L, 3, T, T] for lights [B, L, 3], normals [B, 3, T, T]."""
        raise NotImplementedError

    def decode_root(self, encoded: Any, normals_target: Tensor, lights: Tensor) -> Tensor:
        """Decode `inputs.to_root` of the textures over `exposure` [B, L, 3, T, T]; may be negative."""
        raise NotImplementedError

    def bytes_per_light(self, texels: int) -> int:
        """Return the decoder's memory for one light of one face, for a texture with this many texels (T x T).

        It is the memory of the form `default`; by number of channels, the form `paper` needs less.
        """
        return 4 * (_DECODER_CHANNELS * self.settings.side**2 + _TEXTURE_CHANNELS * texels)
