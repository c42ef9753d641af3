"""Shots: videos and image sequences as inputs, and videos as outputs. Light to import."""

import hashlib
import logging
import re
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

from facerf_cli.batch.inputs import (
    DOTTED,
    PHOTO_SUFFIXES,
    VIDEO_SUFFIXES,
    Item,
    NamePattern,
    collect_items,
    fields_of,
    in_order,
)
from facerf_cli.batch.journal import Journal
from facerf_cli.batch.recipe import DigestOf, Recipe, RecipesOf, key_of
from facerf_cli.batch.settings import BatchOptions, folder_not_file
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.atomic import is_temporary
from facerf_cli.files.output_options import Format
from facerf_cli.option import BATCH, option
from facerf_cli.run.logs import LOGGER_NAME, named
from facerf_cli.work.photo_options import PhotoOptions, refuse

log = logging.getLogger(LOGGER_NAME)
FRAMES_IN_A_ROW = 8  # frames that one worker takes, since neighbours share work
_FORMATS: dict[str, Format] = {".mp4": "png", ".mov": "png16"}  # of the frames, by the video's suffix
_RATE = Fraction(24)
_MOST_RATE, _FINEST_RATE = 1000, 1001  # FFmpeg's limits of numerators and denominators
_DROP_FRAME = 0x40  # flag in a timecode
_DIGITS = 4  # least digits of a video's frame numbers
_NUMBERED = re.compile(r"(.*?)(\d{2,})(\D*\.\w+)", re.DOTALL)
_FEWEST_FRAMES = 3  # consecutive images that look like a shot


@dataclass(frozen=True)
class ShotOptions:
    """Inputs that are shots.

    Attributes:
        sequence: Treat numbered images (plate_0001.exr, 0001.exr, ...) as frames of one shot.
        no_cuts: Treat a video with cuts as one shot.
    """

    sequence: bool = option(False, panel=BATCH)
    no_cuts: bool = option(False, panel=BATCH)


@dataclass(frozen=True, eq=False)
class Shot:
    """Frames of one person, in order, from a video or from images."""

    base: Path  # output folder / name
    frames: tuple[Item, ...]
    video: Path | None = None
    cuts: bool = True  # each part between cuts is processed on its own

    @property
    def track(self) -> Path:
        """The file of the face's landmarks in each frame."""
        return self.base.with_name(f"{self.base.name}_track.jsonl")


class Shots:
    """The shots of a run, and the shot that this process keeps open (`sequence.open_at`)."""

    def __init__(self, shots: Sequence[Shot] = ()) -> None:
        self.all = tuple(shots)
        self.places = {item.output_base: (shot, n) for shot in shots for n, item in enumerate(shot.frames)}
        self.opened: Any = None

    def __reduce__(self) -> tuple[type["Shots"], tuple[tuple[Shot, ...]]]:
        return Shots, (self.all,)  # another process opens its own


def collect_frames(
    inputs: Sequence[str], options: ShotOptions, batch: BatchOptions, photo: PhotoOptions
) -> tuple[list[Item], tuple[Shot, ...]]:
    """List photos and frames of videos, in order, and the shots that the frames belong to.

    Folders are searched for images only; videos must be named. Raises UsageError for options that shots do
    not support.
    """
    pattern = batch.name
    inputs_found = collect_items(
        inputs, batch.output, PHOTO_SUFFIXES, pattern, photo.settings.null_separated, options.sequence
    )
    videos = [item for item in inputs_found if item.input_path.suffix.lower() in VIDEO_SUFFIXES]
    photos = [item for item in inputs_found if item not in videos]
    shots = [_of_video(item, pattern) for item in videos if item.input_path.exists()]
    missing = [item for item in videos if not item.input_path.exists()]  # reported like missing photos
    if options.sequence:
        shots += _of_images(photos)
        photos = []
        for shot in shots:
            if len(shot.frames) == 1:
                log.warning(
                    "%s: the only frame of its shot; other frames must have the same name but for the number",
                    shot.frames[0].input_path,
                )
    elif frames := _consecutive(photos):
        log.info("%s to %s: processed as separate photos; add --sequence if they are one shot", *frames)
    shots = [replace(shot, cuts=not options.no_cuts) for shot in shots]
    if shots:
        rules = {
            "--face all: only one face per shot is supported; use --face INDEX for each": photo.face == "all",
            "--geometry network: shots are fitted to landmarks; remove it": photo.geometry == "network",
            "--landmarks: not supported for frames of a video; remove it": (
                photo.landmarks is not None and any(shot.video for shot in shots)
            ),
            "--shard: frames of a shot must stay together; use --jobs": batch.shard.of > 1,
        }
        refuse(rules)
    return [*photos, *missing, *(item for shot in shots for item in shot.frames)], tuple(shots)


