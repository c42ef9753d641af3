"""Reflectance networks: the interface that every form has, and the forms by name.

A new form is one file with a `SavedNetwork` (`inputs.py`) that fits `ReflectanceNetwork`, and one line in
`REFLECTANCE_FORMS`; `reflectance_paper.py` is the shortest.
"""

from typing import Any, Protocol, Self

from torch import Tensor

from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork
from facerf_cli.network.reflectance_paper import PaperReflectanceNetwork


class ReflectanceNetwork(Protocol):
    """Predict OLAT textures from a texture, its normals and lights (paper, 'Network Architecture').

    A form is also a `torch.nn.Module`; `SavedNetwork` has the last two members, for a dataclass of settings.
    Its encoder runs once a face, its decoder once a light. Lights and normals are in camera space; all
    textures are scene-linear.
    """

    @property
    def rig_lights(self) -> int:
        """Number of lights whose shadows on the mean face the form stores; 0 if it needs no mean face."""

    @property
    def has_mean_face(self) -> bool:
        """True once the mean face is stored."""

    def set_mean_face(self, normals: Tensor, visibility: Tensor, directions: Tensor) -> None:
        """Store the mean face (head frame): normals [3, T, T], visibility [L, T, T], directions [L, 3].

        A form without a mean face ignores it. Raises ValueError if L is not `rig_lights`.
        """

    def encode(self, texture: Tensor, normals_source: Tensor, visible: Tensor) -> Any:
        """Encode textures and normals [B, 3, T, T]; visible [B, 1, T, T] in 0..1.

        The result is for `decode`; its `exposure` [B, 1, 1, 1] is what the textures were divided by.
        """

    def decode(self, encoded: Any, normals_target: Tensor, lights: Tensor) -> Tensor:
        """Decode non-negative OLAT textures [B, L, 3, T, T] for lights [B, L, 3], normals [B, 3, T, T]."""

    def decode_root(self, encoded: Any, normals_target: Tensor, lights: Tensor) -> Tensor:
        """Decode `inputs.to_root` of the textures over `exposure` [B, L, 3, T, T]; may be negative."""

    def bytes_per_light(self, texels: int) -> int:
        """Memory of the decoder for one light of one face, for a texture of so many texels (T x T)."""

    def as_metadata(self) -> dict[str, Any]:
        """Form and settings, for a checkpoint."""

    @classmethod
    def from_metadata(cls, metadata: dict[str, Any]) -> Self:
        """Make an untrained network; settings that are missing have their defaults.

        Raises KeyError, TypeError or ValueError if the settings describe no network.
        """


REFLECTANCE_FORMS: dict[str, type[ReflectanceNetwork]] = {
    "default": DefaultReflectanceNetwork,
    "paper": PaperReflectanceNetwork,
}
