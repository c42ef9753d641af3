"""Reconstruction with the fitted face and with the mean face in its pose (paper, Table 4).

Both forms are fitted to the same landmarks and compared inside the part of the mask that they share. The
paper trained a network for the mean face; where there is such a checkpoint, it can be given.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.methods import Method, View, relit_by
from facerf_cli.pipeline import FaceTexture

FULL, MEAN = "all components", "mean face"


@dataclass(frozen=True, eq=False)
class Form:
    """One geometry of a photo: the face seen with it, its texture, and the methods over its face model."""

    view: View
    face: FaceTexture
    methods: Sequence[Method]


@torch.no_grad()
def compare_geometries(case: Case, image: np.ndarray, forms: Mapping[str, Form]) -> Comparison:
    """A picture [S, S, 3] reconstructed in each form; a row is named by its form, and its method if many."""
    mask = np.minimum.reduce([form.view.mask for form in forms.values()])
    predictions = {}
    for name, form in forms.items():
        for method in form.methods:
            explained = method.explained(form.view.fit, form.face)
            row = name if len(form.methods) == 1 else f"{name}, {method.name}"
            predictions[row] = form.view.image(relit_by(explained.reflectance, explained))
    landmarks_px = next(iter(forms.values())).view.fit.landmarks_px.numpy()
    return Comparison(case, image, mask, predictions, image, landmarks_px)
