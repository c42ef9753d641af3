"""The images that are measured: pairs of a dataset, and couples of photos; all, every Nth, or a preset's."""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items, expand_inputs
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair, read_pairs
from facerf_cli.errors import UsageError

Groups = Mapping[str, Sequence[Sequence[Pair]]]  # by person: pairs whose sources are compared together
T = TypeVar("T")

# The paper's numbers of images ('Quantitative Evaluations', Tables 1, 2 and 4).
PAPER_PHOTOS = 130
_PAPER_MAPS, _PAPER_SAME, _PAPER_DIFFERENT, _PAPER_COUPLES = 160, 3900, 8100, 43


def pairs_of_split(dataset: Dataset, split: str) -> dict[str, list[Pair]]:
    """The pairs of a split, or of all, by person; raises UsageError if there are none."""
    pairs: dict[str, list[Pair]] = {}
    for pair in read_pairs(dataset):
        if split in ("all", pair.split):
            pairs.setdefault(pair.subject, []).append(pair)
    if not pairs:
        raise UsageError(
            f"{dataset.folder}: no pairs in the split {split}; run facerf relight-dataset, or give another "
            "--split"
        )
    return pairs


def choose_sources(folder: Path, pairs: Mapping[str, Sequence[Pair]], every: int, preset: bool) -> Groups:
    """Choose every Nth pair of a dataset, or as many sources as the paper measured, evenly over people."""
    if preset:
        _require_enough(_count(pairs), PAPER_PHOTOS, "sources", folder, PAPER_PHOTOS / len(pairs))
        return _alone(evenly(pairs, PAPER_PHOTOS))
    numbered = [pair for members in pairs.values() for pair in members][::every]
    return _alone({name: [pair for pair in numbered if pair.subject == name] for name in pairs})


def choose_olats(folder: Path, pairs: Mapping[str, Sequence[Pair]], every: int, preset: bool) -> Groups:
    """Choose every Nth pair, or the paper's number of pairs and of maps, evenly over people."""
    if not preset:
        return choose_sources(folder, pairs, every, preset)
    maps = dict.fromkeys(pair.envmap for members in pairs.values() for pair in members)
    per_subject = 2 * _PAPER_DIFFERENT / len(pairs)  # half of the pairs change the camera
    _require_enough(len(maps), _PAPER_MAPS, "maps", folder, per_subject)
    kept = set(list(maps)[:_PAPER_MAPS])
    chosen: dict[str, list[Pair]] = {name: [] for name in pairs}
    for same, most in ((True, _PAPER_SAME), (False, _PAPER_DIFFERENT)):
        groups = {
            name: [p for p in members if p.envmap in kept and (p.source_camera == p.target_camera) is same]
            for name, members in pairs.items()
        }
        found = evenly(groups, most)
        kind = "pairs of the same pose" if same else "pairs of different poses"
        _require_enough(_count(found), most, kind, folder, per_subject)
        for name, members in found.items():
            chosen[name] += members
    return _alone({name: sorted(members, key=lambda pair: pair.index) for name, members in chosen.items()})


def choose_couples(folder: Path, pairs: Mapping[str, Sequence[Pair]], every: int, preset: bool) -> Groups:
    """Choose every Nth couple of each person, or the paper's number evenly over people."""
    couples = {name: couples_of(members) for name, members in pairs.items()}
    if preset:
        most = 2 * _PAPER_COUPLES
        _require_enough(2 * _count(couples), most, "images in couples", folder, most / len(pairs))
        return evenly(couples, _PAPER_COUPLES)
    chosen = {name: members[::every] for name, members in couples.items() if members}
    if not chosen:
        raise UsageError(
            f"{folder}: no two sources of one person with different cameras and maps; run relight-dataset "
            "with more"
        )
    return chosen


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


