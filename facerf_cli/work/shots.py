"""Shots: films, and with `--sequence` numbered images, whose frames show one person; and a film as output."""

import hashlib
import logging
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

from facerf_cli.batch.inputs import (
    DOTTED,
    FILM_SUFFIXES,
    PHOTO_SUFFIXES,
    Item,
    NamePattern,
    collect_items,
    fields_of,
    in_order,
)
from facerf_cli.batch.journal import Journal
from facerf_cli.batch.recipe import DigestOf, Recipe, RecipesOf, key_of
from facerf_cli.batch.run import keep_newer
from facerf_cli.batch.settings import BatchOptions, folder_not_file
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.texts import file_sha256
from facerf_cli.option import BATCH, option
from facerf_cli.run.logs import LOGGER_NAME, named
from facerf_cli.work.output_options import Format
from facerf_cli.work.photo_options import PhotoOptions

log = logging.getLogger(LOGGER_NAME)
FRAMES_IN_A_ROW = 8  # that a process takes, since neighbours share work
_FORMATS: dict[str, Format] = {".mp4": "png", ".mov": "png16"}  # of the frames of each kind of film
_RATE = Fraction(24)
_MOST_RATE, _FINEST_RATE = 1000, 1001  # numerators and denominators must fit FFmpeg's
_DROP_FRAME = 0x40  # flag of a timecode
_DIGITS = 4  # of a film's frame numbers, or more
_NUMBERED = re.compile(r"(.*?)(\d{2,})(\D*\.\w+)", re.DOTALL)
_FEWEST_FRAMES = 3  # that look like a shot


@dataclass(frozen=True)
class ShotOptions:
    """The inputs that are the frames of one shot.

    Attributes:
        sequence: Take numbered images (plate_0001.exr, 0001.exr, ...) as frames of one shot.
        no_cuts: Take a film that cuts as one shot.
    """

    sequence: bool = option(False, panel=BATCH)
    no_cuts: bool = option(False, panel=BATCH)


@dataclass(frozen=True, eq=False)
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


class Shots:
    """The shots of a run, and the one whose frames this process works through, held open (`open_at`)."""

    def __init__(self, shots: Sequence[Shot] = ()) -> None:
        self.all = tuple(shots)
        self.places = {item.output_base: (shot, n) for shot in shots for n, item in enumerate(shot.frames)}
        self.opened: Any = None

    def __reduce__(self) -> tuple[type["Shots"], tuple[tuple[Shot, ...]]]:
        """Send the shots to another process, which opens its own."""
        return Shots, (self.all,)


def collect_frames(
    inputs: Sequence[str], wanted: ShotOptions, batch: BatchOptions, photo: PhotoOptions
) -> tuple[list[Item], tuple[Shot, ...]]:
    """List photos and the frames of films, in order, and the shots that they make; see `collect_items`.

    A film is named itself: in folders only images are looked for. Raises UsageError for options that a shot
    cannot have.
    """
    pattern = batch.name
    found = collect_items(
        inputs, batch.output, PHOTO_SUFFIXES, pattern, photo.settings.null_separated, wanted.sequence
    )
    films = [item for item in found if item.input_path.suffix.lower() in FILM_SUFFIXES]
    photos = [item for item in found if item not in films]
    shots = [_of_film(item, pattern) for item in films if item.input_path.exists()]
    missing = [item for item in films if not item.input_path.exists()]  # reported as photos are
    if wanted.sequence:
        shots += _of_images(photos)
        photos = []
        for shot in shots:
            if len(shot.frames) == 1:
                log.warning(
                    "%s: is the only frame of its shot; name the others like it, but for the number",
                    shot.frames[0].input_path,
                )
    elif frames := _consecutive(photos):
        log.info("%s to %s: each is taken alone; give --sequence if they are one shot", *frames)
    shots = [replace(shot, cuts=not wanted.no_cuts) for shot in shots]
    _check_shots(shots, photo)
    if shots and batch.shard.of > 1:
        raise UsageError("--shard: the frames of a shot belong together; use --jobs, or a shard of photos")
    return [*photos, *missing, *(item for shot in shots for item in shot.frames)], tuple(shots)


