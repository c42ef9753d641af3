"""The images that are measured: pairs of a dataset, and couples of photos.

All, every Nth, as many as the paper measured, or a frozen list, which each run leaves as DIR/pairs.json.
"""

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items, expand_inputs
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair, check_pair, read_pairs
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.documents import Document, checked, read_document, write_document
from facerf_cli.run.logs import LOGGER_NAME

Groups = Mapping[str, Sequence[Sequence[Pair]]]  # by person: pairs whose sources are compared together
T = TypeVar("T")
log = logging.getLogger(LOGGER_NAME)

# The paper's numbers of images ('Quantitative Evaluations', Tables 1, 2 and 4).
PAPER_PHOTOS = 130
_PAPER_MAPS, _PAPER_SAME, _PAPER_DIFFERENT, _PAPER_COUPLES = 160, 3900, 8100, 43

ListFormat = Literal["facerf-pairs-1"]
LIST_FORMAT: ListFormat = "facerf-pairs-1"
PAIRS_LIST = "pairs.json"


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


def choose_sources(pairs: Mapping[str, Sequence[Pair]], every: int, preset: bool) -> Groups:
    """Choose every Nth pair of a dataset, or as many sources as the paper measured, evenly over people."""
    if preset:
        return _alone(evenly(pairs, _up_to(PAPER_PHOTOS, _count(pairs), "sources")))
    numbered = [pair for members in pairs.values() for pair in members][::every]
    return _alone({name: [pair for pair in numbered if pair.subject == name] for name in pairs})


def choose_olats(pairs: Mapping[str, Sequence[Pair]], every: int, preset: bool) -> Groups:
    """Choose every Nth pair, or up to the paper's number of pairs and of maps, evenly over people."""
    if not preset:
        return choose_sources(pairs, every, preset)
    maps = list(dict.fromkeys(pair.envmap for members in pairs.values() for pair in members))
    kept = set(maps[: _up_to(_PAPER_MAPS, len(maps), "maps")])
    chosen: dict[str, list[Pair]] = {name: [] for name in pairs}
    for same, most in ((True, _PAPER_SAME), (False, _PAPER_DIFFERENT)):
        groups = {
            name: [p for p in members if p.envmap in kept and (p.source_camera == p.target_camera) is same]
            for name, members in pairs.items()
        }
        kind = "pairs of the same pose" if same else "pairs of different poses"
        for name, members in evenly(groups, _up_to(most, _count(groups), kind)).items():
            chosen[name] += members
    return _alone({name: sorted(members, key=lambda pair: pair.index) for name, members in chosen.items()})


def choose_couples(pairs: Mapping[str, Sequence[Pair]], every: int, preset: bool) -> Groups:
    """Choose every Nth couple of each person, or up to the paper's number evenly over people."""
    couples = {name: members for name, own in pairs.items() if (members := couples_of(own))}
    if not couples:
        raise UsageError(
            "no two sources of one person with different cameras and maps; run relight-dataset with more"
        )
    if preset:
        return evenly(couples, _up_to(_PAPER_COUPLES, _count(couples), "couples of images"))
    return {name: members[::every] for name, members in couples.items()}


class _PairList(Document):
    format: ListFormat
    groups: Annotated[
        list[Annotated[list[dict[str, Any]], Field(min_length=1, max_length=2)]], Field(min_length=1)
    ]


def write_list(path: Path, groups: Groups) -> None:
    """Freeze the pairs of a run, with the recipes of their sources, for `--pairs` of any other run."""
    rows = [[asdict(pair) for pair in group] for members in groups.values() for group in members]
    write_document(path, {"format": LIST_FORMAT, "groups": rows})


def read_list(path: Path, dataset: Dataset, size: int) -> Groups:
    """Read a frozen list of groups of `size` pairs of a dataset; a map that has moved may lie next to it.

    Raises InputError where a pair's person, camera or light is not the dataset's, or in another split.
    """
    content = read_document(path, _PairList, "give the pairs.json of another run of facerf evaluate")
    listed = [
        [checked(Pair, row, f"{path}: groups[{number}]") for row in group]
        for number, group in enumerate(content.groups)
    ]
    keys = [pair.key for group in listed for pair in group]
    if len(set(keys)) < len(keys):
        raise InputError(f"{path}: lists a pair twice; remove one")
    groups: dict[str, list[tuple[Pair, ...]]] = {}
    for number, group in enumerate(listed):
        try:
            for pair in group:
                check_pair(dataset, pair)
            if len(group) != size or len({pair.subject for pair in group}) > 1:
                raise ValueError(f"{size} of one person are needed")
        except (KeyError, ValueError) as error:
            raise InputError(
                f"{path}: groups[{number}] does not fit {dataset.folder} ({error}); prepare the dataset with "
                "the people, splits, cameras and lights of the list"
            ) from None
        groups.setdefault(group[0].subject, []).append(tuple(_with_map(pair, path.parent) for pair in group))
    return groups


def _with_map(pair: Pair, folder: Path) -> Pair:
    near = folder / Path(pair.envmap).name
    return replace(pair, envmap=str(near)) if near.is_file() and not Path(pair.envmap).is_file() else pair


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


def _up_to(paper: int, found: int, what: str) -> int:
    """The paper's number, or what there is; a line says where that is less."""
    if found < paper:
        log.warning("%d %s are measured, all there are; the paper measured %d", found, what, paper)
    return min(paper, found)


def choose_photos(items: list[Item], preset: bool) -> list[Item]:
    """Choose all photos, or up to the paper's number of them."""
    return items[: _up_to(PAPER_PHOTOS, len(items), "photos")] if preset else items


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

    A preset takes up to the paper's number of couples, evenly over people.
    """
    couples = list(_couples(inputs, output))
    if not preset:
        return couples
    most = _up_to(_PAPER_COUPLES, len(couples), "couples of photos")
    of_person: dict[str, list[Couple]] = {}
    for couple in couples:
        of_person.setdefault(couple.person, []).append(couple)
    return [couple for members in evenly(of_person, most).values() for couple in members]


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
