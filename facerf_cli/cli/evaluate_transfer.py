"""`facerf evaluate transfer`: the reflectances of two pictures exchanged (the paper's Table 2)."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from facerf_cli.cli.batch import PHOTO_SUFFIXES, Item, collect_items, expand_stdin
from facerf_cli.cli.evaluation_items import (
    EveryOption,
    MethodOptions,
    RefitOption,
    SplitOption,
    load_before,
    load_methods,
    no_part_of_preset,
    only_dataset,
    people_items,
    portraits,
    read_split,
    refuse_for_others,
    refuse_without_field,
    require_enough,
)
from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.evaluation_run import run_protocol
from facerf_cli.cli.options import FaceModelOption, InputColourspaceOption, settings_of
from facerf_cli.cli.photo_options import LandmarksOption, PhotoOptions
from facerf_cli.errors import UsageError

if TYPE_CHECKING:
    from facerf_cli.dataset.dataset import Dataset
    from facerf_cli.dataset.pairs import Pair
    from facerf_cli.evaluation.case import Comparison

_PAPER_IMAGES = 86  # paper, Table 2

Couples = dict[str, "list[tuple[Pair, Pair]]"]


def transfer(
    context: typer.Context,
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="DATASET|PHOTO...",
            help="Folder by `facerf prepare-dataset`; or with --photos, pictures of a person two by two "
            "(A B A B ...), or folders with a person's pictures each.",
            show_default=False,
        ),
    ],
    options: EvaluateOptions,
    photos: Annotated[
        bool, typer.Option("--photos", help="What is given are photos, two by two or in folders.")
    ] = False,
    held_to_photo: Annotated[
        bool,
        typer.Option(
            "--held-to-photo", help="Hold the field to the photo that it is read off, as `relight` does."
        ),
    ] = False,
    split: SplitOption = "test",
    every: EveryOption = 1,
    refit: RefitOption = False,
    landmarks: LandmarksOption = None,
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
) -> int:
    """Exchange the reflectances of two pictures of a person (the paper's Table 2).

    Picture A is put together from the reflectance that was read off B, turned to A's pose, under A's light;
    then B from A's. The light is the one that the same method finds in the picture with its own reflectance.
    Of a DATASET, couples are sources of one person with different cameras and different maps.
    """
    from facerf_cli.evaluation.summary import TABLE_2_TRANSFER, Layout

    settings = settings_of(context)
    no_part_of_preset(options, every)
    refuse_for_others(context, photos)
    refuse_without_field(context, options, "held_to_photo")
    photo = PhotoOptions(settings, input_colourspace, face_model, landmarks=landmarks)
    photo.check()
    methods = MethodOptions.of(photo, options)
    work: _OfPhotos | _OfPeople
    if photos:
        couples = _preset_couples(_photo_couples(inputs, options.output), options)
        items = list(couples)
        work = _OfPhotos(methods, couples, options.keep_eyes, held_to_photo)
    else:
        folder = only_dataset(inputs)
        if folder is None:
            raise UsageError(f"{inputs[0]}: no prepared dataset; give --photos for pictures of people")
        dataset, pairs = read_split(folder, split, face_model, refit)
        chosen = _chosen_couples(folder, pairs, options, every)
        items = people_items(folder, list(chosen), options.output)
        work = _OfPeople(methods, dataset, chosen, options.keep_eyes, refit, held_to_photo)
    layout = Layout(
        name="transfer",
        title="Reflectances of two pictures of a person exchanged",
        metrics=("si_mse", "face_distance", "si_mse_channels", "ssim"),
        by=("turn",) if photos else ("turn", "tone"),
        published=TABLE_2_TRANSFER,
        notes=_notes(photos, held_to_photo),
    )
    load_before(methods, options)
    return run_protocol(layout, items, work, options, settings, photo)


def _notes(photos: bool, held_to_photo: bool) -> tuple[str, ...]:
    """What is said beside the figures."""
    held = "held to the photo that it is read off" if held_to_photo else "the network's own"
    notes = (
        f"The field is {held}.",
        "si_mse_channels has a scale for each channel: one photo cannot tell red light from red skin.",
    )
    mouths = "Where expressions differ, so does what mouths show: no reflectance knows of it."
    return (*notes, mouths) if photos else notes


def _chosen_couples(
    folder: Path, pairs: "Mapping[str, list[Pair]]", options: EvaluateOptions, every: int
) -> Couples:
    """Every Nth couple of a person, or the preset's number evenly over people."""
    from facerf_cli.evaluation.people import evenly
    from facerf_cli.evaluation.protocols.transfer import couples_of

    couples = {name: couples_of(members) for name, members in pairs.items()}
    if options.preset:
        most = _PAPER_IMAGES // 2
        found = 2 * sum(map(len, couples.values()))
        require_enough(found, 2 * most, "pictures in couples", folder, 2 * most / len(pairs))
        return evenly(couples, most)
    chosen = {name: members[::every] for name, members in couples.items()}
    if not any(chosen.values()):
        raise UsageError(f"{folder}: no two sources of one person with different cameras and maps")
    return {name: members for name, members in chosen.items() if members}


@dataclass(frozen=True)
class _Couple:
    """Two photos of a person."""

    person: str
    first: Item
    second: Item

    @property
    def item(self) -> Item:
        """The couple under the first one's place, both in its name."""
        tail = f"--{Path(self.second.name).name}"
        return Item(
            self.first.input_path, Path(f"{self.first.output_base}{tail}"), f"{self.first.name}{tail}"
        )


def _photo_couples(inputs: Sequence[str], output: Path) -> dict[Item, _Couple]:
    """An item a couple: files two by two as they are named, folders' files two by two in their order."""
    inputs = list(expand_stdin(inputs))
    files = [name for name in inputs if not os.path.isdir(name)]
    if len(files) % 2:
        raise UsageError(f"{len(files)} photos: give two of each person, A B A B ..., or folders of a person")
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
            raise UsageError(f"{folder}: {len(members)} photos; give two of a person, or four, ...")
        place = Path(members[0].name).parent.as_posix()
        person = folder.resolve().name if place == "." else place
        two_by_two = zip(members[::2], members[1::2], strict=True)
        couples += [_Couple(person, first, second) for first, second in two_by_two]
    _require_different(couples)
    return {couple.item: couple for couple in couples}


def _require_different(couples: Sequence[_Couple]) -> None:
    """UsageError where a couple is one photo twice, or the same two photos as another couple."""
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
    """All couples, or a preset's number evenly over people."""
    from facerf_cli.evaluation.people import evenly

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
class _OfPhotos:
    """Exchanges the reflectances of two photos."""

    methods: MethodOptions
    couples: Mapping[Item, _Couple]
    keep_eyes: bool
    held_to_photo: bool

    def __call__(self, item: Item) -> "Iterator[Comparison]":
        from facerf_cli.evaluation.case import Case
        from facerf_cli.evaluation.protocols.transfer import Side, transfer

        methods, sides = load_methods(self.methods), []
        couple = self.couples[item]
        for own, other in ((couple.first, couple.second), (couple.second, couple.first)):
            case = Case(f"{own.name}_by_{Path(other.name).name}", couple.person)
            portrait = next(portraits(own, self.methods.photo, self.keep_eyes))[1]
            sides.append(Side(case, portrait.view, portrait.image, portrait.face))
        yield from transfer((sides[0], sides[1]), methods, self.held_to_photo)


@dataclass(frozen=True, eq=False)
class _OfPeople:
    """Exchanges the reflectances of one person's couples."""

    methods: MethodOptions
    dataset: "Dataset"
    couples: "Mapping[str, list[tuple[Pair, Pair]]]"
    keep_eyes: bool
    refit: bool
    held_to_photo: bool

    def __call__(self, item: Item) -> "Iterator[Comparison]":
        from facerf_cli.evaluation.people import Person
        from facerf_cli.evaluation.protocols.transfer import transfer_person

        methods = load_methods(self.methods)
        person = Person(methods[0].models.face, self.dataset, item.name, self.keep_eyes, self.refit)
        return transfer_person(person, self.couples[item.name], methods, self.held_to_photo)
