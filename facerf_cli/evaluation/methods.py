"""The methods of a comparison: a reflectance model over a checkpoint's networks, by the name of its rows."""

from dataclasses import dataclass

from torch import Tensor

from facerf_cli.baselines.explain import explain
from facerf_cli.baselines.field import Field
from facerf_cli.baselines.reflectance import Explained, Kind, Reflectance
from facerf_cli.face.fit import FaceFit
from facerf_cli.pipeline import FaceTexture, Models, explain_photo


@dataclass(frozen=True, eq=False)
class Method:
    """A reflectance model under the name that its figures have."""

    name: str
    kind: Kind
    models: Models

    def reflectance(self, fit: FaceFit, face: FaceTexture, held_to_photo: bool) -> Reflectance:
        """The reflectance alone, where its light is of no use: of the field it is not estimated."""
        if self.kind == "field":
            return Field(self.models, face, explain_photo(self.models, face) if held_to_photo else None)
        return self.explained(fit, face).reflectance

    def explained(self, fit: FaceFit, face: FaceTexture, held_to_photo: bool = False) -> Explained:
        """Reflectance and light; a field that is held to its photo gives it back by construction."""
        return explain(self.kind, self.models, fit, face, held_to_photo)


def relit_by(reflectance: Reflectance, explained: Explained, turn: Tensor | None = None) -> Tensor:
    """The texture [3, T, T] of a reflectance under the light of an explained photo."""
    light = explained.light
    return reflectance.relit(light.directions, light.weights[None], turn)[0]
