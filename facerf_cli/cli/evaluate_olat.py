"""`facerf evaluate olat`: single lights predicted for held-out people (the paper's Tables 1 and 3)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from facerf_cli.cli.batch import Item
from facerf_cli.cli.evaluation_items import (
    DatasetArgument,
    EveryOption,
    MethodOptions,
    RefitOption,
    SplitOption,
    every_nth,
    load_before,
    load_methods,
    no_part_of_preset,
    people_items,
    read_split,
    refuse_without_field,
    require_enough,
)
from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.evaluation_run import run_protocol
from facerf_cli.cli.options import FaceModelOption, settings_of
from facerf_cli.cli.photo_options import PhotoOptions

if TYPE_CHECKING:
    from facerf_cli.dataset.dataset import Dataset
    from facerf_cli.dataset.pairs import Pair
    from facerf_cli.evaluation.case import Comparison

_PAPER_MAPS, _PAPER_SAME, _PAPER_DIFFERENT = 160, 3900, 8100  # paper, 'Quantitative Evaluations'


def olat(
    context: typer.Context,
    dataset: DatasetArgument,
    options: EvaluateOptions,
    split: SplitOption = "test",
    every: EveryOption = 1,
    refit: RefitOption = False,
    network_alone: Annotated[
        bool, typer.Option("--network-alone", help="Do not hold the field to the photo, as `relight` does.")
    ] = False,
    face_model: FaceModelOption = "builtin",
) -> int:
    """Predict single lights of held-out people from pictures in natural light (the paper's Table 1).

    Each source of the split's pairs is unwrapped by its fit and relit by the one light that the pair names,
    in the target camera's pose; the truth is that light of the target's stack. Figures are for the same pose
    and for different ones, by the angle of the light and by skin tone where the capture says it. The row
    'lambert' is the source's own texture under the cosine of the light: what any method has to beat. A second
    checkpoint, --against without_normals.safetensors, makes the paper's Table 3.
    """
    from facerf_cli.evaluation.summary import TABLE_1, TABLE_3, Layout

    settings = settings_of(context)
    no_part_of_preset(options, every)
    refuse_without_field(context, options, "network_alone")
    photo = PhotoOptions(settings, face_model=face_model)
    prepared, pairs = read_split(dataset, split, face_model, refit)
    chosen = _paper_pairs(dataset, pairs) if options.preset else every_nth(pairs, every)
    methods = MethodOptions.of(photo, options)
    load_before(methods, options)
    work = _Olat(methods, prepared, chosen, options.keep_eyes, refit, network_alone)
    layout = Layout(
        name="olat",
        title="Single lights of held-out people",
        metrics=("si_mse", "si_mse_clipped", "ssim", "tone_drift_deg"),
        by=("pose", "turn", "angle", "tone"),
        published=TABLE_1 + (TABLE_3 if options.against else ()),
        notes=_notes(split, refit, network_alone),
    )
    items = people_items(dataset, list(chosen), options.output)
    return run_protocol(layout, items, work, options, settings, photo)


def _notes(split: str, refit: bool, network_alone: bool) -> tuple[str, ...]:
    """What is said beside the figures."""
    held = "The field is the network's own." if network_alone else "The field is held to its source picture."
    fits = (
        "Each picture is fitted by its own landmarks." if refit else "A person's pictures are fitted at once."
    )
    return (
        f"Split {split}. {held} {fits}",
        "si_mse_clipped has the truth clipped at white, as a camera keeps it: a glint else outweighs a face.",
        "tone_drift_deg is of the skin under lights within 25 degrees of the camera's axis.",
    )


def _paper_pairs(folder: Path, pairs: "Mapping[str, list[Pair]]") -> "dict[str, list[Pair]]":
    """As many pairs as the paper has, evenly over people and under its number of maps."""
    from facerf_cli.evaluation.people import evenly

    maps = dict.fromkeys(pair.envmap for of_subject in pairs.values() for pair in of_subject)
    per_subject = 2 * _PAPER_DIFFERENT / len(pairs)  # half of the pairs change the camera
    require_enough(len(maps), _PAPER_MAPS, "maps", folder, per_subject)
    kept = set(list(maps)[:_PAPER_MAPS])
    chosen: dict[str, list[Pair]] = {}
    for same, most in ((True, _PAPER_SAME), (False, _PAPER_DIFFERENT)):
        groups = {
            name: [p for p in members if p.envmap in kept and (p.source_camera == p.target_camera) is same]
            for name, members in pairs.items()
        }
        found = evenly(groups, most)
        kind = "pairs of the same pose" if same else "pairs of different poses"
        require_enough(sum(map(len, found.values())), most, kind, folder, per_subject)
        for name, members in found.items():
            chosen[name] = sorted([*chosen.get(name, []), *members], key=lambda pair: pair.index)
    return chosen


@dataclass(frozen=True, eq=False)
class _Olat:
    """Compares one person's pairs."""

    methods: MethodOptions
    dataset: "Dataset"
    pairs: "Mapping[str, list[Pair]]"
    keep_eyes: bool
    refit: bool
    network_alone: bool

    def __call__(self, item: Item) -> "Iterator[Comparison]":
        from facerf_cli.evaluation.people import Person
        from facerf_cli.evaluation.protocols.olat import compare_olats

        methods = load_methods(self.methods)
        person = Person(methods[0].models.face, self.dataset, item.name, self.keep_eyes, self.refit)
        return compare_olats(person, self.pairs[item.name], methods, not self.network_alone)
