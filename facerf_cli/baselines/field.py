"""The neural reflectance field in the company of the baselines (paper, 'Light Estimation')."""

from dataclasses import dataclass

from torch import Tensor

from facerf_cli.baselines.base import Explained
from facerf_cli.light.quotient import Quotient
from facerf_cli.light.sphere import rig_directions
from facerf_cli.pipeline import (
    FaceTexture,
    Models,
    estimate_photo_light,
    explain_photo,
    predict_olat,
    weigh_batches,
)


@dataclass(frozen=True, eq=False)
class Field:
    """A face's field, as the network has it or held to its photo by a quotient."""

    models: Models
    face: FaceTexture
    quotient: Quotient | None = None
    memory_bytes: int = 2 << 30

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """See `Reflectance`."""
        olats = predict_olat(
            self.models, self.face, directions, turn, self.memory_bytes, quotient=self.quotient
        )
        return weigh_batches(olats, weights)


def explain_by_field(models: Models, face: FaceTexture, held_to_photo: bool) -> Explained:
    """The network's field of a face and the light of its photo, over the paper's 150 lights."""
    quotient = explain_photo(models, face) if held_to_photo else None
    return Explained(Field(models, face, quotient), estimate_photo_light(models, face, rig_directions()))
