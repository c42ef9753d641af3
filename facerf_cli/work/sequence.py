"""Frames of a shot: its face followed once, in a file, and the view of it that each frame needs."""

import hashlib
import json
import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, starmap
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.errors import InputError
from facerf_cli.face.landmarks import read_landmarks
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.film import Film
from facerf_cli.files.read import LinearImage
from facerf_cli.image.colour import SRGB, named_space, to_display, to_linear_rec709, unit_floats
from facerf_cli.portrait.find import face_at, face_with
from facerf_cli.portrait.segment import Segmentation
from facerf_cli.relighting import White
from facerf_cli.relighting.models import described_file
from facerf_cli.relighting.shot import SteadyShot
from facerf_cli.relighting.tracking import FaceTracker, Sighting, gaps, is_bridged, with_cuts
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
log = logging.getLogger(LOGGER_NAME)


class ShotFrames:
    """Frames of a shot as scene-linear images, by number."""

    def __init__(self, shot: Shot, options: PhotoOptions) -> None:
        self._shot, self._options = shot, options
        self._film = Film(shot.film) if shot.film else None
        stated = self._film.space if self._film else SRGB
        space = options.colourspace
        self._space = stated if space is None else named_space(space, options.ocio_config)

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
        values = self._film.read(number)
        pixels = np.ascontiguousarray(to_linear_rec709(values[..., :3], self._space), np.float32)
        alpha = unit_floats(values[..., 3]) if values.shape[2] == 4 else None
        return LinearImage(pixels, alpha, self._space.name)

    @cached_property
    def _shape(self) -> tuple[int, ...]:
        return self.read(0).pixels.shape

    def pixels(self, number: int) -> np.ndarray:
        """Pixels [H, W, 3]; raises InputError where their size is not that of the first frame."""
        pixels = self.read(number).pixels
        if pixels.shape != self._shape:
            raise InputError("is not of the size of the first frame; give frames of one size")
        return pixels


@dataclass(frozen=True)
class ShotTrack:
    """The face and the cuts of a shot: a head that says what they were made from, and a row per frame.

    In the file beside the shot's outputs, the head also has the SHA-256 of the rows, which tells whether the
    user has edited them.
    """

    head: Any
    rows: Sequence[dict[str, Any]]
    is_own: bool = True  # written by facerf, and not edited

    @staticmethod
    def read(path: Path) -> "ShotTrack":
        """Read a track; without a head if there is none, or none that facerf reads."""
        try:
            first, *lines = path.read_text(encoding="utf-8").splitlines()
            head = json.loads(first)
            is_own = head.pop("sha256") == _digest(lines)
            track = ShotTrack(head, [json.loads(line) for line in lines], is_own)
            return track if len(track.sightings) == head["frames"] else ShotTrack(None, (), False)
        except (OSError, ValueError, TypeError, KeyError, AttributeError):  # not a track
            return ShotTrack(None, (), False)

    def write(self, path: Path) -> None:
        """Write the track."""
        lines = [json_line(row) for row in self.rows]
        head = json_line({**self.head, "sha256": _digest(lines)})
        with atomic_path(path) as temporary:
            temporary.write_text("".join(f"{line}\n" for line in (head, *lines)), encoding="utf-8")

    @cached_property
    def sightings(self) -> list[Sighting | None]:
        """The face in each frame; None where it is not seen."""
        return [
            Sighting(np.array(row["landmarks"], np.float64), float(row["expected_error"]))
            if row["landmarks"] is not None
            else None
            for row in self.rows
        ]

    @property
    def cuts(self) -> list[int]:
        """First frames of takes, but for that of the first take."""
        return [number for number, row in enumerate(self.rows) if row.get("cut")]

    @property
    def takes(self) -> list[range]:
        """The frames of each take, in order."""
        return list(starmap(range, pairwise([0, *self.cuts, len(self.rows)])))

    @property
    def takes_with_face(self) -> list[range]:
        """The frames of each take that shows the face."""
        return [take for take in self.takes if any(self.sightings[take.start : take.stop])]


