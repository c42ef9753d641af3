"""Frames of a shot: its face followed once, in a file, and the view of it that each frame needs."""

import hashlib
import json
import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.settings import Settings
from facerf_cli.errors import InputError
from facerf_cli.face.landmarks import read_landmarks, to_display
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.film import Film
from facerf_cli.files.read import LinearImage
from facerf_cli.image.colour import SRGB, named_space, to_linear_rec709, unit_floats
from facerf_cli.portrait.find import face_at, face_with
from facerf_cli.portrait.segment import Segmentation
from facerf_cli.relighting import White
from facerf_cli.relighting.models import described_file
from facerf_cli.relighting.sequence import LONGEST_GAP, Follower, Sighting, SteadyShot, gaps, takes, with_cuts
from facerf_cli.run.logs import LOGGER_NAME, STDERR, json_line
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.photos import (
    FittedFace,
    PhotoFace,
    companion,
    facts_of_face,
    load_models_once,
    naming,
    person_matte,
    read_photo,
)
from facerf_cli.work.shots import Shot, Shots

_WHOLE = 0.9  # largest value of a matte from which on the person is all there
_SEAL = '{"sha256": '  # begins the last row of a track
_DECODED = 12  # frames of a film that are kept as they were decoded
T = TypeVar("T")
log = logging.getLogger(LOGGER_NAME)


class ShotFrames:
    """Frames of a shot as scene-linear images, by number."""

    def __init__(self, shot: Shot, options: PhotoOptions) -> None:
        self._shot, self._options = shot, options
        space = options.colourspace
        self._film = Film(shot.film) if shot.film else None
        stated = self._film.space if self._film else SRGB
        self._space = stated if space is None else named_space(space, options.ocio_config)
        self._decoded: dict[int, np.ndarray] = {}
        self._shape: tuple[int, ...] = ()

    def image(self, number: int) -> LinearImage:
        """Frame `number`; alpha that is 0 in every frame is none."""
        image = self.read(number)
        kept = image.alpha is None or image.alpha.any() or self._has_alpha
        return image if kept else replace(image, alpha=None)

    @cached_property
    def _has_alpha(self) -> bool:
        """True if a frame has alpha that is not 0; all of them are read for this, once."""
        alphas = (self.read(number).alpha for number in range(len(self._shot.frames)))
        found = any(alpha is not None and alpha.any() for alpha in alphas)
        if not found:
            log.warning("%s: is transparent in every frame; its alpha is left out", self._shot.base.name)
        return found

    def read(self, number: int) -> LinearImage:
        """Frame `number` with the alpha that it has itself."""
        if self._film is None:
            return read_photo(self._shot.frames[number], self._options, in_shot=True)
        if number not in self._decoded:
            if len(self._decoded) == _DECODED:
                del self._decoded[next(iter(self._decoded))]  # the first that was decoded
            self._decoded[number] = self._film.read(number)
        values = self._decoded[number]
        pixels = np.ascontiguousarray(to_linear_rec709(values[..., :3], self._space), np.float32)
        alpha = unit_floats(values[..., 3]) if values.shape[2] == 4 else None
        return LinearImage(pixels, alpha, self._space.name)

    def __getitem__(self, number: int, /) -> np.ndarray:
        """Pixels [H, W, 3]; raises InputError where their size is not that of the first frame."""
        self._shape = self._shape or self.read(0).pixels.shape
        pixels = self.read(number).pixels
        if pixels.shape != self._shape:
            raise InputError("is not of the size of the first frame; give frames of one size")
        return pixels


@dataclass(frozen=True)
class ShotMattes:
    """Given mattes of the person in the frames of a take, by number."""

    shot: Shot
    take: range
    frames: ShotFrames
    options: PhotoOptions

    def __getitem__(self, number: int, /) -> np.ndarray:
        """A matte [H, W], which may be black; raises InputError where all are."""
        found = self._read(number)
        if not found.any() and not any(self._read(other).any() for other in self.take):
            raise InputError("its mattes are black in every frame; make them white where the person is")
        return found

    def _read(self, number: int) -> np.ndarray:
        found = person_matte(self.shot.frames[number], self.frames[number], self.options, in_shot=True)
        assert found is not None
        return found


