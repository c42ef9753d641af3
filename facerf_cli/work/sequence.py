"""Shots frame by frame: the face is tracked once, and each frame is then fitted with its neighbours."""

import json
import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.errors import InputError
from facerf_cli.face.landmarks import read_landmarks
from facerf_cli.files.read import LinearImage
from facerf_cli.files.video import StoredFrames, Video
from facerf_cli.image.colour import SRGB, named_space, to_display, to_linear_rec709, unit_floats
from facerf_cli.portrait.find import face_at, face_with
from facerf_cli.portrait.segment import Segmentation
from facerf_cli.relighting import BalanceMode
from facerf_cli.relighting.models import described_file
from facerf_cli.relighting.shot import SteadyShot
from facerf_cli.relighting.shot_track import ShotTrack
from facerf_cli.relighting.tracking import FaceTracker, Sighting, with_cuts
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

_COMPLETE = 0.9  # a frame's matte whose maximum is below it shows the person only faintly
log = logging.getLogger(LOGGER_NAME)


class ShotFrames:
    """Frames of a shot as scene-linear images, by number."""

    def __init__(self, shot: Shot, options: PhotoOptions) -> None:
        self._shot, self._options = shot, options
        self._video = video = Video(shot.video) if shot.video else None
        self._stored = StoredFrames(video, shot.base) if video else None
        stated = video.space if video else SRGB
        space = options.colourspace
        self._space = stated if space is None else named_space(space, options.ocio_config)

    def image(self, number: int) -> LinearImage:
        """Return a frame; alpha that is 0 in every frame of the shot is removed."""
        image = self.read(number)
        kept = image.alpha is None or image.alpha.any() or self._has_alpha
        return image if kept else replace(image, alpha=None)

    @cached_property
    def _has_alpha(self) -> bool:
        """True if a frame has alpha that is not 0; reads all frames once."""
        alphas = (image.alpha for image in self.all())
        has_alpha = any(alpha is not None and alpha.any() for alpha in alphas)
        if not has_alpha:
            log.warning("%s: transparent in every frame; ignoring its alpha", self._shot.base.name)
        return has_alpha

    def read(self, number: int) -> LinearImage:
        """Read a frame with its alpha."""
        if self._stored is None:
            return read_photo(self._shot.frames[number], self._options, in_shot=True)
        return self._linear(self._stored.read(number))

    def all(self) -> Iterator[LinearImage]:
        """Read all frames in order."""
        if self._video is None:
            return map(self.read, range(len(self._shot.frames)))
        return map(self._linear, self._video.frames())

    def _linear(self, values: np.ndarray) -> LinearImage:
        pixels = np.ascontiguousarray(to_linear_rec709(values[..., :3], self._space), np.float32)
        alpha = unit_floats(values[..., 3]) if values.shape[2] == 4 else None
        return LinearImage(pixels, alpha, self._space.name)

    @cached_property
    def _shape(self) -> tuple[int, ...]:
        return self.read(0).pixels.shape

    def pixels(self, number: int) -> np.ndarray:
        """Return a frame's pixels [H, W, 3]; raise InputError if its size differs from the first frame's."""
        shape, pixels = self._shape, self.read(number).pixels  # in this order: videos are decoded forward
        if pixels.shape != shape:
            raise InputError("size differs from the first frame; use frames of equal size")
        return pixels


def follow_all(shots: Sequence[Shot], options: PhotoOptions) -> None:
    """Write the track of each shot, unless it is up to date; log cuts and frames without the face.

    Raises InputError if no frame shows a face, and for an outdated track that facerf did not write.
    """
    for shot in shots:
        head = json.loads(json_line(_made_from(shot, options)))
        track = ShotTrack.read(shot.track)
        if track.head != head:
            if os.path.lexists(shot.track) and not track.is_own:
                raise InputError(
                    f"{shot.track}: not written by facerf, or edited since; move it, or choose another -o"
                )
            ShotTrack(head, list(_tracked_rows(shot, options))).write(shot.track)
            track = ShotTrack.read(shot.track)
        if not any(track.sightings):
            raise InputError(f"{shot.frames[0].input_path}: no frame shows a face; use another video")
        track.log_cuts_and_gaps(shot.base.name)


