"""Two images of one person in different poses and lights, with their reflectances exchanged (paper, Table 2).

Image A is rendered from B's reflectance, turned to A's pose, on A's fitted mesh under A's light; the same
method estimates that light with A's own reflectance. So a reflectance is measured where it was not read.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from facerf_cli.baselines.base import Explained
from facerf_cli.composite import Target
from facerf_cli.dataset.pairs import Pair
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.crop_view import CropView, angle_of, turn_class
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.people import Person
from facerf_cli.face.head import Head

Sides = tuple["Side", "Side"]


@dataclass(frozen=True, eq=False)
class Side:
    """One of two images: the name of its comparison, its view and its head."""

    case: Case
    view: CropView
    head: Head


@torch.no_grad()
def transfer(sides: Sides, methods: Sequence[Method], network_alone: bool = True) -> Iterator[Comparison]:
    """Both images, each by the other's reflectance."""
    explained = [
        {method.name: method.explained(side.head, network_alone) for method in methods} for side in sides
    ]
    for side, own, other, others in zip(sides, explained, sides[::-1], explained[::-1], strict=True):
        yield _rendered(side, own, other, others, methods)


def _rendered(
    side: Side,
    own: Mapping[str, Explained],
    other: Side,
    others: Mapping[str, Explained],
    methods: Sequence[Method],
) -> Comparison:
    """An image from its own light and the other's reflectance."""
    view, target = side.view, Target(side.view.fit, "face")
    predictions = {
        method.name: method.image(other.head, others[method.name].reflectance, own[method.name].light, target)
        for method in methods
    }
    turn_deg = angle_of(other.view.fit.turn_to(view.fit.rotation))
    facts = {**side.case.facts, "turn": turn_class(turn_deg), "turn_deg": turn_deg}
    return Comparison(
        replace(side.case, facts=facts),
        side.head.cropped,
        view.mask,
        predictions,
        other.head.cropped,
        view.fit.landmarks_px.numpy(),
    )


def transfer_person(
    person: Person,
    couples: Iterable[tuple[Pair, Pair]],
    methods: Sequence[Method],
    network_alone: bool = True,
) -> Iterator[Comparison]:
    """Couples of the sources of a person's pairs."""
    for first, second in couples:
        sides = _side(person, first, second), _side(person, second, first)
        yield from transfer(sides, methods, network_alone)


def _side(person: Person, pair: Pair, other: Pair) -> Side:
    name = f"{pair.subject}/{pair.index:05d}_by_{other.index:05d}"
    case = Case(name, pair.subject, person.facts | {"map": pair.envmap})
    return Side(case, person.crop(pair.source_camera).view, person.head(pair, person.source(pair)))


def couples_of(pairs: Sequence[Pair]) -> list[tuple[Pair, Pair]]:
    """Pair up a person's pairs, each once, in order: sources of different cameras and different maps."""
    couples: list[tuple[Pair, Pair]] = []
    waiting: list[Pair] = []
    for pair in pairs:
        fits = (p for p in waiting if p.source_camera != pair.source_camera and p.envmap != pair.envmap)
        first = next(fits, None)
        if first is None:
            waiting.append(pair)
        else:
            waiting.remove(first)
            couples.append((first, pair))
    return couples
