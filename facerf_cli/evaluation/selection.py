"""Select the measured images: pairs of a dataset, photos, and couples of both."""

import logging
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items, expand_inputs
from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.dataset.pairs import Pair, pairs_path, read_pairs
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.folders import read_facts
from facerf_cli.evaluation.options import Chosen, FaceOptions
from facerf_cli.evaluation.people import DatasetPerson, PhotoFaces
from facerf_cli.run.logs import LOGGER_NAME

PairsByPerson = Mapping[str, Sequence[Pair]]
Groups = Mapping[str, Sequence[Sequence[Pair]]]  # by person; the sources of a group are compared together
T = TypeVar("T")
log = logging.getLogger(LOGGER_NAME)

# The paper's numbers of images ('Quantitative Evaluations', Tables 1, 2 and 4).
_PAPER_PHOTOS, _PAPER_COUPLES, _PAPER_MAPS, _PAPER_SAME, _PAPER_DIFFERENT = 130, 43, 160, 3900, 8100


def choose_people(
    choose: Callable[[PairsByPerson, FaceOptions], Groups], options: FaceOptions, inputs: Sequence[str]
) -> Chosen:
    """Choose groups of pairs for each person of a dataset, with the function `choose`."""
    assert options.dataset is not None
    dataset = read_dataset(options.dataset)
    pairs: dict[str, list[Pair]] = {}
    for pair in read_pairs(dataset):
        in_pose = not options.same_pose or pair.source_camera == pair.target_camera
        if options.split in ("all", pair.split) and in_pose:
            pairs.setdefault(pair.subject, []).append(pair)
    if not pairs:
        raise UsageError(
            f"{dataset.folder}: no pairs in the split {options.split}; run facerf relight-dataset, or "
            "use another --split"
        )
    groups = choose(pairs, options)
    items = {
        options.item(options.dataset / "olat" / name, name): DatasetPerson(dataset, name, groups=groups[name])
        for name in sorted(groups)
    }
    files = options.dataset / "dataset.json", pairs_path(dataset)
    return Chosen(items, files, sum(map(len, groups.values())))


def choose_sources(options: FaceOptions, inputs: Sequence[str]) -> Chosen:
    """Choose sources of a dataset, or photos; with --preset, at most the paper's number."""
    if options.dataset:
        return choose_people(source_pairs, options, inputs)
    photos = collect_items(inputs, options.output, PHOTO_SUFFIXES)
    names = {photo.name for photo in photos}
    described = {} if options.facts is None else read_facts(options.facts)
    if unknown := sorted({re.sub(r"_face\d+$", "", name) for name in described} - names):
        raise InputError(
            f"{options.facts}: no photo of this run is named {unknown[0]}; use names such as {min(names)}"
        )
    most = _up_to(_PAPER_PHOTOS, len(photos), "photos") if options.preset else len(photos)
    return Chosen({photo: PhotoFaces((photo,)) for photo in photos[:most]})


def choose_couples(options: FaceOptions, inputs: Sequence[str]) -> Chosen:
    """Choose couples of a dataset's sources, or of photos; with --preset, at most the paper's number."""
    if options.dataset:
        return choose_people(couple_pairs, options, inputs)
    by_person = couples_of_photos(inputs, options.output)
    if options.preset:
        by_person = evenly(by_person, _PAPER_COUPLES, "couples of photos")
    items = {}
    for person, couples in by_person.items():
        for first, second in couples:
            item = options.item(first.input_path, f"{first.name}--{Path(second.name).name}")
            items[item] = PhotoFaces((first, second), person)
    return Chosen(items, tuple(couple.items[1].input_path for couple in items.values()))


def source_pairs(pairs: PairsByPerson, options: FaceOptions) -> Groups:
    """Choose every Nth pair; with --preset, at most the paper's number of sources."""
    if options.preset:
        chosen = evenly(pairs, _PAPER_PHOTOS, "sources")
    else:
        numbered = [pair for members in pairs.values() for pair in members][:: options.every]
        chosen = {name: [pair for pair in numbered if pair.subject == name] for name in pairs}
    return {name: [(pair,) for pair in members] for name, members in chosen.items() if members}


