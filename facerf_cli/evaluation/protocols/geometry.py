"""Reconstruction with the fitted face and with the mean face in its pose (paper, Table 4).

Both geometries are fitted to the same landmarks, or regressed from the same crop, and compared inside the
part of the mask that they share. The paper trained networks for the mean face; such a checkpoint can be
given.
"""

from collections.abc import Mapping, Sequence

import torch

from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.people import Portrait, common_mask
from facerf_cli.evaluation.protocols.reconstruction import reconstruction

FULL, MEAN = "all components", "mean face"


@torch.no_grad()
def compare_geometries(case: Case, portrait: Portrait, forms: Mapping[str, Sequence[Method]]) -> Comparison:
    """A portrait reconstructed with each geometry's methods; a row has its name, and its method's if many."""
    predictions, views = {}, []
    for name, methods in forms.items():
        for method in methods:
            row = name if len(methods) == 1 else f"{name}, {method.name}"
            sitting = portrait.by(method.models)
            predictions[row] = reconstruction(method, sitting.head)[0]
            views.append(sitting.view)
    head = portrait.by(forms[FULL][0].models).head
    return Comparison(case, head.cropped, common_mask(views), predictions, head.cropped, head.landmarks_px)