class ShotTrack:
    """The face and the cuts of a shot, as the file beside its outputs has them: a head, and a row per frame.

    The last row is the SHA-256 of all before it, which tells whether the user has edited the file. A run that
    was killed may leave half a row, which is cut off.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.head: Any = None
        self.sightings: list[Sighting | None] = []
        self.cuts: list[int] = []  # first frames of takes, but for that of the first take
        text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
        self._is_facerfs = not text and (path.is_file() or not os.path.lexists(path))
        content, mark, seal = text.partition(_SEAL)
        whole = text if mark else text[: text.rfind("\n") + 1]
        content = content if mark else whole
        try:
            self.head, *rows = map(json.loads, content.splitlines())
            for row in rows:
                self._take(row)
        except (ValueError, TypeError, KeyError, AttributeError):  # not a track
            return
        self._is_facerfs = isinstance(self.head, dict) and "parsing" in self.head
        self._is_facerfs &= self._seal(content).startswith(seal)
        if whole != text and self._is_facerfs:
            path.write_text(whole, encoding="utf-8")

    @property
    def takes(self) -> list[range]:
        return takes(len(self.sightings), self.cuts)

    @property
    def takes_with_face(self) -> list[range]:
        """The frames of each take that shows the face."""
        return [take for take in self.takes if any(self.sightings[take.start : take.stop])]

    def begin(self, head: Any) -> None:
        """Forget all frames, unless they were made from what the head says.

        Raises InputError for a file that facerf did not write, or that was changed since.
        """
        head = json.loads(json_line(head))
        if self.head != head:
            if not self._is_facerfs:
                raise InputError(
                    f"{self._path}: was not written by facerf, or was changed since; move it, or choose "
                    "another -o"
                )
            with atomic_path(self._path) as temporary:
                temporary.write_text(json_line(head) + "\n", encoding="utf-8")
            self.head, self.sightings, self.cuts = head, [], []

    def add(self, seen: Sighting | None, cut: bool) -> None:
        """Add the next frame, to the file at once."""
        row: dict[str, Any] = {
            "frame": len(self.sightings),
            **({"cut": True} if cut else {}),
            "landmarks": None,
        }
        if seen is not None:
            row |= {"landmarks": seen.landmarks_px.round(3), "expected_error": round(seen.error, 4)}
        line = json_line(row)
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(line + "\n")
        self._take(json.loads(line))
        if len(self.sightings) == self.head["frames"]:
            seal = self._seal(self._path.read_text(encoding="utf-8"))
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(_SEAL + seal)

    @staticmethod
    def _seal(content: str) -> str:
        return f'"{hashlib.sha256(content.encode()).hexdigest()}"}}\n'

    def _take(self, row: dict[str, Any]) -> None:
        if row.get("cut"):
            self.cuts.append(len(self.sightings))
        given = row.get("landmarks")
        seen = None if given is None else Sighting(np.array(given, np.float64), float(row["expected_error"]))
        self.sightings.append(seen)


def follow_all(shots: Sequence[Shot], options: PhotoOptions) -> None:
    """Follow the face through each shot, from where an earlier run stopped; say where it is lost.

    After a cut the face is chosen as in a new film.
    """
    for shot in shots:
        track = ShotTrack(shot.track)
        track.begin(_made_from(shot, options))
        if len(track.sightings) < len(shot.frames):
            _follow(shot, track, options)
        _log_cuts_and_gaps(shot, track)


def _follow(shot: Shot, track: ShotTrack, options: PhotoOptions) -> None:
    first = len(track.sightings)
    in_take = track.sightings[[0, *track.cuts][-1] :]
    last = next((seen.landmarks_px for seen in reversed(in_take) if seen), None)
    networks, frames = load_models_once(options).networks.people, ShotFrames(shot, options)
    follower = Follower(networks, options.face, last)
    images = with_cuts(lambda number: to_display(frames.read(number).pixels), first, len(shot.frames))
    for number, image, cut in _with_progress(images, first, shot, options.settings):
        cut = cut and shot.cuts
        if cut:
            follower = Follower(networks, options.face)
        if options.landmarks is None:
            seen = follower.see(image)
        else:
            path = companion(shot.frames[number], options.landmarks, "--landmarks")
            with naming(path):
                seen = Sighting(face_with(networks, image, read_landmarks(path)).landmarks_px, 0.0)
        track.add(seen, cut)


def _made_from(shot: Shot, options: PhotoOptions) -> dict[str, Any]:
    """The first row of a track: what it was made from."""
    states = [os.stat(path) for path in dict.fromkeys(item.input_path for item in shot.frames)]
    return {
        "frames": len(shot.frames),
        "files": [[state.st_size, state.st_mtime_ns, state.st_ctime_ns] for state in states],
        "cuts": shot.cuts,
        "face": options.face,
        "landmarks": options.landmarks,
        "colourspace": options.colourspace,
        "layer": options.layer,
        "parsing": described_file(load_models_once(options).networks.files["parsing"])["sha256"],
    }


def _with_progress(frames: Iterator[T], first: int, shot: Shot, settings: Settings) -> Iterable[T]:
    """The frames, with a progress bar on a terminal."""
    from rich.progress import track

    hidden = not STDERR.is_terminal or settings.verbosity < 0 or settings.log_json
    count = len(shot.frames)
    log.info("%s: following the face through %d frames", shot.base.name, count)
    return track(frames, "face", count - first, console=STDERR, disable=hidden, transient=True)


def _log_cuts_and_gaps(shot: Shot, track: ShotTrack) -> None:
    """Say where a film cuts, and where its face is not seen."""
    sightings, cuts = track.sightings, track.cuts
    if not any(sightings):
        raise InputError(f"{shot.frames[0].input_path}: no frame shows a face; give another film")
    if cuts:
        at = f"frame{'s' * (len(cuts) > 1)} {', '.join(map(str, cuts))}"
        log.warning(
            "%s: cuts at %s: each part is a shot for itself (--no-cuts: one shot)", shot.base.name, at
        )
    for take in track.takes:
        inside = sightings[take.start : take.stop]
        for first, last in gaps(inside):
            bridged = first > 0 and last + 1 < len(inside) and last - first < LONGEST_GAP
            result = "filled in from the frames around" if bridged else "not relit; cut them off"
            begin, end = take.start + first, take.start + last
            names = f"frame {begin}" if begin == end else f"frames {begin} to {end}"
            log.warning("%s: %s: the face is not seen; %s", shot.base.name, names, result)


class OpenShot:
    """A shot that was followed, as the process holds it that works through its frames.

    Each take is steadied alone: to it no other shows a face, so that nothing crosses a cut.
    """

    def __init__(self, shot: Shot, options: PhotoOptions, white: White | None = None) -> None:
        self.shot, self.track, self.frames = shot, ShotTrack(shot.track), ShotFrames(shot, options)
        self._options, self._white = options, white
        self._take = range(0)
        self._steady: SteadyShot | None = None

    def take_of(self, number: int) -> SteadyShot:
        """The take of a frame, steadied; the last one is kept."""
        if self._steady is None or number not in self._take:
            self._take = take = next(take for take in self.track.takes if number in take)
            models, options = load_models_once(self._options), self._options
            sightings = [seen if one in take else None for one, seen in enumerate(self.track.sightings)]
            mattes = ShotMattes(self.shot, take, self.frames, options) if options.person else None
            sides = models.sides(options.texture_side)
            self._steady = SteadyShot(models, self.frames, sightings, sides, mattes, self._white)
        return self._steady

    def _facts_of(self, number: int, landmarks_px: np.ndarray) -> dict[str, float]:
        """Measure the face of a frame, and a given matte unless it is faint; see `facts_of_face`."""
        if self.track.sightings[number] is None:
            return {"unclear": 1.0}  # filled in
        item, pixels, options = self.shot.frames[number], self.frames[number], self._options
        face = face_with(load_models_once(options).networks.people, to_display(pixels), landmarks_px)
        matte = person_matte(item, pixels, options, in_shot=True)
        shown = matte is not None and matte.max() > _WHOLE
        return facts_of_face(item, face, pixels, options, matte if shown else None)

    def segmented(self, number: int) -> tuple[LinearImage, PhotoFace, Segmentation]:
        """A frame, its face, and its person, steadied by the frames around it."""
        take = self.take_of(number)
        with self._naming(number):
            face, found = face_at(take.landmarks_px(number)), take.segmentation(number)
            facts = self._facts_of(number, face.landmarks_px)
        person = PhotoFace("", str(self.shot.frames[number].input_path), face, facts)
        return self.frames.image(number), person, found

    def fitted(self, number: int, portrait: bool = True) -> tuple[LinearImage, FittedFace]:
        """A frame, and its head with what is steadied by the frames around it; see `SteadyShot.window`."""
        take = self.take_of(number)
        with self._naming(number):
            steady = take.window(number, portrait)
            head, matte = steady.head, steady.segmentation.matte
            found = face_at(head.fit.crop.to_photo(head.landmarks_px))
            facts = self._facts_of(number, found.landmarks_px)
        which, name = self._options.face, str(self.shot.frames[number].input_path)
        left = int(which) if which.isdecimal() else 0
        face = FittedFace("", name, found, facts, number=left, head=head, steady=steady, matte=matte)
        return self.frames.image(number), face

    @contextmanager
    def _naming(self, number: int) -> Iterator[None]:
        """Put the name of a frame's file before an error that lacks it."""
        try:
            yield
        except InputError as error:
            before = f"{self.shot.frames[number].input_path}: "
            raise InputError(before + str(error).removeprefix(before)) from None


def open_at(
    shots: Shots, item: Item, options: PhotoOptions, white: White | None = None
) -> tuple[OpenShot, int] | None:
    """The shot of an item, and its number there; None for a photo alone."""
    if item.output_base not in shots.places:
        return None
    shot, number = shots.places[item.output_base]
    if shots.opened is None or shots.opened.shot is not shot:
        shots.opened = OpenShot(shot, options, white)
    return shots.opened, number