def olat_pairs(pairs: PairsByPerson, options: FaceOptions) -> Groups:
    """Choose every Nth pair; with --preset, at most the paper's numbers of pairs and maps."""
    if not options.preset:
        return source_pairs(pairs, options)
    maps = list(dict.fromkeys(pair.envmap for members in pairs.values() for pair in members))
    kept = set(maps[: _up_to(_PAPER_MAPS, len(maps), "maps")])
    chosen: dict[str, list[Pair]] = {name: [] for name in pairs}
    for same, most, kind in (
        (True, _PAPER_SAME, "pairs of the same pose"),
        (False, _PAPER_DIFFERENT, "pairs of different poses"),
    ):
        groups = {
            name: [p for p in members if p.envmap in kept and (p.source_camera == p.target_camera) is same]
            for name, members in pairs.items()
        }
        for name, members in evenly(groups, most, kind).items():
            chosen[name] += members
    in_order = {name: sorted(members, key=lambda pair: pair.index) for name, members in chosen.items()}
    return {name: [(pair,) for pair in members] for name, members in in_order.items() if members}


def couple_pairs(pairs: PairsByPerson, options: FaceOptions) -> Groups:
    """Choose every Nth couple of each person; with --preset, at most the paper's number."""
    couples = {name: members for name, own in pairs.items() if (members := couples_of(own))}
    if not couples:
        raise UsageError(
            "no two sources of one person with different cameras and maps; run relight-dataset with more"
        )
    if options.preset:
        return evenly(couples, _PAPER_COUPLES, "couples of images")
    return {name: members[:: options.every] for name, members in couples.items()}


def couples_of(pairs: Sequence[Pair]) -> list[tuple[Pair, Pair]]:
    """Combine a person's pairs into couples of different cameras and maps; use each pair at most once."""
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


def evenly(groups: Mapping[str, Sequence[T]], paper: int, what: str) -> dict[str, list[T]]:
    """Choose the first member of each group, then the second, and so on, up to the paper's total."""
    most = _up_to(paper, sum(map(len, groups.values())), what)
    rounds = sorted((index, name) for name, members in groups.items() for index in range(len(members)))
    chosen: dict[str, list[T]] = {name: [] for name in groups}
    for index, name in rounds[:most]:
        chosen[name].append(groups[name][index])
    return {name: members for name, members in chosen.items() if members}


def _up_to(paper: int, available: int, what: str) -> int:
    """Return the paper's number, or the available number after a warning if it is smaller."""
    if available < paper:
        log.warning("measuring all %d %s; the paper measured %d", available, what, paper)
    return min(paper, available)


def couples_of_photos(inputs: Sequence[str], output: Path) -> dict[str, list[tuple[Item, Item]]]:
    """Combine photos into couples by person: consecutive files of the command line or of a folder."""
    inputs = list(expand_inputs(inputs))
    items = collect_items(inputs, output, PHOTO_SUFFIXES)
    by_path = {os.path.abspath(item.input_path): item for item in items}
    named = [by_path[os.path.abspath(name)] for name in inputs if not os.path.isdir(name)]
    groups: dict[Path | None, list[Item]] = {None: named}
    for item in items:
        if item not in named:
            groups.setdefault(item.input_path.parent, []).append(item)
    known: set[frozenset[Path]] = set()
    couples: dict[str, list[tuple[Item, Item]]] = {}
    advice = "pass two photos per person, A B A B ..., or one folder per person"
    for folder, members in groups.items():
        if len(members) % 2:
            raise UsageError(
                f"{folder or members[-1].input_path}: {len(members)} photos, an odd number; {advice}"
            )
        for first, second in zip(members[::2], members[1::2], strict=True):
            files = frozenset(item.input_path.resolve() for item in (first, second))
            if len(files) < 2 or files in known:
                raise UsageError(f"{first.input_path} and {second.input_path}: passed twice; {advice}")
            known.add(files)
            subfolder = Path(first.name).parent.as_posix()
            of_folder = folder.resolve().name if folder and subfolder == "." else subfolder
            couples.setdefault(of_folder if folder else first.name, []).append((first, second))
    return couples