def _of_film(item: Item, pattern: NamePattern | None) -> Shot:
    from facerf_cli.files.film import film_timing

    count = len(film_timing(item.input_path).times_s)
    digits = max(_DIGITS, len(str(count - 1)))
    mirrored = item.mirrored or PurePosixPath(item.input_path.name)
    folder = item.output_base.parents[len(PurePosixPath(item.name).parts) - 1]
    frames = []
    for number in range(count):
        place = mirrored.with_name(f"{mirrored.stem}.{number:0{digits}d}{mirrored.suffix}")
        plain = place.with_suffix("").as_posix()
        name = pattern.filled(fields_of(item.input_path, place)) if pattern else plain
        frames.append(Item(item.input_path, folder / name, name, place))
    return Shot(item.output_base, tuple(frames), item.input_path)


def _of_images(photos: Sequence[Item]) -> list[Shot]:
    """Group images by folder and name without number; each group is a shot, by number.

    Raises InputError for a file that does not exist, and for a gap in the numbers of a shot.
    """
    groups: dict[PurePosixPath, dict[Path, str]] = {}
    for item in photos:
        if not item.input_path.is_file():
            raise InputError(f"{item.input_path}: no such file; a shot needs all of its frames")
        place = item.mirrored or PurePosixPath(item.input_path.name)
        match = DOTTED.fullmatch(place.stem)
        stem, number = match.groups() if match else (place.stem, "0")
        groups.setdefault(place.with_name(stem), {})[item.input_path] = number
    items = {item.input_path: item for item in photos}
    shots = ((stem.name, [items[path] for path in in_order(group)]) for stem, group in groups.items())
    return [Shot(frames[0].output_base.with_name(name), tuple(frames)) for name, frames in shots]


def _consecutive(photos: Sequence[Item]) -> tuple[Path, str] | None:
    """The first and last of images whose names differ in consecutive numbers of as many digits."""
    groups: dict[tuple[object, ...], list[tuple[int, Path]]] = {}
    for item in photos:
        if match := _NUMBERED.fullmatch(item.input_path.name):
            before, number, after = match.groups()
            key = item.input_path.parent, before, len(number), after
            groups.setdefault(key, []).append((int(number), item.input_path))
    for group in map(sorted, groups.values()):
        (first, path), (last, last_path) = group[0], group[-1]
        if len(group) >= _FEWEST_FRAMES and last - first == len(group) - 1:
            return path, last_path.name
    return None


def recipe_of_shots(shots: Sequence[Shot], digest_of: DigestOf) -> Recipe:
    """Entries of a recipe: the images of sequences, since a frame depends on its neighbours; --no-cuts."""
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