def _tracked_rows(shot: Shot, options: PhotoOptions) -> Iterator[dict[str, Any]]:
    """Yield the row of each frame, with a progress bar on a terminal; after a cut the face is chosen anew."""
    from rich.progress import track

    networks, settings = load_models_once(options).networks.people, options.settings
    frames, count = ShotFrames(shot, options), len(shot.frames)
    log.info("%s: tracking the face through %d frames", shot.base.name, count)
    images = with_cuts(to_display(image.pixels) for image in frames.all())
    hidden = not STDERR.is_terminal or settings.verbosity < 0 or settings.log_json
    with_bar = track(images, "face", count, console=STDERR, disable=hidden, transient=True)
    tracker = FaceTracker(networks, options.face)
    for number, (image, is_cut) in enumerate(with_bar):
        row: dict[str, Any] = {"frame": number}
        if is_cut and shot.cuts:
            row["cut"], tracker = True, FaceTracker(networks, options.face)
        if options.landmarks is None:
            sighting = tracker.track(image)
        else:
            path = companion(shot.frames[number], options.landmarks, "--landmarks")
            with naming(path):
                sighting = Sighting(face_with(networks, image, read_landmarks(path)).landmarks_px, 0.0)
        row["landmarks"] = None
        if sighting is not None:
            row |= {"landmarks": sighting.landmarks_px.round(3), "expected_error": round(sighting.error, 4)}
        yield row


def _made_from(shot: Shot, options: PhotoOptions) -> dict[str, Any]:
    """Return the head of a track: the inputs and options that it depends on."""
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


class OpenShot:
    """A tracked shot in the process that works through its frames.

    Each take is smoothed on its own, as if other takes did not show the face, so nothing crosses a cut.
    """

    def __init__(self, shot: Shot, options: PhotoOptions, white_balance: BalanceMode | None = None) -> None:
        self.shot, self.track, self.frames = shot, ShotTrack.read(shot.track), ShotFrames(shot, options)
        self._options, self._white_balance = options, white_balance
        self._take = range(0)
        self._steady: SteadyShot | None = None

    def take_of(self, number: int) -> SteadyShot:
        """Return the smoothed take of a frame; only the last take is kept."""
        if self._steady is None or number not in self._take:
            self._take = take = next(take for take in self.track.takes if number in take)
            models, options = load_models_once(self._options), self._options
            sightings = [
                sighting if frame in take else None for frame, sighting in enumerate(self.track.sightings)
            ]
            mattes = self._matte_in_take if options.person else None
            sides = models.sides(options.texture_side)
            self._steady = SteadyShot(
                models, self.frames.pixels, sightings, sides, mattes, self._white_balance
            )
        return self._steady

    def _user_matte(self, number: int) -> np.ndarray | None:
        item, pixels = self.shot.frames[number], self.frames.pixels(number)
        return person_matte(item, pixels, self._options, in_shot=True)

    def _matte_in_take(self, number: int) -> np.ndarray:
        """Return the user's matte [H, W] of a frame; raise InputError if it is black in the whole take."""
        matte = self._user_matte(number)
        assert matte is not None
        if not matte.any() and not any(np.any(self._user_matte(other)) for other in self._take):
            raise InputError("its mattes are black in every frame; make them white where the person is")
        return matte

    def _facts_of(self, number: int, landmarks_px: np.ndarray) -> dict[str, float]:
        """Measure the face of a frame, and the user's matte unless it is faint; see `facts_of_face`."""
        if self.track.sightings[number] is None:
            return {"unclear": 1.0}  # interpolated
        item, pixels, options = self.shot.frames[number], self.frames.pixels(number), self._options
        face = face_with(load_models_once(options).networks.people, to_display(pixels), landmarks_px)
        matte = self._user_matte(number)
        is_complete = matte is not None and matte.max() > _COMPLETE
        return facts_of_face(item, face, pixels, options, matte if is_complete else None)

    def segmented(self, number: int) -> tuple[LinearImage, PhotoFace, Segmentation]:
        """Return a frame, its face and its person, smoothed with the frames around it."""
        take, name = self.take_of(number), str(self.shot.frames[number].input_path)
        with naming(name):
            face, segmentation = face_at(take.landmarks_px(number)), take.segmentation(number)
            facts = self._facts_of(number, face.landmarks_px)
        return self.frames.image(number), PhotoFace("", name, face, facts), segmentation

    def fitted(self, number: int, portrait: bool = True) -> tuple[LinearImage, FittedFace]:
        """Return a frame and its head, smoothed with the frames around it; see `SteadyShot.window`."""
        take, name = self.take_of(number), str(self.shot.frames[number].input_path)
        with naming(name):
            steady = take.window(number, portrait)
            head, matte = steady.head, steady.segmentation.matte
            face = face_at(head.fit.crop.to_photo(head.landmarks_px))
            facts = self._facts_of(number, face.landmarks_px)
        index = int(self._options.face) if self._options.face.isdecimal() else 0
        fitted = FittedFace("", name, face, facts, number=index, head=head, steady=steady, matte=matte)
        return self.frames.image(number), fitted


def open_at(
    shots: Shots, item: Item, options: PhotoOptions, white_balance: BalanceMode | None = None
) -> tuple[OpenShot, int] | None:
    """Return the open shot of an item and its frame number; None for a photo."""
    if item.output_base not in shots.places:
        return None
    shot, number = shots.places[item.output_base]
    if shots.opened is None or shots.opened.shot is not shot:
        shots.opened = OpenShot(shot, options, white_balance)
    return shots.opened, number
