"""Reconstruction with the fitted face and with the mean face in its pose (paper, Table 4).

Both geometries are fitted to the same landmarks and compared inside the part of the mask that they share. The
paper trained a network for the mean face; such a checkpoint can be given.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.crop_view import CropView
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.protocols.reconstruction import reconstruction
from facerf_cli.face.head import Head

FULL, MEAN = "all components", "mean face"


@dataclass(frozen=True, eq=False)
class Form:
    """One geometry of a photo: its view, its head, and the methods over its face model."""

    view: CropView
    head: Head
    methods: Sequence[Method]


@torch.no_grad()
def compare_geometries(case: Case, image: np.ndarray, forms: Mapping[str, Form]) -> Comparison:
    """An image [S, S, 3] reconstructed with each geometry; a row has its name, and its method's if many."""
    mask = np.minimum.reduce([form.view.mask for form in forms.values()])
    predictions = {}
    for name, form in forms.items():
        for method in form.methods:
            row = name if len(form.methods) == 1 else f"{name}, {method.name}"
            predictions[row] = reconstruction(method, form.head)[0]
    landmarks_px = next(iter(forms.values())).view.fit.landmarks_px.numpy()
    return Comparison(case, image, mask, predictions, image, landmarks_px)
