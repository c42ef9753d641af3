"""Two images of one person in different poses and lights, with their reflectances exchanged (paper, Table 2).

Image A is rendered from B's reflectance, turned to A's pose, on A's fitted mesh under A's light; the same
method estimates that light with A's own reflectance. So a reflectance is measured where it was not read.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from facerf_cli.baselines.base import Explained
from facerf_cli.composite import Target
from facerf_cli.dataset.pairs import Pair
from facerf_cli.errors import InputError
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.crop_view import angle_of, turn_class
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.people import Person, Portrait, common_mask
from facerf_cli.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
Sides = tuple["Side", "Side"]


@dataclass(frozen=True, eq=False)
class Side:
    """One of two images, and the name of its comparison."""

    case: Case
    portrait: Portrait

    def explained(self, methods: Sequence[Method], network_alone: bool) -> dict[str, Explained]:
        """Reflectance and light that each method reads from it."""
        return {m.name: m.explained(self.portrait.by(m.models).head, network_alone) for m in methods}


@torch.no_grad()
def transfer(sides: Sides, methods: Sequence[Method], network_alone: bool = True) -> Iterator[Comparison]:
    """Both images, each by the other's reflectance."""
    explained = [side.explained(methods, network_alone) for side in sides]
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
    predictions, views = {}, []
    for method in methods:
        mine, theirs = side.portrait.by(method.models), other.portrait.by(method.models)
        target = Target(mine.view.fit, "face")
        reflectance = others[method.name].reflectance
        predictions[method.name] = method.image(theirs.head, reflectance, own[method.name].light, target)
        views.append(mine.view)
    first, source = (portrait.by(methods[0].models).head for portrait in (side.portrait, other.portrait))
    turn_deg = angle_of(source.fit.turn_to(first.fit.rotation))
    facts = {**side.case.facts, "turn": turn_class(turn_deg), "turn_deg": turn_deg}
    return Comparison(
        replace(side.case, facts=facts),
        first.cropped,
        common_mask(views),
        predictions,
        source.cropped,
        first.landmarks_px,
    )


def transfer_person(
    person: Person,
    couples: Iterable[tuple[Pair, Pair]],
    methods: Sequence[Method],
    network_alone: bool = True,
) -> Iterator[Comparison]:
    """Couples of the sources of a person's pairs."""
    for first, second in couples:
        try:
            sides = _side(person, first, second), _side(person, second, first)
        except InputError as error:
            log.warning("%s; its couple is left out", error)
            continue
        yield from transfer(sides, methods, network_alone)


def _side(person: Person, pair: Pair, other: Pair) -> Side:
    name = f"{pair.subject}/{pair.index:05d}_by_{other.index:05d}"
    case = Case(name, pair.subject, person.facts | {"map": pair.envmap})
    return Side(case, person.portrait(pair))


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
