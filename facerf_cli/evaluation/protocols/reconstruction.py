"""Photos explained by a method's reflectance and light, and put together again (paper, Table 2).

The field is taken as the network has it: held to its photo it would be exact by construction.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import torch

from facerf_cli.colour import luminance
from facerf_cli.dataset.pairs import Pair
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.methods import Method, View, relit_by
from facerf_cli.evaluation.people import Person
from facerf_cli.light.sphere import RigLight
from facerf_cli.metrics import light_error_deg
from facerf_cli.pipeline import FaceTexture


@torch.no_grad()
def reconstruct(
    case: Case,
    view: View,
    image: np.ndarray,
    face: FaceTexture,
    methods: Sequence[Method],
    true_light: tuple[np.ndarray, np.ndarray] | None = None,
) -> Comparison:
    """A picture [S, S, 3] of the view beside each method's own.

    `true_light`, directions [L, 3] and weights [L, 3], gives each the error of its brightest direction.
    """
    predictions, extra = {}, {}
    for method in methods:
        explained = method.explained(view.fit, face)
        predictions[method.name] = view.image(relit_by(explained.reflectance, explained))
        extra[method.name] = light_errors(explained.light, true_light)
    return Comparison(case, image, view.mask, predictions, image, view.fit.landmarks_px.numpy(), extra)


def reconstruct_person(
    person: Person, pairs: Iterable[Pair], methods: Sequence[Method]
) -> Iterator[Comparison]:
    """The sources of a person's pairs."""
    for pair in pairs:
        image, face = person.source(pair)
        case = Case(f"{pair.subject}/{pair.index:05d}", pair.subject, person.facts | {"map": pair.envmap})
        view = person.shot(pair.source_camera).view
        yield reconstruct(case, view, image, face, methods, person.light(pair))


def light_errors(light: RigLight, truth: tuple[np.ndarray, np.ndarray] | None) -> dict[str, float]:
    """'light_error_deg' between the brightest single lights; nothing where the truth is not known."""
    if truth is None:
        return {}
    found = brightest(light.directions.numpy(), light.weights.numpy())
    return {"light_error_deg": light_error_deg(found, brightest(*truth))}


def brightest(directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The direction [3] of the light of the largest luminance, of directions [L, 3] and weights [L, 3]."""
    return np.asarray(directions[luminance(weights).argmax()])
