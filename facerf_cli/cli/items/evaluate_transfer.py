"""`facerf evaluate transfer`: the reflectances of two images exchanged (the paper's Table 2)."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.inputs import PHOTO_SUFFIXES, Item, collect_items, expand_inputs
from facerf_cli.cli.items.evaluation import (
    MethodOptions,
    load_methods,
    note_of_chosen,
    note_of_light,
    people_items,
    person_of,
    portraits,
    prepare_methods,
    read_split,
    require_enough,
)
from facerf_cli.cli.items.evaluation_run import run_protocol
from facerf_cli.cli.light_options import LightOptions
from facerf_cli.cli.photo_options import PhotoOptions
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair
from facerf_cli.errors import UsageError
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.people import evenly
from facerf_cli.evaluation.protocols.transfer import Side, couples_of, transfer, transfer_person
from facerf_cli.evaluation.published import TABLE_2_TRANSFER
from facerf_cli.evaluation.summary import Layout

_PAPER_IMAGES = 86  # paper, Table 2

Couples = dict[str, list[tuple[Pair, Pair]]]


def run_transfer(
    inputs: Sequence[str],
    folder: Path | None,
    options: EvaluateOptions,
    photo: PhotoOptions,
    light: LightOptions,
    split: str,
    every: int,
    joint_fit: bool,
    network_alone: bool,
) -> int:
    """Measure couples of photos, or of the split of a dataset's folder; the exit code."""
    methods = MethodOptions.of(photo, options, light)
    notes = (*_notes(folder is None, network_alone), note_of_light(light))
    work: _TransferPhotos | _TransferPeople
    if folder is None:
        couples = _preset_couples(_photo_couples(inputs, options.output), options)
        items = list(couples)
        work = _TransferPhotos(methods, couples, options.keep_eyes, network_alone)
    else:
        dataset, pairs = read_split(folder, split, photo.face_model, joint_fit)
        chosen = _chosen_couples(folder, pairs, options, every)
        items = people_items(folder, list(chosen), options.output)
        notes = (*notes, note_of_chosen(chosen, joint_fit))
        work = _TransferPeople(methods, dataset, chosen, options.keep_eyes, joint_fit, network_alone)
    layout = Layout(
        name="transfer",
        title="Reflectances of two images of a person exchanged",
        metrics=("si_mse", "face_distance", "si_mse_channels", "ssim"),
        by=("turn", "tone") if folder else ("turn",),
        published=TABLE_2_TRANSFER,
        notes=notes,
    )
    prepare = partial(prepare_methods, methods, options)
    return run_protocol(layout, items, work, options, photo.settings, photo, prepare)


def _notes(photos: bool, network_alone: bool) -> tuple[str, ...]:
    """Notes below the figures."""
    field = "the network alone" if network_alone else "corrected by the photo that it is read from"
    notes = (
        f"The field is {field}.",
        "si_mse_channels fits a scale for each channel: one photo cannot separate red light from red skin.",
    )
    mouths = "Where expressions differ, mouths differ, which no reflectance describes."
    return (*notes, mouths) if photos else notes


def _chosen_couples(
    folder: Path, pairs: Mapping[str, list[Pair]], options: EvaluateOptions, every: int
) -> Couples:
    """Choose every Nth couple of a person, or the preset's number evenly over people."""
    couples = {name: couples_of(members) for name, members in pairs.items()}
    if options.preset:
        most = _PAPER_IMAGES // 2
        found = 2 * sum(map(len, couples.values()))
        require_enough(found, 2 * most, "images in couples", folder, 2 * most / len(pairs))
        return evenly(couples, most)
    chosen = {name: members[::every] for name, members in couples.items()}
    if not any(chosen.values()):
        raise UsageError(
            f"{folder}: no two sources of one person with different cameras and maps; run relight-dataset "
            f"with more"
        )
    return {name: members for name, members in chosen.items() if members}


@dataclass(frozen=True)
class _Couple:
    """Two photos of a person."""

    person: str
    first: Item
    second: Item

    @property
    def item(self) -> Item:
        """The couple as an item at the first one's place, with both names."""
        tail = f"--{Path(self.second.name).name}"
        return Item(
            self.first.input_path, Path(f"{self.first.output_base}{tail}"), f"{self.first.name}{tail}"
        )