def _of_video(item: Item, pattern: NamePattern | None) -> Shot:
    from facerf_cli.files.video import video_timing

    count = len(video_timing(item.input_path).times_s)
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
    """Group images by folder and name without number; each group is a shot.

    Raises InputError for a missing file, and for a gap in a shot's numbers.
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
    """Return the first and last of images whose names differ only in consecutive numbers."""
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
    """Return recipe entries: --no-cuts, and all images of sequences, since frames depend on neighbours."""
    recipe: Recipe = {} if all(shot.cuts for shot in shots) else {"cuts": False}
    images = [item.input_path for shot in shots if shot.video is None for item in shot.frames]
    if not images:
        return recipe
    try:
        digests = "".join(map(digest_of, images))
    except InputError:  # reported with the item
        digests = ""
    return {**recipe, "sequence": "sha256:" + hashlib.sha256(digests.encode()).hexdigest()}


def whole_shots(items: Sequence[Item], shots: Sequence[Shot]) -> list[Item]:
    """Return the items with one item per shot, its first frame, instead of all its frames."""
    inside = {item.output_base for shot in shots for item in shot.frames}
    whole = [item for item in items if item.output_base not in inside]
    for shot in shots:
        name = PurePosixPath(shot.frames[0].name).with_name(shot.base.name).as_posix()
        whole.append(replace(shot.frames[0], output_base=shot.base, name=name))
    return whole


@dataclass(frozen=True)
class VideoOutput:
    """The video to write, and its frame rate if the user chose one."""

    path: Path
    rate: Fraction | None = None

    @property
    def folder(self) -> Path:
        """The folder of the frames, which is removed when the video is complete."""
        return self.path.with_name(f"{self.path.name}.frames")

    @property
    def holds_alpha(self) -> bool:
        return self.path.suffix.lower() == ".mov"

    @property
    def formats(self) -> tuple[Format, ...]:
        return (_FORMATS[self.path.suffix.lower()],)

    @cached_property
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
        """Return the digest of the recipe of a video; '' in a dry run, or if the video is up to date.

        Raises UsageError unless the images are the frames of one video, and InputError if the video would
        replace a file that facerf did not write.
        """
        photos = len(items) - sum(len(shot.frames) for shot in shots)
        is_one = len(items) == len(images) if shots else len(images) > 1
        if photos + len(shots) != 1 or not is_one:
            raise UsageError(
                f"-o {self.path}: one video needs one video and one light, or one photo and --rotate "
                "FROM:TO:N; for more, use a folder"
            )
        video = shots[0].video if shots else None
        if self.rate and video:
            raise UsageError("--fps: a video keeps its own frame times; remove it")
        journal = self._journal
        inputs = [journal.digest_of(item.input_path) for item in items]
        recipe = key_of({"video": recipes_of(journal.digest_of), "inputs": inputs, "rate": str(self.rate)})
        if not journal.to_make(items[0], [self.path], [recipe], batch.overwrite):
            log.info("%s: up to date", self.path)
            return ""
        if batch.dry_run:
            print(named(f"{items[0].input_path} -> {self.path}"))
            return ""
        if video:
            from facerf_cli.files.video_writer import check_writable

            check_writable(self.path, video)
        elif len({_stated(item, self.rate)[0] for item in items}) > 1:
            log.warning("%s: frames state different rates; using the first one's (--fps)", self.path)
        return recipe

    def joined(
        self, items: Sequence[Item], images: Sequence[Path], shots: Sequence[Shot], recipe: str, code: int
    ) -> int:
        """Encode the frames as a video and remove them, unless some failed; return the exit code."""
        if code or not all(path.exists() for path in images):
            log.error(
                "%s: not written because frames failed; the others remain in %s", self.path, self.folder
            )
            return 1
        from facerf_cli.files.image_metadata import Provenance
        from facerf_cli.files.video import Timing, Video
        from facerf_cli.files.video_writer import write_video

        source = shots[0].video if shots else None
        timing = Video(source).timing if source else Timing.steady(len(images), *_stated(items[0], self.rate))
        facts = Provenance(source.name if source else "").attributes()
        provenance = "; ".join(f"{name}={value}" for name, value in facts.items())
        key = self._journal.key_of(items[0], recipe)
        comment = f"Synthetic: relit by a trained model; {provenance}; facerf:key={key}"
        write_video(self.path, images, timing, comment)
        self._journal.add_file(self.path, items[0], recipe)
        frames = Journal(self.folder, "relight")
        edited = {path for path in images if frames.refusal(path)}
        records = () if edited else (*(shot.track for shot in shots), *self.folder.glob(".facerf*.jsonl"))
        for path in (*(path for path in images if path not in edited), *records):
            path.unlink(missing_ok=True)
        if all(map(is_temporary, self.folder.iterdir())):  # decoded frames
            shutil.rmtree(self.folder)
        print(self.path)
        return 0


def _stated(item: Item, rate: Fraction | None) -> tuple[Fraction, str]:
    """Return the user's frame rate, or that in an image's header, or 24; and the header's timecode, or ''."""
    from facerf_cli.files.image_metadata import read_header

    header = read_header(item.input_path)
    metadata = header.metadata if header else {}
    timecode, stated = "", metadata.get("framesPerSecond")
    if rate is None and isinstance(stated, tuple):
        with suppress(UsageError):
            rate = video_rate("/".join(map(str, stated)))
    with suppress(LookupError, TypeError):  # not a timecode
        packed = metadata["smpte:TimeCode"][0]  # SMPTE 12M: BCD digits, between them flags
        timecode = (packed & 0x3F7F7F3F).to_bytes(4, "big").hex(":")
        timecode = f"{timecode[:8]};{timecode[9:]}" if packed & _DROP_FRAME else timecode
    return rate or _RATE, timecode


def video_output(output: Path, rate: Fraction | None) -> VideoOutput | None:
    """Return the video that `-o` names; None for a folder."""
    suffix = output.suffix.lower()
    if suffix in _FORMATS and not output.is_dir():
        from facerf_cli.files.video import require_av

        require_av(output)
        return VideoOutput(output, rate)
    if suffix in VIDEO_SUFFIXES and not output.is_dir():
        raise UsageError(f"-o {output}: videos are written as .mp4 or .mov; use one of these")
    folder_not_file(output, ".exr, .png, .jpg, .tif, .mp4 or .mov")
    return None


def video_rate(text: str) -> Fraction:
    """Parse `--fps`, frames per second."""
    try:
        rate = Fraction(text).limit_denominator(_FINEST_RATE)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not 0 < rate <= _MOST_RATE:
        raise UsageError(f"--fps {text}: not a frame rate; use frames per second, such as 25 or 24000/1001")
    return rate
