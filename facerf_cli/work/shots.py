"""Shots among the inputs: films, and with `--sequence` numbered images, whose frames show one person."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath

from facerf_cli.batch.inputs import (
    FILM_SUFFIXES,
    PHOTO_SUFFIXES,
    Item,
    NamePattern,
    collect_items,
    fields_of,
    split_frame,
)
from facerf_cli.batch.made_from import DigestOf, Recipe
from facerf_cli.batch.run import BatchOptions
from facerf_cli.errors import UsageError
from facerf_cli.option import BATCH, option
from facerf_cli.work.photo_options import PhotoOptions

FRAMES_IN_A_ROW = 8  # that a process takes, since neighbours share work
_DIGITS = 4  # of a film's frame numbers, or more


@dataclass(frozen=True)
class ShotOptions:
    """The inputs that are the frames of one shot."""

    sequence: bool = option(
        False,
        "Take numbered images (plate.0001.exr, ...) as the frames of one shot, as a film's are.",
        flags=("--sequence",),
        panel=BATCH,
    )
    no_cuts: bool = option(False, "Take a film that cuts as one shot.", flags=("--no-cuts",), panel=BATCH)


@dataclass(frozen=True, eq=False)  # as a key of caches by identity: it has thousands of frames
class Shot:
    """Frames of one person, in order: of a film, or images."""

    base: Path  # output folder / name
    frames: tuple[Item, ...]
    film: Path | None = None
    cuts: bool = True  # each part between cuts is a shot for itself

    @property
    def track(self) -> Path:
        """The file of the face's landmarks in each frame."""
        return self.base.with_name(f"{self.base.name}_track.jsonl")

    @cached_property
    def numbers(self) -> dict[Path, int]:
        """Number of each frame, from 0, by its place in the output folder."""
        return {item.output_base: number for number, item in enumerate(self.frames)}


def collect_frames(
    inputs: Sequence[str], wanted: ShotOptions, batch: BatchOptions, photo: PhotoOptions
) -> tuple[list[Item], tuple[Shot, ...]]:
    """List photos and the frames of films, in order, and the shots that they make; see `collect_items`.

    A film is named itself: in folders only images are looked for. Raises UsageError for options that a shot
    cannot have.
    """
    pattern = batch.name
    found = collect_items(inputs, batch.output, PHOTO_SUFFIXES, pattern, photo.settings.null_separated)
    films = [item for item in found if item.input_path.suffix.lower() in FILM_SUFFIXES]
    photos = [item for item in found if item not in films]
    shots = [_of_film(item, pattern) for item in films if item.input_path.exists()]
    missing = [item for item in films if not item.input_path.exists()]  # reported as photos are
    if wanted.sequence:
        shots += _of_images(photos)
        photos = []
    shots = [replace(shot, cuts=not wanted.no_cuts) for shot in shots]
    _check_shots(shots, photo)
    if shots and batch.shard.of > 1:
        raise UsageError("--shard: the frames of a shot belong together; use --jobs, or a shard of photos")
    return [*photos, *missing, *(item for shot in shots for item in shot.frames)], tuple(shots)


def _of_film(item: Item, pattern: NamePattern | None) -> Shot:
    from facerf_cli.files.film import film_facts

    count = len(film_facts(item.input_path).times_s)
    digits = max(_DIGITS, len(str(count - 1)))
    mirrored = item.mirrored or PurePosixPath(item.input_path.name)
    folder = item.output_base.parents[len(PurePosixPath(item.name).parts) - 1]
    frames = []
    for number in range(count):
        place = mirrored.with_name(f"{mirrored.stem}.{number:0{digits}d}{mirrored.suffix}")
        own = place.with_suffix("").as_posix()
        name = pattern.filled(fields_of(item.input_path, place)) if pattern else own
        frames.append(Item(item.input_path, folder / name, name, place, frame=number))
    return Shot(item.output_base, tuple(frames), item.input_path)


def _of_images(photos: Sequence[Item]) -> list[Shot]:
    """Images grouped by folder and name without number; each group is a shot, by number."""
    groups: dict[Path, list[Item]] = {}
    for item in photos:
        base = item.output_base
        groups.setdefault(base.with_name(split_frame(base.name)[0]), []).append(item)
    return [Shot(base, tuple(sorted(items, key=_number))) for base, items in groups.items()]


def _number(item: Item) -> tuple[int, str]:
    digits = re.findall(r"\d+", item.output_base.name)
    return int(digits[-1]) if digits else 0, item.name


def shot_of(shots: Sequence[Shot], item: Item) -> tuple[Shot, int] | None:
    """The shot of an item, and its number there; None for a photo alone."""
    for shot in shots:
        if item.output_base in shot.numbers:
            return shot, shot.numbers[item.output_base]
    return None


def recipe_of_shots(shots: Sequence[Shot], digest_of: DigestOf) -> Recipe:
    """Entries of a recipe: the images of sequences, since a frame depends on its neighbours; --no-cuts."""
    import hashlib

    from facerf_cli.errors import InputError

    found: Recipe = {} if all(shot.cuts for shot in shots) else {"cuts": False}
    images = [item.input_path for shot in shots if shot.film is None for item in shot.frames]
    if not images:
        return found
    try:
        digests = "".join(map(digest_of, images))
    except InputError:  # its item says so
        digests = ""
    return {**found, "sequence": "sha256:" + hashlib.sha256(digests.encode()).hexdigest()}


def _check_shots(shots: Sequence[Shot], photo: PhotoOptions) -> None:
    """Raise UsageError for options that a shot cannot have."""
    if not shots:
        return
    if photo.face == "all":
        raise UsageError("--face all: one face is followed through a shot; give --face INDEX for each")
    if photo.geometry == "network":
        raise UsageError("--geometry network: a shot is fitted to landmarks; leave it out")
    if photo.landmarks is not None and any(shot.film for shot in shots):
        raise UsageError("--landmarks: cannot be given for the frames of a film; leave it out")


def whole_shots(items: Sequence[Item], shots: Sequence[Shot]) -> list[Item]:
    """The items with one for each shot, its first frame, in place of its frames."""
    inside = {item.output_base for shot in shots for item in shot.frames}
    alone = [item for item in items if item.output_base not in inside]
    for shot in shots:
        name = PurePosixPath(shot.frames[0].name).with_name(shot.base.name).as_posix()
        alone.append(replace(shot.frames[0], output_base=shot.base, name=name))
    return alone
