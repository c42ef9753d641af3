"""Two pictures of one person in different poses and lights, reflectances exchanged (paper, Table 2).

Picture A is made of B's reflectance, turned to A's pose, on A's fitted mesh under A's light; the light is
that which the same method finds with A's own reflectance. So what is measured is a reflectance where it was
not read off.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from facerf_cli.baselines.base import Explained
from facerf_cli.dataset.pairs import Pair
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.methods import Method, View, angle_of, relit_by, turn_class
from facerf_cli.evaluation.people import Person
from facerf_cli.pipeline import FaceTexture, turn_to

Sides = tuple["Side", "Side"]


@dataclass(frozen=True, eq=False)
class Side:
    """One of two pictures [S, S, 3], its view and its texture, and what its comparison is called."""

    case: Case
    view: View
    image: np.ndarray
    face: FaceTexture


@torch.no_grad()
def transfer(sides: Sides, methods: Sequence[Method], held_to_photo: bool = False) -> Iterator[Comparison]:
    """Both pictures, each by the other's reflectance, which may be held to that other photo."""
    explained = [
        {method.name: method.explained(side.view.fit, side.face, held_to_photo) for method in methods}
        for side in sides
    ]
    for side, own, other, others in zip(sides, explained, sides[::-1], explained[::-1], strict=True):
        yield _made_of(side, own, other, others)


def _made_of(
    side: Side, own: Mapping[str, Explained], other: Side, others: Mapping[str, Explained]
) -> Comparison:
    """A picture by its own light and the other's reflectance."""
    view = side.view
    turn = turn_to(other.view.fit, view.fit.rotation)
    predictions = {
        name: view.image(relit_by(others[name].reflectance, explained, turn))
        for name, explained in own.items()
    }
    turn_deg = angle_of(turn)
    facts = {**side.case.facts, "turn": turn_class(turn_deg), "turn_deg": turn_deg}
    return Comparison(
        replace(side.case, facts=facts),
        side.image,
        view.mask,
        predictions,
        other.image,
        view.fit.landmarks_px.numpy(),
    )


def transfer_person(
    person: Person,
    couples: Iterable[tuple[Pair, Pair]],
    methods: Sequence[Method],
    held_to_photo: bool = False,
) -> Iterator[Comparison]:
    """Couples of the sources of a person's pairs."""
    for first, second in couples:
        yield from transfer(
            (_side(person, first, second), _side(person, second, first)), methods, held_to_photo
        )


def _side(person: Person, pair: Pair, other: Pair) -> Side:
    image, face = person.source(pair)
    name = f"{pair.subject}/{pair.index:05d}_by_{other.index:05d}"
    facts = person.facts | {"map": pair.envmap}
    return Side(Case(name, pair.subject, facts), person.shot(pair.source_camera).view, image, face)


def couples_of(pairs: Sequence[Pair]) -> list[tuple[Pair, Pair]]:
    """A person's pairs two by two, each once: sources of different cameras and different maps, in order."""
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
