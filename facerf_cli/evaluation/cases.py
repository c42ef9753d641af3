"""What every protocol yields, a picture at a time: the question, the truth, and the methods' answers."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Case:
    """One picture to be measured.

    `name` is a path without suffix, unique in its run: predictions of other methods are looked up by it.
    `person` is whose face it is: intervals draw persons anew. Facts that are text break the tables down
    ('pose': 'same pose'); numbers go to the list of pictures only.
    """

    name: str
    person: str
    facts: Mapping[str, str | float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Comparison:
    """A case with its pictures, all scene-linear Rec.709 [H, W, 3] of one frame.

    mask [H, W] in 0..1 is where they are compared. `source` is what the methods saw, in its own frame.
    landmarks_px [68, 2] are the truth's, for the face-recognition distance; None leaves that out. `extra`
    holds figures of each method that only the protocol can take ('light_error_deg'). `grey_as_given` says
    how files of other methods are read (`others.py`).
    """

    case: Case
    truth: np.ndarray
    mask: np.ndarray
    predictions: Mapping[str, np.ndarray]  # by method
    source: np.ndarray | None = None
    landmarks_px: np.ndarray | None = None
    extra: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # by method
    grey_as_given: bool = False
