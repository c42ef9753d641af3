"""What an importer makes of a publisher's files, before it is carried to the canonical topology."""

from dataclasses import dataclass

import numpy as np

EXPRESSION_STD = 0.3  # of a full blendshape: the spread that a coefficient of 1 stands for


@dataclass(frozen=True)
class SourceHead:
    """What of a model's own mesh makes its whole head.

    triangles [F, 3] in the source's vertex ids; part [N] uint8 into `HEAD_PARTS`; eyes: the vertex ids of
    each ball, a closed surface whose cornea looks along the gaze.
    """

    triangles: np.ndarray
    part: np.ndarray
    eyes: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class SourceModel:
    """A morphable model in its own topology: metres, y up, z out of the face; bases in standard deviations.

    mean [N, 3], identity [Ki, N, 3], expression [Ke, N, 3], triangles [F, 3] of the outer surface,
    landmarks [68, 3]: where the 68 points lie on the mean.
    """

    name: str
    licence: str
    mean: np.ndarray
    identity: np.ndarray
    expression: np.ndarray
    expression_names: tuple[str, ...]
    triangles: np.ndarray
    landmarks: np.ndarray
    head: SourceHead | None = None
