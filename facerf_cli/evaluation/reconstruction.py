"""Photos explained by a method's reflectance and light, and rendered again (paper, Tables 2 and 4).

The face is rendered alone, by the network's own field: with the photo's correction or the photo's own detail
it would be right by construction. Table 4 compares the fitted face with the mean face in its pose: both are
fitted to the same landmarks, or regressed from the same crop, and compared inside the part of the mask that
they share. The paper trained networks for the mean face; such a checkpoint can be given.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch

from facerf_cli.evaluation.measure import Comparison
from facerf_cli.evaluation.people import Method, SourceFace, common_mask
from facerf_cli.evaluation.summary import PublishedFigure, paper_table_2
from facerf_cli.face.head import Head
from facerf_cli.image.colour import luminance
from facerf_cli.image.metrics import light_error_deg
from facerf_cli.light.sphere import RigLight
from facerf_cli.relighting.composition import Target

FULL, MEAN = "all components", "mean face"
_CELEBA = "130 images of CelebA-HQ; other data than ours"
TABLE_2_RECONSTRUCTION = (
    *paper_table_2("si_mse", _CELEBA, ((0.004, 0.002), (0.017, 0.015), (0.010, 0.008), (0.007, 0.003))),
    *paper_table_2(
        "face_distance", _CELEBA, ((0.550, 0.080), (0.650, 0.076), (0.685, 0.067), (0.762, 0.075))
    ),
)
TABLE_4 = (
    PublishedFigure(FULL, "si_mse", 0.004, 0.002, None, "Table 4", _CELEBA, 3),
    PublishedFigure(MEAN, "si_mse", 0.011, 0.005, None, "Table 4", _CELEBA, 3),
    PublishedFigure(FULL, "face_distance", 0.550, 0.080, None, "Table 4", _CELEBA, 3),
    PublishedFigure(MEAN, "face_distance", 0.550, 0.073, None, "Table 4", _CELEBA, 3),
)


@torch.no_grad()
def reconstruct(faces: Sequence[SourceFace], methods: Sequence[Method]) -> Iterator[Comparison]:
    """A portrait's crop next to each method's reconstruction.

    Where the true light is known, each has the error of its brightest direction.
    """
    (face,) = faces
    truth = None if face.origin is None else face.origin[0].light(face.origin[1])
    predictions, extra = {}, {}
    for method in methods:
        predictions[method.name], light = reconstruction(method, face.portrait.by(method.models).head)
        extra[method.name] = light_errors(light, truth)
    mask = common_mask(face.portrait.by(method.models).view for method in methods)
    head = face.portrait.by(methods[0].models).head
    yield Comparison(face.case, head.cropped, mask, predictions, head.cropped, head.landmarks_px, extra)


@torch.no_grad()
def compare_geometries(
    faces: Sequence[SourceFace], forms: Mapping[str, Sequence[Method]]
) -> Iterator[Comparison]:
    """A portrait reconstructed with each geometry's methods; a row has its name, and its method's if many."""
    (face,) = faces
    predictions, views = {}, []
    for name, methods in forms.items():
        for method in methods:
            row = name if len(methods) == 1 else f"{name}, {method.name}"
            fitted = face.portrait.by(method.models)
            predictions[row] = reconstruction(method, fitted.head)[0]
            views.append(fitted.view)
    head = face.portrait.by(forms[FULL][0].models).head
    yield Comparison(
        face.case, head.cropped, common_mask(views), predictions, head.cropped, head.landmarks_px
    )


def reconstruction(method: Method, head: Head) -> tuple[np.ndarray, RigLight]:
    """The face rendered by its own reflectance under its own light [S, S, 3], and that light."""
    explained = method.explained(head)
    target = Target(composite="face")
    return method.image(head, explained.reflectance, explained.light, target), explained.light


def light_errors(light: RigLight, truth: tuple[np.ndarray, np.ndarray] | None) -> dict[str, float]:
    """'light_error_deg' between the brightest single lights; empty if the truth is not known.

    `truth` has the directions [L, 3] and the weights [L, 3] of the true light.
    """
    if truth is None:
        return {}
    estimated = brightest(light.directions.numpy(), light.weights.numpy())
    return {"light_error_deg": light_error_deg(estimated, brightest(*truth))}


def brightest(directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The direction [3] of the light of the largest luminance, of directions [L, 3] and weights [L, 3]."""
    return np.asarray(directions[luminance(weights).argmax()])
