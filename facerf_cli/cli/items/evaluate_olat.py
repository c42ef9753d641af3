"""`facerf evaluate olat`: single lights predicted for held-out people (the paper's Tables 1 and 3)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.inputs import Item
from facerf_cli.cli.items.evaluation import (
    MethodOptions,
    every_nth,
    load_methods,
    note_of_chosen,
    people_items,
    person_of,
    prepare_methods,
    read_split,
    require_enough,
)
from facerf_cli.cli.items.evaluation_run import run_protocol
from facerf_cli.cli.photo_options import PhotoOptions
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair
from facerf_cli.evaluation.case import Comparison
from facerf_cli.evaluation.people import evenly
from facerf_cli.evaluation.protocols.olat import compare_olats
from facerf_cli.evaluation.published import TABLE_1, TABLE_3
from facerf_cli.evaluation.summary import Layout

_PAPER_MAPS, _PAPER_SAME, _PAPER_DIFFERENT = 160, 3900, 8100  # paper, 'Quantitative Evaluations'


def run_olat(
    dataset: Path,
    options: EvaluateOptions,
    photo: PhotoOptions,
    split: str,
    every: int,
    joint_fit: bool,
    network_alone: bool,
) -> int:
    """Measure a dataset's split; the exit code."""
    prepared, pairs = read_split(dataset, split, photo.face_model, joint_fit)
    chosen = _paper_pairs(dataset, pairs) if options.preset else every_nth(pairs, every)
    methods = MethodOptions.of(photo, options)
    work = _Olat(methods, prepared, chosen, options.keep_eyes, joint_fit, network_alone)
    layout = Layout(
        name="olat",
        title="Single lights of held-out people",
        metrics=("si_mse", "si_mse_clipped", "ssim", "tone_drift_deg"),
        by=("pose", "turn", "angle", "tone"),
        published=TABLE_1 + (TABLE_3 if options.against else ()),
        notes=_notes(split, note_of_chosen(chosen, joint_fit), network_alone),
    )
    items = people_items(dataset, list(chosen), options.output)
    prepare = partial(prepare_methods, methods, options)
    return run_protocol(layout, items, work, options, photo.settings, photo, prepare)


def _notes(split: str, chosen: str, network_alone: bool) -> tuple[str, ...]:
    """Notes below the figures."""
    field = "the network alone" if network_alone else "corrected by its source image"
    return (
        f"Split {split}. The field is {field}.",
        chosen,
        "si_mse_clipped clips the truth at white, as a camera does; otherwise a glint outweighs a face.",
        "tone_drift_deg is of the skin under lights within 25 degrees of the camera's axis.",
    )


def _paper_pairs(folder: Path, pairs: Mapping[str, list[Pair]]) -> dict[str, list[Pair]]:
    """Choose as many pairs as the paper measured, evenly over people and under its number of maps."""
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
    dataset: Dataset
    pairs: Mapping[str, list[Pair]]
    keep_eyes: bool
    joint_fit: bool
    network_alone: bool

    def __call__(self, item: Item) -> Iterator[Comparison]:
        methods = load_methods(self.methods)
        person = person_of(item, self.dataset, self.methods, self.keep_eyes, self.joint_fit)
        return compare_olats(person, self.pairs[item.name], methods, self.network_alone)
