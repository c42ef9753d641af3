"""Frames of a shot: its face followed once, in a file, and the view of it that each frame needs."""

import json
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from facerf_cli.batch.settings import Settings
from facerf_cli.errors import InputError
from facerf_cli.face.landmarks import read_landmarks, to_display
from facerf_cli.files.film import Film
from facerf_cli.files.read import LinearImage
from facerf_cli.image.colour import SRGB, named_space, to_linear_rec709, unit_floats
from facerf_cli.portrait.find import Face, face_at
from facerf_cli.portrait.segment import Segmentation
from facerf_cli.relighting import White
from facerf_cli.relighting.models import described_file
from facerf_cli.relighting.sequence import LONGEST_GAP, CutFinder, Follower, ShotView, Sighting, gaps, takes
from facerf_cli.run.logs import LOGGER_NAME, STDERR, json_line
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.photos import (
    FittedFace,
    companion,
    load_models_once,
    person_matte,
    read_photo,
)
from facerf_cli.work.shots import Shot

_DECODED = 12  # frames of a film that are kept as they were decoded
_AHEAD = 8  # frames that are kept while cuts are looked for
log = logging.getLogger(LOGGER_NAME)


class ShotFrames:
    """Frames of a shot as scene-linear images, by number."""

    def __init__(self, shot: Shot, options: PhotoOptions) -> None:
        self._shot, self._options = shot, options
        space = options.colourspace
        self._film = Film(shot.film) if shot.film else None
        stated = self._film.space if self._film else SRGB
        self._space = stated if space is None else named_space(space, options.ocio_config)
        self._decoded = lru_cache(_DECODED)(self._film.read) if self._film else None

    def image(self, number: int) -> LinearImage:
        """Frame `number`; alpha that is 0 in every frame is none."""
        image = self.read(number)
        kept = image.alpha is None or image.alpha.any() or self._has_alpha
        return image if kept else replace(image, alpha=None)

    @cached_property
    def _has_alpha(self) -> bool:
        alphas = (self.read(number).alpha for number in range(len(self._shot.frames)))
        found = any(alpha is not None and alpha.any() for alpha in alphas)
        if not found:
            log.warning("%s: its alpha is 0 in every frame; read without alpha", self._shot.base.name)
        return found

    def read(self, number: int) -> LinearImage:
        """Frame `number` with the alpha that it has itself."""
        if self._decoded is None:
            return read_photo(self._shot.frames[number], self._options, in_shot=True)
        values = self._decoded(number)
        pixels = np.ascontiguousarray(to_linear_rec709(values[..., :3], self._space), np.float32)
        alpha = unit_floats(values[..., 3]) if values.shape[2] == 4 else None
        return LinearImage(pixels, alpha, self._space.name)

    def pixels(self, number: int) -> np.ndarray:
        """Frame `number` [H, W, 3]; raises InputError where its size is not that of the first."""
        pixels = self.read(number).pixels
        if pixels.shape != self._shape:
            raise InputError("is not of the size of the first frame; give frames of one size")
        return pixels

    @cached_property
    def _shape(self) -> tuple[int, ...]:
        return self.read(0).pixels.shape


def follow_all(shots: Sequence[Shot], options: PhotoOptions) -> None:
    """Follow the face through each shot; what was followed before is kept."""
    for shot in shots:
        _follow(shot, options)


def _follow(shot: Shot, options: PhotoOptions) -> None:
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
    if len(rows) <= len(shot.frames):
        with shot.track.open("a", encoding="utf-8") as stream:
            for row in _followed(shot, rows[1:], options):
                rows.append(row)
                stream.write(json_line(row) + "\n")
                stream.flush()
    _log_cuts_and_gaps(shot, rows[1:])


def _followed(shot: Shot, rows: Sequence[dict[str, Any]], options: PhotoOptions) -> Iterator[dict[str, Any]]:
    """Rows of the frames that follow those of some rows; after a cut the face is chosen as in a new film."""
    take = rows[[0, *_cuts(rows)][-1] :]
    last = next((seen.landmarks_px for seen in map(_sighting, reversed(take)) if seen), None)
    networks = load_models_once(options).networks.people
    follower = Follower(networks, options.face, last)
    frames = ShotFrames(shot, options)
    show = lru_cache(_AHEAD)(lambda number: to_display(frames.read(number).pixels))
    finder = CutFinder(len(shot.frames), show)
    for number in _with_progress(range(len(rows), len(shot.frames)), shot, options.settings):
        cut = shot.cuts and finder.is_cut(number)
        if cut:
            follower = Follower(networks, options.face)
        yield _row(number, _sight(shot, number, show, follower, options), cut)


def _sight(
    shot: Shot, number: int, show: Callable[[int], np.ndarray], follower: Follower, options: PhotoOptions
) -> Sighting | None:
    if options.landmarks is None:
        return follower.see(show(number))
    path = companion(shot.frames[number], options.landmarks, "--landmarks")
    return Sighting(read_landmarks(path), 0.0)


