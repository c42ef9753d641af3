"""Films written from numbered images by PyAV: H.264 in .mp4, ProRes in .mov, with another film's sound."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.decoding import decode
from facerf_cli.files.film import Film, exact, require_av
from facerf_cli.files.images import PHOTO_LIMIT_PX
from facerf_cli.image.colour import unit_floats

_BT709, _LIMITED = 1, 1  # matrix, primaries and transfer; range (ITU-T H.273)
_CLOCK = 90_000  # ticks a second, in which the times of frames are written


@dataclass(frozen=True)
class _Form:
    """A way to write a film; `copied` sound is kept as it is, other sound is encoded again, as AAC."""

    codec: str
    pixels: str
    options: dict[str, str]
    source: str  # of numpy's frames
    copied: tuple[str, ...]


_FORMS = {
    ".mp4": _Form(
        "libx264",
        "yuv420p",
        {"crf": "16", "preset": "medium"},
        "rgb24",
        ("aac", "mp3", "ac3", "eac3", "alac", "opus"),
    ),
    ".mov": _Form(
        "prores_ks",
        "yuv422p10le",
        {"profile": "3", "vendor": "apl0"},
        "rgb48le",
        ("aac", "mp3", "ac3", "alac", "pcm_s16le", "pcm_s24le"),
    ),
}
WRITTEN = frozenset(_FORMS)


@dataclass(frozen=True)
class Timing:
    """Times of a film's frames in seconds, and the film whose sound it has."""

    times_s: tuple[Fraction, ...]
    rate: Fraction
    sound: Path | None = None

    @staticmethod
    def steady(count: int, rate: Fraction) -> "Timing":
        """Frames at a constant rate, without sound."""
        return Timing(tuple(number / rate for number in range(count)), rate)


def write_film(path: Path, images: Sequence[Path], timing: Timing, comment: str) -> None:
    """Write PNG images as a film; it has its name when it is whole. `comment` goes into its metadata."""
    av, form = require_av(path), _FORMS[path.suffix.lower()]
    with atomic_path(path) as temporary:
        options = {"movflags": "+faststart"}
        with av.open(str(temporary), "w", options=options) as container:
            container.metadata["comment"] = comment
            stream = container.add_stream(form.codec, rate=timing.rate)
            stream.options = dict(form.options)
            stream.pix_fmt = form.pixels
            stream.time_base = stream.codec_context.time_base = Fraction(1, _CLOCK)
            coded = stream.codec_context
            coded.colorspace = coded.color_primaries = coded.color_trc = _BT709
            coded.color_range = _LIMITED
            height, width = (side + side % 2 for side in _pixels(images[0], form).shape[:2])
            stream.width, stream.height = width, height
            sound = _Sound(av, container, timing.sound, form.copied) if timing.sound else None
            for ticks, lasts, image in _timed(images, timing):
                frame = av.VideoFrame.from_ndarray(_even(_pixels(image, form)), format=form.source)
                frame = frame.reformat(format=form.pixels, dst_colorspace=_BT709, interpolation=exact(av))
                frame.pts, frame.time_base, frame.duration = ticks, Fraction(1, _CLOCK), lasts
                container.mux(stream.encode(frame))
                if sound:
                    sound.write_until(Fraction(ticks, _CLOCK))
            container.mux(stream.encode(None))
            if sound:
                sound.write_until(Fraction(ticks + lasts, _CLOCK))
                sound.close()


def comment_of(path: Path) -> str:
    """The comment in a film's metadata; empty for what is no film."""
    av = require_av(path)
    try:
        with av.open(str(path)) as container:
            return str(container.metadata.get("comment", ""))
    except (av.error.FFmpegError, OSError, ValueError):
        return ""


def film_timing(path: Path) -> Timing:
    """The times of a film's frames, with its sound."""
    with Film(path) as film:
        facts, has_sound = film.facts(), film.has_sound
    return Timing(facts.times_s, facts.rate, path if has_sound else None)


def _timed(images: Sequence[Path], timing: Timing) -> Iterator[tuple[int, int, Path]]:
    """Start and length of each frame, in ticks."""
    starts = [round(time_s * _CLOCK) for time_s in timing.times_s]
    ends = [*starts[1:], starts[-1] + round(_CLOCK / timing.rate)]
    assert all(first < last for first, last in pairwise([*starts, ends[-1]]))
    for start, end, image in zip(starts, ends, images, strict=True):
        yield start, end - start, image


def _pixels(path: Path, form: _Form) -> np.ndarray:
    """An image's first three channels [H, W, 3], uint8 or uint16."""
    found = decode(path, PHOTO_LIMIT_PX)
    if len(found.colour) < 3:
        raise InputError(f"{path}: is not an image of a film; remove it and make it again")
    kind = np.uint16 if form.source == "rgb48le" else np.uint8
    values = unit_floats(found.values[..., found.colour])
    return np.round(values * np.iinfo(kind).max).astype(kind)


def _even(pixels: np.ndarray) -> np.ndarray:
    """The image with its last row or column twice where their number is odd, since codecs halve colours."""
    height, width = pixels.shape[:2]
    return np.ascontiguousarray(np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), "edge"))


class _Sound:
    """Sound of a film, copied into another one; encoded again where that cannot hold it."""

    def __init__(self, av: Any, container: Any, path: Path, copied: Sequence[str]) -> None:
        self._av, self._container = av, container
        self._source = av.open(str(path))
        track = self._source.streams.audio[0]
        self._copies = track.codec_context.name in copied
        if self._copies:
            self._stream = container.add_stream_from_template(track)
        else:
            self._stream = container.add_stream("aac", rate=track.codec_context.sample_rate)
            self._stream.layout = track.codec_context.layout.name
        self._packets = self._source.demux(track)
        self._until_s = Fraction(-1)

    def write_until(self, time_s: Fraction) -> None:
        """Write what begins before a time; frames and sound alternate in the file."""
        while self._until_s <= time_s and (packet := next(self._packets, None)) is not None:
            if packet.dts is not None:
                self._until_s = packet.dts * Fraction(packet.time_base)
            if not self._copies:
                for frame in packet.decode():
                    self._container.mux(self._stream.encode(frame))
            elif packet.dts is not None:
                packet.stream = self._stream
                self._container.mux(packet)

    def close(self) -> None:
        """End the stream and close the source."""
        if not self._copies:
            self._container.mux(self._stream.encode(None))
        self._source.close()