def evenly(groups: Mapping[str, Sequence[T]], most: int) -> dict[str, list[T]]:
    """Choose the first of each group, then the second of each, and so on, up to `most` in all."""
    rounds = sorted((place, name) for name, members in groups.items() for place in range(len(members)))
    chosen: dict[str, list[T]] = {name: [] for name in groups}
    for place, name in rounds[:most]:
        chosen[name].append(groups[name][place])
    return {name: members for name, members in chosen.items() if members}


def _alone(pairs: Mapping[str, Sequence[Pair]]) -> Groups:
    """Each pair as a group of its own; people without any are left out."""
    return {name: [(pair,) for pair in members] for name, members in pairs.items() if members}


def _count(groups: Mapping[str, Sequence[object]]) -> int:
    return sum(map(len, groups.values()))


def _require_enough(found: int, needed: int, what: str, dataset: Path, per_subject: float) -> None:
    """Raise UsageError where a preset needs more than a split has; `per_subject` pairs are enough."""
    if found < needed:
        enough = math.ceil(1.1 * per_subject)
        raise UsageError(
            f"{dataset}: the split has {found} {what}, --preset paper measures {needed}; run facerf "
            f"relight-dataset {dataset} --envmaps procedural:160 --per-subject {enough} --overwrite always, "
            "or prepare more people"
        )


def choose_photos(items: list[Item], preset: bool) -> list[Item]:
    """Choose all photos, or the paper's number of them."""
    if preset and len(items) < PAPER_PHOTOS:
        raise UsageError(
            f"{len(items)} photos, --preset paper measures {PAPER_PHOTOS}; give a folder of more"
        )
    return items[:PAPER_PHOTOS] if preset else items


@dataclass(frozen=True)
class Couple:
    """Two photos of a person."""

    person: str
    photos: tuple[Item, Item]

    @property
    def item(self) -> Item:
        """The couple as an item at the first one's place, with both names."""
        first, second = self.photos
        tail = f"--{Path(second.name).name}"
        return Item(first.input_path, Path(f"{first.output_base}{tail}"), f"{first.name}{tail}")


def couples_of_photos(inputs: Sequence[str], output: Path, preset: bool) -> list[Couple]:
    """Pair up photos: two files each as they are named, and two each of a folder in its order.

    A preset takes the paper's number of couples evenly over people.
    """
    couples = list(_couples(inputs, output))
    if not preset:
        return couples
    if len(couples) < _PAPER_COUPLES:
        raise UsageError(
            f"{2 * len(couples)} photos in couples, --preset paper measures {2 * _PAPER_COUPLES}; give more"
        )
    of_person: dict[str, list[Couple]] = {}
    for couple in couples:
        of_person.setdefault(couple.person, []).append(couple)
    return [couple for members in evenly(of_person, _PAPER_COUPLES).values() for couple in members]


def _couples(inputs: Sequence[str], output: Path) -> Iterable[Couple]:
    inputs = list(expand_inputs(inputs))
    items = collect_items(inputs, output, PHOTO_SUFFIXES)
    by_path = {os.path.abspath(item.input_path): item for item in items}
    named = [by_path[os.path.abspath(name)] for name in inputs if not os.path.isdir(name)]
    groups: dict[Path | None, list[Item]] = {None: named}
    for item in items:
        if item not in named:
            groups.setdefault(item.input_path.parent, []).append(item)
    given: set[frozenset[Path]] = set()
    advice = "give two of each person, A B A B ..., or a folder for each person"
    for folder, members in groups.items():
        if len(members) % 2:
            raise UsageError(
                f"{folder or members[-1].input_path}: {len(members)} photos, an odd number; {advice}"
            )
        for first, second in zip(members[::2], members[1::2], strict=True):
            files = frozenset(item.input_path.resolve() for item in (first, second))
            if len(files) < 2 or files in given:
                raise UsageError(f"{first.input_path} and {second.input_path}: given twice; {advice}")
            given.add(files)
            place = Path(first.name).parent.as_posix()
            of_folder = folder.resolve().name if folder and place == "." else place
            yield Couple(of_folder if folder else first.name, (first, second))