def _photo_couples(inputs: Sequence[str], output: Path) -> dict[Item, _Couple]:
    """An item for each couple: two files each as they are named, and two each of a folder in its order."""
    inputs = list(expand_inputs(inputs))
    files = [name for name in inputs if not os.path.isdir(name)]
    if len(files) % 2:
        raise UsageError(
            f"{len(files)} photos: an odd number; give two of each person, A B A B ..., or a folder for each "
            f"person"
        )
    found = collect_items(inputs, output, PHOTO_SUFFIXES)
    by_path = {os.path.abspath(item.input_path): item for item in found}
    named = [by_path[os.path.abspath(name)] for name in files]
    groups: dict[Path, list[Item]] = {}
    for item in found:
        if item not in named:
            groups.setdefault(item.input_path.parent, []).append(item)
    couples = [
        _Couple(first.name, first, second) for first, second in zip(named[::2], named[1::2], strict=True)
    ]
    for folder, members in groups.items():
        if len(members) % 2:
            raise UsageError(
                f"{folder}: {len(members)} photos, an odd number; give two, four, ... of a person"
            )
        place = Path(members[0].name).parent.as_posix()
        person = folder.resolve().name if place == "." else place
        two_by_two = zip(members[::2], members[1::2], strict=True)
        couples += [_Couple(person, first, second) for first, second in two_by_two]
    _require_different(couples)
    return {couple.item: couple for couple in couples}


def _require_different(couples: Sequence[_Couple]) -> None:
    """Raise UsageError for a couple of one photo, or of the same two photos as another couple."""
    seen: set[frozenset[Path]] = set()
    for couple in couples:
        files = frozenset(item.input_path.resolve() for item in (couple.first, couple.second))
        if len(files) < 2:
            raise UsageError(
                f"{couple.first.input_path}: given twice; give two photos of a person, A B A B ..."
            )
        if files in seen:
            both = f"{couple.first.input_path} and {couple.second.input_path}"
            raise UsageError(f"{both}: given as a couple twice; give them once")
        seen.add(files)


def _preset_couples(couples: dict[Item, _Couple], options: EvaluateOptions) -> dict[Item, _Couple]:
    """Choose all couples, or a preset's number evenly over people."""
    if not options.preset:
        return couples
    if 2 * len(couples) < _PAPER_IMAGES:
        raise UsageError(
            f"{2 * len(couples)} photos in couples, --preset paper measures {_PAPER_IMAGES}; give more"
        )
    groups: dict[str, list[Item]] = {}
    for item, couple in couples.items():
        groups.setdefault(couple.person, []).append(item)
    chosen = evenly(groups, _PAPER_IMAGES // 2)
    return {item: couples[item] for members in chosen.values() for item in members}


@dataclass(frozen=True, eq=False)
class _TransferPhotos:
    """Exchanges the reflectances of two photos."""

    methods: MethodOptions
    couples: Mapping[Item, _Couple]
    keep_eyes: bool
    network_alone: bool

    def __call__(self, item: Item) -> Iterator[Comparison]:
        methods, sides = load_methods(self.methods), []
        couple = self.couples[item]
        for own, other in ((couple.first, couple.second), (couple.second, couple.first)):
            case = Case(f"{own.name}_by_{Path(other.name).name}", couple.person)
            sides.append(Side(case, next(portraits(own, self.methods, self.keep_eyes))[1]))
        yield from transfer((sides[0], sides[1]), methods, self.network_alone)


@dataclass(frozen=True, eq=False)
class _TransferPeople:
    """Exchanges the reflectances of one person's couples."""

    methods: MethodOptions
    dataset: Dataset
    couples: Mapping[str, list[tuple[Pair, Pair]]]
    keep_eyes: bool
    joint_fit: bool
    network_alone: bool

    def __call__(self, item: Item) -> Iterator[Comparison]:
        methods = load_methods(self.methods)
        person = person_of(item, self.dataset, self.methods, self.keep_eyes, self.joint_fit)
        return transfer_person(person, self.couples[item.name], methods, self.network_alone)
