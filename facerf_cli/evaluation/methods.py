"""The methods of a comparison: a reflectance model, a checkpoint's networks, and a name for the rows."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from facerf_cli.baselines import RelightKind
from facerf_cli.baselines.base import Explained, Reflectance
from facerf_cli.composite import Target
from facerf_cli.errors import UsageError
from facerf_cli.face.head import Head
from facerf_cli.light.sphere import RigLight
from facerf_cli.models import Models
from facerf_cli.pipeline import (
    DEFAULT_ESTIMATOR,
    Estimator,
    composition_of,
    explain,
    reflectance_of,
    relight,
    relit_by,
)


@dataclass(frozen=True, eq=False)
class Method:
    """A reflectance model under the name of its figures; its images are those of `facerf relight`."""

    name: str
    kind: RelightKind
    models: Models
    estimator: Estimator = DEFAULT_ESTIMATOR

    def explained(self, head: Head, network_alone: bool = True) -> Explained:
        """Reflectance and light; a field with the photo's correction gives the photo back by construction."""
        if self.kind == "portrait":
            raise UsageError("--reflectance portrait: is measured on whole photos; use evaluate yale-b")
        return explain(self.models, head, self.kind, network_alone, self.estimator)

    def image(self, head: Head, reflectance: Reflectance, light: RigLight, target: Target) -> np.ndarray:
        """The face alone [S, S, 3] in the crop of the target's fit, under one light."""
        return relight(self.models, None, head, light, target, reflectance).pixels

    def images(
        self,
        photo: np.ndarray | None,
        head: Head,
        directions: Tensor,
        weights: Tensor,
        target: Target,
        network_alone: bool,
    ) -> Iterator[np.ndarray]:
        """Yield images under M sums, weights [M, L, 3], of lights [L, 3]; in the photo, if it is given."""
        reflectance = reflectance_of(self.models, head, self.kind, network_alone, photo=photo)
        composition = composition_of(self.models, photo, head, reflectance, target)
        relit = relit_by(composition, head, reflectance, directions, weights, target)
        for of_row in relit:
            yield composition.image(of_row).pixels
