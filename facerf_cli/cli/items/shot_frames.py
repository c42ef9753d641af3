"""Frames of a shot: its face followed once, in a file, and the view of it that each frame needs."""

import json
import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from facerf_cli.cli.items.companions import companion
from facerf_cli.cli.items.photos import LANDMARK_SUFFIXES, FittedFace, load_models_once, read_photo
from facerf_cli.cli.options import Settings
from facerf_cli.cli.photo_options import PhotoOptions
from facerf_cli.cli.shots import Shot
from facerf_cli.colour import SRGB, named_space, to_linear_rec709
from facerf_cli.errors import InputError
from facerf_cli.face.landmarks import Face, face_at, read_landmarks, to_display
from facerf_cli.files.film import Film
from facerf_cli.files.images import LinearImage
from facerf_cli.film.follow import LONGEST_GAP, Follower, Sighting, gaps
from facerf_cli.film.shot_view import ShotView
from facerf_cli.logs import LOGGER_NAME, STDERR, json_line
from facerf_cli.portrait.segment import Segmentation

_DECODED = 12  # frames of a film that are kept as they were decoded
log = logging.getLogger(LOGGER_NAME)


class ShotFrames:
    """Frames of a shot as scene-linear images, by number."""

    def __init__(self, shot: Shot, options: PhotoOptions) -> None:
        self._shot, self._options = shot, options
        space = options.colourspace
        self._space = SRGB if space is None else named_space(space, options.ocio_config)
        self._film = Film(shot.film) if shot.film else None
        self._decoded = lru_cache(_DECODED)(self._film.read) if self._film else None

    def image(self, number: int) -> LinearImage:
        """Frame `number`."""
        if self._decoded is None:
            return read_photo(self._shot.frames[number], self._options)
        values = self._decoded(number)
        shown = values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)
        pixels = np.ascontiguousarray(to_linear_rec709(shown, self._space), np.float32)
        return LinearImage(pixels, None, self._space.name)

    def pixels(self, number: int) -> np.ndarray:
        """Frame `number` [H, W, 3]; raises InputError where its size is not that of the first."""
        pixels = self.image(number).pixels
        if pixels.shape != self._shape:
            raise InputError("is not of the size of the first frame; give frames of one size")
        return pixels

    @cached_property
    def _shape(self) -> tuple[int, ...]:
        return self.image(0).pixels.shape


def follow_shot(shot: Shot, options: PhotoOptions, settings: Settings) -> None:
    """Follow the face through a shot, from the frame on where an earlier run stopped; say where it is lost.

    The landmarks of each frame are added to the shot's track at once.
    """
    if missing := [item for item in shot.frames if not item.input_path.is_file()]:
        raise InputError(f"{missing[0].input_path}: no such file; a shot needs all of its frames")
    head = json.loads(json_line(_made_from(shot, options)))
    rows = _rows(shot)
    if not rows or rows[0] != head:
        rows = [head]
        shot.track.parent.mkdir(parents=True, exist_ok=True)
        shot.track.write_text(json_line(head) + "\n", encoding="utf-8")
    sightings = list(map(_sighting, rows[1:]))
    if len(sightings) < len(shot.frames):
        last = next((seen.landmarks_px for seen in reversed(sightings) if seen), None)
        follower = Follower(options.face, options.landmarks_from, last)
        frames = ShotFrames(shot, options)
        with shot.track.open("a", encoding="utf-8") as stream:
            for number in _shown(range(len(sightings), len(shot.frames)), shot, settings):
                seen = _see(shot, number, frames, follower, options)
                sightings.append(seen)
                stream.write(json_line(_row(number, seen)) + "\n")
                stream.flush()
    _say_gaps(shot, sightings)


def _see(
    shot: Shot, number: int, frames: ShotFrames, follower: Follower, options: PhotoOptions
) -> Sighting | None:
    if options.landmarks is None:
        return follower.see(to_display(frames.image(number).pixels))
    path = companion(shot.frames[number], options.landmarks, LANDMARK_SUFFIXES, "--landmarks")
    return Sighting(read_landmarks(path), 0.0)


