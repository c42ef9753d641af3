"""Two images of one person in different poses and lights, with their reflectances exchanged (paper, Table 2).

Image A is rendered from B's reflectance, turned to A's pose, on A's fitted mesh under A's light; the same
method estimates that light with A's own reflectance. So a reflectance is measured where it was not read.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath

import torch

from facerf_cli.baselines.base import Explained
from facerf_cli.dataset.pairs import Pair
from facerf_cli.evaluation.measure import Comparison
from facerf_cli.evaluation.people import Method, SourceFace, angle_of, common_mask, turn_class
from facerf_cli.evaluation.summary import paper_table_2
from facerf_cli.relighting.composition import Target

_TEST_SET = "86 light-stage images in natural light; other data than ours"
TABLE_2_TRANSFER = (
    *paper_table_2("si_mse", _TEST_SET, ((0.002, 0.001), (0.018, 0.011), (0.007, 0.005), (0.003, 0.001))),
    *paper_table_2(
        "face_distance", _TEST_SET, ((0.482, 0.084), (0.605, 0.092), (0.644, 0.077), (0.689, 0.076))
    ),
)
_Explained = Mapping[str, Explained]  # by method


@torch.no_grad()
def transfer(
    faces: Sequence[SourceFace], methods: Sequence[Method], network_alone: bool
) -> Iterator[Comparison]:
    """Both images, each by the other's reflectance."""
    first, second = faces
    by_first, by_second = (
        {m.name: m.explained(face.portrait.by(m.models).head, network_alone) for m in methods}
        for face in faces
    )
    yield _rendered(first, by_first, second, by_second, methods)
    yield _rendered(second, by_second, first, by_first, methods)


def _rendered(
    face: SourceFace, own: _Explained, other: SourceFace, others: _Explained, methods: Sequence[Method]
) -> Comparison:
    """An image from its own light and the other's reflectance."""
    predictions, views = {}, []
    for method in methods:
        mine, theirs = face.portrait.by(method.models), other.portrait.by(method.models)
        target = Target(mine.view.fit, "face")
        reflectance = others[method.name].reflectance
        predictions[method.name] = method.image(theirs.head, reflectance, own[method.name].light, target)
        views.append(mine.view)
    first, source = (portrait.by(methods[0].models).head for portrait in (face.portrait, other.portrait))
    turn_deg = angle_of(source.fit.turn_to(first.fit.rotation))
    facts = {**face.case.facts, "turn": turn_class(turn_deg), "turn_deg": turn_deg}
    name = f"{face.case.name}_by_{PurePosixPath(other.case.name).name}"
    return Comparison(
        replace(face.case, name=name, facts=facts),
        first.cropped,
        common_mask(views),
        predictions,
        source.cropped,
        first.landmarks_px,
    )


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