@dataclass(frozen=True)
class FilmOutput:
    """The film to write, and its rate where that is given."""

    path: Path
    rate: Fraction | None = None

    @property
    def folder(self) -> Path:
        """The folder of the frames, which goes when the film is whole."""
        return self.path.with_name(f"{self.path.name}.frames")

    @property
    def holds_alpha(self) -> bool:
        """True if the film has alpha where its frames have it."""
        return self.path.suffix.lower() == ".mov"

    @property
    def formats(self) -> tuple[Format, ...]:
        return (_FORMATS[self.path.suffix.lower()],)

    @property
    def _journal(self) -> Journal:
        return Journal(self.path.parent, "relight", file=self.path)

    def recipe_if_new(
        self,
        items: Sequence[Item],
        shots: Sequence[Shot],
        images: Sequence[Path],
        recipes_of: RecipesOf,
        batch: BatchOptions,
    ) -> str:
        """Return the digest of the recipe of a film of images; '' in a dry run, or if the film is finished.

        Raises UsageError unless the images are the frames of one film, and InputError where the film would
        replace a file that is not facerf's.
        """
        photos = len(items) - sum(len(shot.frames) for shot in shots)
        one = len(items) == len(images) if shots else len(images) > 1
        if photos + len(shots) != 1 or not one:
            raise UsageError(
                f"-o {self.path}: is one film; give one film and one light, or one photo and --rotate "
                "FROM:TO:N, or a folder with -o"
            )
        if self.rate and shots and shots[0].film:
            raise UsageError("--fps: a film keeps its own times; leave it out")
        digest_of = cache(file_sha256)
        inputs = [digest_of(item.input_path) for item in items]
        recipe = key_of({"film": recipes_of(digest_of), "inputs": inputs, "rate": str(self.rate)})
        if not self._journal.to_make(items[0], [self.path], [recipe], batch.overwrite):
            log.info("%s: is finished and kept", self.path)
            if batch.overwrite == "changed" and not batch.dry_run:
                keep_newer([self.path], [item.input_path for item in items])
            return ""
        if batch.dry_run:
            print(named(f"{items[0].input_path} -> {self.path}"))
            return ""
        if not (shots and shots[0].film) and len({_stated(item, self.rate)[0] for item in items}) > 1:
            log.warning("%s: its frames state several rates; the first one's is used (--fps)", self.path)
        return recipe

    def joined(
        self, items: Sequence[Item], images: Sequence[Path], shots: Sequence[Shot], recipe: str, code: int
    ) -> int:
        """Write the film from its frames, in order, and remove them, unless some failed; the exit code."""
        if code or not all(path.exists() for path in images):
            log.error("%s: not written, since frames failed; the others stay in %s", self.path, self.folder)
            return 1
        from facerf_cli.files.film import Timing, film_timing
        from facerf_cli.files.film_writer import write_film
        from facerf_cli.run.logs import Provenance

        source = shots[0].film if shots else None
        timing = film_timing(source) if source else Timing.steady(len(images), *_stated(items[0], self.rate))
        facts = Provenance(source.name if source else "").attributes()
        said = "; ".join(f"{name}={value}" for name, value in facts.items())
        journal = self._journal
        key = journal.key_of(items[0], recipe)
        write_film(
            self.path, images, timing, f"Synthetic: relit by a trained model; {said}; facerf:key={key}"
        )
        journal.add_file(items[0], self.path, recipe)
        frames = Journal(self.folder, "relight")
        edited = {path for path in images if frames.refusal(path)}
        records = self.folder.glob(".facerf*.jsonl")
        for path in (*images, *(() if edited else (*(shot.track for shot in shots), *records))):
            if path not in edited:
                path.unlink(missing_ok=True)
        if not any(self.folder.iterdir()):
            self.folder.rmdir()
        print(self.path)
        return 0


def _stated(item: Item, rate: Fraction | None) -> tuple[Fraction, str]:
    """Read the frame rate, unless given, and the timecode in an image's header; 24 and "" by default."""
    from facerf_cli.files.image_metadata import read_header

    header = read_header(item.input_path)
    metadata = header.metadata if header else {}
    timecode, stated = "", metadata.get("framesPerSecond")
    if rate is None and isinstance(stated, tuple):
        with suppress(UsageError):
            rate = film_rate("/".join(map(str, stated)))
    with suppress(LookupError, TypeError):  # of another type than a timecode
        packed = metadata["smpte:TimeCode"][0]  # SMPTE 12M: BCD digits, between them flags
        timecode = (packed & 0x3F7F7F3F).to_bytes(4, "big").hex(":")
        timecode = f"{timecode[:8]};{timecode[9:]}" if packed & _DROP_FRAME else timecode
    return rate or _RATE, timecode


def film_output(output: Path, rate: Fraction | None) -> FilmOutput | None:
    """The film that `-o` names; None where it names a folder."""
    suffix = output.suffix.lower()
    if suffix not in _FORMATS or output.is_dir():
        if suffix in FILM_SUFFIXES and not output.is_dir():
            raise UsageError(f"-o {output}: films are written as .mp4 or .mov; give one of these")
        if rate is not None:
            raise UsageError("--fps: is for -o FILE.mp4 or FILE.mov; leave it out")
        folder_not_file(output, ".exr, .png, .jpg, .tif, .mp4 or .mov")
        return None
    from facerf_cli.files.film import require_av

    require_av(output)
    return FilmOutput(output, rate)


def film_rate(text: str) -> Fraction:
    """Parse `--fps`, frames a second."""
    try:
        rate = Fraction(text).limit_denominator(_FINEST_RATE)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not 0 < rate <= _MOST_RATE:
        raise UsageError(f"--fps {text}: not a rate; give frames a second, such as 25 or 24000/1001")
    return rate