def _made_from(shot: Shot, options: PhotoOptions) -> dict[str, Any]:
    """The first row of a track: what it was made from."""
    states = [os.stat(path) for path in dict.fromkeys(item.input_path for item in shot.frames)]
    return {
        "frames": len(shot.frames),
        "files": [[state.st_size, state.st_mtime_ns] for state in states],
        "face": options.face,
        "landmarks_from": options.landmarks_from,
        "landmarks": options.landmarks,
        "colourspace": options.colourspace,
    }


def _rows(shot: Shot) -> list[dict[str, Any]]:
    """Rows of a track that are whole; a run that was killed may leave half a row."""
    rows = []
    if shot.track.is_file():
        text = shot.track.read_text(encoding="utf-8", errors="replace")
        for line in text[: text.rfind("\n") + 1].splitlines():
            try:
                rows.append(json.loads(line))
            except ValueError:
                return []
        if not text.endswith("\n"):
            shot.track.write_text("".join(json_line(row) + "\n" for row in rows), encoding="utf-8")
    return rows


def _row(number: int, seen: Sighting | None) -> dict[str, Any]:
    if seen is None:
        return {"frame": number, "landmarks": None}
    return {"frame": number, "landmarks": seen.landmarks_px.round(3), "expected_error": round(seen.error, 4)}


def _sighting(row: dict[str, Any]) -> Sighting | None:
    given = row.get("landmarks")
    return None if given is None else Sighting(np.array(given, np.float64), float(row["expected_error"]))


def _shown(numbers: range, shot: Shot, settings: Settings) -> Sequence[int]:
    """The numbers, with a progress bar on a terminal."""
    from rich.progress import track

    hidden = not STDERR.is_terminal or settings.verbosity < 0 or settings.log_json
    log.info("%s: following the face through %d frames", shot.base.name, len(shot.frames))
    shown: Any = track(numbers, "face", console=STDERR, disable=hidden, transient=True)
    return shown


def _say_gaps(shot: Shot, sightings: Sequence[Sighting | None]) -> None:
    if not any(sightings):
        raise InputError(f"{shot.frames[0].input_path}: no frame shows a face; give another film")
    for first, last in gaps(sightings):
        bridged = first > 0 and last + 1 < len(sightings) and last - first < LONGEST_GAP
        names = f"frame {first}" if first == last else f"frames {first} to {last}"
        result = "bridged by the frames around" if bridged else "not made; cut them off"
        log.warning("%s: %s: the face is not seen; %s", shot.base.name, names, result)


@lru_cache(maxsize=1)
def _opened(shot: Shot, options: PhotoOptions) -> tuple[ShotFrames, ShotView]:
    frames = ShotFrames(shot, options)
    models = load_models_once(options)
    sightings = [_sighting(row) for row in _rows(shot)[1:]]
    view = ShotView(models, models.sides(options.texture_side), frames.pixels, sightings)
    return frames, view


def view_of(shot: Shot, options: PhotoOptions) -> ShotView:
    """The view of a shot whose face was followed; kept for the frames that this process makes."""
    return _opened(shot, options)[1]


@contextmanager
def _named(shot: Shot, number: int) -> Iterator[None]:
    """Put the name of a frame's file before an error."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{shot.frames[number].input_path}: {error}") from None


def segmented_frame(shot: Shot, number: int, options: PhotoOptions) -> tuple[LinearImage, Face, Segmentation]:
    """A frame, its face, and its person, steadied by the frames around it."""
    frames, view = _opened(shot, options)
    with _named(shot, number):
        face, found = face_at(view.landmarks_px(number)), view.segmentation(number)
    return frames.image(number), face, found


def seen_frame(
    shot: Shot, number: int, options: PhotoOptions, portrait: bool = True
) -> tuple[LinearImage, FittedFace]:
    """A frame, and its head with what is steadied by the frames around it; see `ShotView.steady`."""
    frames, view = _opened(shot, options)
    with _named(shot, number):
        head, steady = view.head(number), view.steady(number, portrait)
    landmarks_px = head.fit.crop.to_photo(head.landmarks_px)
    return frames.image(number), FittedFace("", face_at(landmarks_px), head, steady)