def _made_from(shot: Shot, options: PhotoOptions) -> dict[str, Any]:
    """The first row of a track: what it was made from."""
    states = [os.stat(path) for path in dict.fromkeys(item.input_path for item in shot.frames)]
    return {
        "frames": len(shot.frames),
        "files": [[state.st_size, state.st_mtime_ns] for state in states],
        "cuts": shot.cuts,
        "face": options.face,
        "landmarks": options.landmarks,
        "colourspace": options.colourspace,
        "layer": options.layer,
        "parsing": described_file(load_models_once(options).networks.files["parsing"])["sha256"],
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


def _row(number: int, seen: Sighting | None, cut: bool) -> dict[str, Any]:
    row: dict[str, Any] = {"frame": number, **({"cut": True} if cut else {})}
    if seen is None:
        return row | {"landmarks": None}
    return row | {"landmarks": seen.landmarks_px.round(3), "expected_error": round(seen.error, 4)}


def _cuts(rows: Sequence[dict[str, Any]]) -> list[int]:
    """First frames of takes, but for that of the first take."""
    return [number for number, row in enumerate(rows) if row.get("cut")]


def _sighting(row: dict[str, Any]) -> Sighting | None:
    given = row.get("landmarks")
    return None if given is None else Sighting(np.array(given, np.float64), float(row["expected_error"]))


def _with_progress(numbers: range, shot: Shot, settings: Settings) -> Sequence[int]:
    """The numbers, with a progress bar on a terminal."""
    from rich.progress import track

    hidden = not STDERR.is_terminal or settings.verbosity < 0 or settings.log_json
    log.info("%s: following the face through %d frames", shot.base.name, len(shot.frames))
    shown: Any = track(numbers, "face", console=STDERR, disable=hidden, transient=True)
    return shown


def _log_cuts_and_gaps(shot: Shot, rows: Sequence[dict[str, Any]]) -> None:
    """Say where a film cuts, and where its face is not seen."""
    sightings, cuts = list(map(_sighting, rows)), _cuts(rows)
    if not any(sightings):
        raise InputError(f"{shot.frames[0].input_path}: no frame shows a face; give another film")
    if cuts:
        at = f"frame{'s' * (len(cuts) > 1)} {', '.join(map(str, cuts))}"
        log.warning(
            "%s: cuts at %s: each part is a shot for itself (--no-cuts: one shot)", shot.base.name, at
        )
    for take in takes(len(sightings), cuts):
        inside = sightings[take.start : take.stop]
        for first, last in gaps(inside):
            bridged = first > 0 and last + 1 < len(inside) and last - first < LONGEST_GAP
            result = "bridged by the frames around" if bridged else "not made; cut them off"
            names = _named_frames(take.start + first, take.start + last)
            log.warning("%s: %s: the face is not seen; %s", shot.base.name, names, result)


def _named_frames(first: int, last: int) -> str:
    return f"frame {first}" if first == last else f"frames {first} to {last}"


@lru_cache(maxsize=1)
def _opened(shot: Shot, options: PhotoOptions) -> ShotFrames:
    return ShotFrames(shot, options)


@lru_cache(maxsize=1)
def _takes(shot: Shot) -> tuple[list[Sighting | None], list[range]]:
    """Sightings of a shot that was followed, and the frames of its takes."""
    rows = _rows(shot)[1:]
    return list(map(_sighting, rows)), takes(len(rows), _cuts(rows))


def takes_with_face(shot: Shot) -> list[range]:
    """The frames of each take of a shot that was followed, of those that show the face."""
    sightings, found = _takes(shot)
    return [take for take in found if any(sightings[take.start : take.stop])]


@lru_cache(maxsize=1)
def _view(shot: Shot, take: range, options: PhotoOptions) -> ShotView:
    models, sightings = load_models_once(options), _takes(shot)[0]
    inside = [seen if number in take else None for number, seen in enumerate(sightings)]
    read = _opened(shot, options).pixels

    def matte(number: int) -> np.ndarray:
        found = person_matte(shot.frames[number], read(number), options, in_shot=True)
        assert found is not None
        return found

    def given(number: int) -> np.ndarray:
        found = matte(number)
        if not found.any() and not any(matte(other).any() for other in take):
            raise InputError("its mattes are black in every frame; make them white where the person is")
        return found

    sides = models.sides(options.texture_side)
    return ShotView(models, sides, read, inside, given if options.has_given_person else None)


def view_of(shot: Shot, number: int, options: PhotoOptions) -> ShotView:
    """The view of the take of a frame; kept for the frames that this process makes.

    To a view no other take shows a face, so that nothing crosses a cut.
    """
    take = next(take for take in _takes(shot)[1] if number in take)
    return _view(shot, take, options)


@contextmanager
def _named(shot: Shot, number: int) -> Iterator[None]:
    """Put the name of a frame's file before an error that lacks it."""
    try:
        yield
    except InputError as error:
        before = f"{shot.frames[number].input_path}: "
        raise InputError(before + str(error).removeprefix(before)) from None


def segmented_frame(shot: Shot, number: int, options: PhotoOptions) -> tuple[LinearImage, Face, Segmentation]:
    """A frame, its face, and its person, steadied by the frames around it."""
    view = view_of(shot, number, options)
    with _named(shot, number):
        face, found = face_at(view.landmarks_px(number)), view.segmentation(number)
    return _opened(shot, options).image(number), face, found


def frame_with_face(
    shot: Shot, number: int, options: PhotoOptions, portrait: bool = True, white: White | None = None
) -> tuple[LinearImage, FittedFace]:
    """A frame, and its head with what is steadied by the frames around it; see `ShotView.steady`."""
    view = view_of(shot, number, options)
    with _named(shot, number):
        head, steady = view.head(number), view.steady(number, portrait, white)
    landmarks_px = head.fit.crop.to_photo(head.landmarks_px)
    found, matte = face_at(landmarks_px), steady.segmentation.matte
    face = FittedFace("", f"frame {number}", found, head=head, steady=steady, matte=matte)
    return _opened(shot, options).image(number), face
