"""Photos explained by a method's reflectance and light, and rendered again (paper, Table 2).

The face is rendered alone, by the network's own field: with the photo's correction or the photo's own detail
it would be right by construction.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import torch

from facerf_cli.colour import luminance
from facerf_cli.composite import Target
from facerf_cli.dataset.pairs import Pair
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.people import Person, Portrait, common_mask
from facerf_cli.face.head import Head
from facerf_cli.light.sphere import RigLight
from facerf_cli.metrics import light_error_deg


@torch.no_grad()
def reconstruct(
    case: Case,
    portrait: Portrait,
    methods: Sequence[Method],
    true_light: tuple[np.ndarray, np.ndarray] | None = None,
) -> Comparison:
    """A portrait's crop next to each method's reconstruction.

    `true_light`, directions [L, 3] and weights [L, 3], gives each the error of its brightest direction.
    """
    predictions, extra = {}, {}
    for method in methods:
        predictions[method.name], light = reconstruction(method, portrait.by(method.models).head)
        extra[method.name] = light_errors(light, true_light)
    mask = common_mask(portrait.by(method.models).view for method in methods)
    head = portrait.by(methods[0].models).head
    return Comparison(case, head.cropped, mask, predictions, head.cropped, head.landmarks_px, extra)


def reconstruction(method: Method, head: Head) -> tuple[np.ndarray, RigLight]:
    """The face rendered by its own reflectance under its own light [S, S, 3], and that light."""
    explained = method.explained(head)
    target = Target(composite="face")
    return method.image(head, explained.reflectance, explained.light, target), explained.light


def reconstruct_person(
    person: Person, pairs: Iterable[Pair], methods: Sequence[Method]
) -> Iterator[Comparison]:
    """The sources of a person's pairs."""
    for pair, portrait in person.portraits(pairs):
        case = Case(f"{pair.subject}/{pair.index:05d}", pair.subject, person.facts | {"map": pair.envmap})
        yield reconstruct(case, portrait, methods, person.light(pair))


def light_errors(light: RigLight, truth: tuple[np.ndarray, np.ndarray] | None) -> dict[str, float]:
    """'light_error_deg' between the brightest single lights; empty if the truth is not known."""
    if truth is None:
        return {}
    found = brightest(light.directions.numpy(), light.weights.numpy())
    return {"light_error_deg": light_error_deg(found, brightest(*truth))}


def brightest(directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The direction [3] of the light of the largest luminance, of directions [L, 3] and weights [L, 3]."""
    return np.asarray(directions[luminance(weights).argmax()])