def _digest(lines: Sequence[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def follow_all(shots: Sequence[Shot], options: PhotoOptions) -> None:
    """Follow the face through each shot, unless its track is there; say where the face is lost.

    After a cut the face is chosen as in a new film. Raises InputError for a track that was made from
    something else and that the user wrote or edited.
    """
    for shot in shots:
        head = json.loads(json_line(_made_from(shot, options)))
        track = ShotTrack.read(shot.track)
        if track.head != head:
            if os.path.lexists(shot.track) and not track.is_own:
                raise InputError(
                    f"{shot.track}: was not written by facerf, or was changed since; move it, or choose "
                    "another -o"
                )
            ShotTrack(head, list(_followed(shot, options))).write(shot.track)
        _log_cuts_and_gaps(shot, ShotTrack.read(shot.track))


def _followed(shot: Shot, options: PhotoOptions) -> Iterator[dict[str, Any]]:
    """Yield the row of each frame, with a progress bar on a terminal."""
    from rich.progress import track

    networks, settings = load_models_once(options).networks.people, options.settings
    frames, count = ShotFrames(shot, options), len(shot.frames)
    log.info("%s: following the face through %d frames", shot.base.name, count)
    images = with_cuts(to_display(frames.read(number).pixels) for number in range(count))
    hidden = not STDERR.is_terminal or settings.verbosity < 0 or settings.log_json
    shown = track(images, "face", count, console=STDERR, disable=hidden, transient=True)
    tracker = FaceTracker(networks, options.face)
    for number, (image, cut) in enumerate(shown):
        row: dict[str, Any] = {"frame": number}
        if cut and shot.cuts:
            row["cut"], tracker = True, FaceTracker(networks, options.face)
        if options.landmarks is None:
            seen = tracker.track(image)
        else:
            path = companion(shot.frames[number], options.landmarks, "--landmarks")
            with naming(path):
                seen = Sighting(face_with(networks, image, read_landmarks(path)).landmarks_px, 0.0)
        row["landmarks"] = None
        if seen is not None:
            row |= {"landmarks": seen.landmarks_px.round(3), "expected_error": round(seen.error, 4)}
        yield row


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
            bridged = is_bridged(first, last, len(inside))
            result = "filled in from the frames around" if bridged else "not relit; cut them off"
            begin, end = take.start + first, take.start + last
            names = f"frame {begin}" if begin == end else f"frames {begin} to {end}"
            log.warning("%s: %s: the face is not seen; %s", shot.base.name, names, result)


class OpenShot:
    """A shot that was followed, as the process holds it that works through its frames.

    Each take is steadied alone: to it no other shows a face, so that nothing crosses a cut.
    """

    def __init__(self, shot: Shot, options: PhotoOptions, white: White | None = None) -> None:
        self.shot, self.track, self.frames = shot, ShotTrack.read(shot.track), ShotFrames(shot, options)
        self._options, self._white = options, white
        self._take = range(0)
        self._steady: SteadyShot | None = None

    def take_of(self, number: int) -> SteadyShot:
        """The take of a frame, steadied; the last one is kept."""
        if self._steady is None or number not in self._take:
            self._take = take = next(take for take in self.track.takes if number in take)
            models, options = load_models_once(self._options), self._options
            sightings = [seen if one in take else None for one, seen in enumerate(self.track.sightings)]
            mattes = self._matte_in_take if options.person else None
            sides = models.sides(options.texture_side)
            self._steady = SteadyShot(models, self.frames.pixels, sightings, sides, mattes, self._white)
        return self._steady

    def _given_matte(self, number: int) -> np.ndarray | None:
        item, pixels = self.shot.frames[number], self.frames.pixels(number)
        return person_matte(item, pixels, self._options, in_shot=True)

    def _matte_in_take(self, number: int) -> np.ndarray:
        """The given matte [H, W] of a frame; raises InputError where it is black in the whole take."""
        matte = self._given_matte(number)
        assert matte is not None
        if not matte.any() and not any(np.any(self._given_matte(other)) for other in self._take):
            raise InputError("its mattes are black in every frame; make them white where the person is")
        return matte

    def _facts_of(self, number: int, landmarks_px: np.ndarray) -> dict[str, float]:
        """Measure the face of a frame, and a given matte unless it is faint; see `facts_of_face`."""
        if self.track.sightings[number] is None:
            return {"unclear": 1.0}  # filled in
        item, pixels, options = self.shot.frames[number], self.frames.pixels(number), self._options
        face = face_with(load_models_once(options).networks.people, to_display(pixels), landmarks_px)
        matte = self._given_matte(number)
        shown = matte is not None and matte.max() > _WHOLE
        return facts_of_face(item, face, pixels, options, matte if shown else None)

    def segmented(self, number: int) -> tuple[LinearImage, PhotoFace, Segmentation]:
        """A frame, its face, and its person, steadied by the frames around it."""
        take = self.take_of(number)
        with naming(self.shot.frames[number].input_path):
            face, found = face_at(take.landmarks_px(number)), take.segmentation(number)
            facts = self._facts_of(number, face.landmarks_px)
        person = PhotoFace("", str(self.shot.frames[number].input_path), face, facts)
        return self.frames.image(number), person, found

    def fitted(self, number: int, portrait: bool = True) -> tuple[LinearImage, FittedFace]:
        """A frame, and its head with what is steadied by the frames around it; see `SteadyShot.window`."""
        take = self.take_of(number)
        with naming(self.shot.frames[number].input_path):
            steady = take.window(number, portrait)
            head, matte = steady.head, steady.segmentation.matte
            found = face_at(head.fit.crop.to_photo(head.landmarks_px))
            facts = self._facts_of(number, found.landmarks_px)
        which, name = self._options.face, str(self.shot.frames[number].input_path)
        left = int(which) if which.isdecimal() else 0
        face = FittedFace("", name, found, facts, number=left, head=head, steady=steady, matte=matte)
        return self.frames.image(number), face


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
