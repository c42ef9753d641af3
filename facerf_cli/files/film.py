"""Films by PyAV, an extra (`facerf[video]`): frames read by number and with their times, and films written.

H.264 is written in .mp4 and ProRes in .mov, from numbered images, with another film's sound.

The wheel of PyAV holds FFmpeg with x264 and x265, which are under the GPL; facerf does not bundle it.
"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.decoding import decode
from facerf_cli.files.images import PHOTO_LIMIT_PX
from facerf_cli.image.cicp import HDR_CURVES, space_of_codes
from facerf_cli.image.colour import SRGB, ColourSpace, unit_floats
from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
_LARGEST_PX = 8192 * 4320
_MOST_FRAMES = 1_000_000
_BT601, _BT709, _UNKNOWN = 5, 1, 2
_HD_LINES = 720  # films without a stated matrix have BT.709 from here on
_LIMITED = 1  # range (ITU-T H.273)
_CLOCK = 90_000  # ticks a second, in which the times of frames are written


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


def require_av(path: Path) -> Any:
    """Import PyAV; raise UsageError where it is not installed."""
    try:
        import av
    except ImportError:
        raise UsageError(
            f"{path}: films need the package av (it holds GPL codecs); pip install 'facerf[video]', or give "
            "the frames as images with --sequence"
        ) from None
    return av


def exact(av: Any) -> int:
    """The way to convert colours that rounds to the nearest; by default values come out a step too dark."""
    way = av.video.reformatter.Interpolation
    return int(way.BICUBIC | way.ACCURATE_RND | way.FULL_CHR_H_INT | way.FULL_CHR_H_INP)


class Film:
    """An open film; frames are read fastest in order."""

    def __init__(self, path: Path) -> None:
        self._path, self._av = path, require_av(path)
        try:
            self._container = self._av.open(str(path))
        except (self._av.error.FFmpegError, OSError, ValueError) as error:
            raise InputError(f"{path}: not a readable film; convert it ({_reason(error)})") from None
        if not self._container.streams.video:
            raise InputError(f"{path}: holds no pictures; give a film")
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self._pts = self._presented()
        self._coming: Iterator[tuple[int, Any]] = iter(())
        self._next = -1  # number of the frame that is decoded next, without a seek

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def _presented(self) -> list[int]:
        """Time stamps of all frames in the order of presentation; packets are read, not decoded."""
        try:
            pts = {
                packet.pts
                for packet in self._container.demux(self._stream)
                if packet.pts is not None and packet.size and not packet.is_discard
            }
        except self._av.error.FFmpegError as error:
            raise InputError(
                f"{self._path}: damaged or cut short; copy it again ({_reason(error)})"
            ) from None
        if not 0 < len(pts) <= _MOST_FRAMES:
            raise InputError(f"{self._path}: has {len(pts)} frames; give a film of 1 to {_MOST_FRAMES}")
        return sorted(pts)

    def timing(self) -> Timing:
        """The times of the frames in order, the mean frame rate, and the film where it has sound."""
        base = Fraction(self._stream.time_base)
        times_s = tuple(pts * base for pts in self._pts)
        rate = Fraction(self._stream.average_rate or 0)
        if rate <= 0:
            length_s = times_s[-1] - times_s[0]
            rate = (len(times_s) - 1) / length_s if length_s else Fraction(24)
        return Timing(times_s, rate, self._path if self._container.streams.audio else None)

    @property
    def space(self) -> ColourSpace:
        """The colour space that the film's codes state; sRGB where they say nothing that is known."""
        coded = self._stream.codec_context
        codes = int(coded.color_primaries), int(coded.color_trc)
        found = space_of_codes(*codes)
        if found is None:
            log.warning("%s: colour codes %d and %d are not known; taken for sRGB", self._path, *codes)
        return found or SRGB

    def read(self, number: int) -> np.ndarray:
        """Frame `number` [H, W, 3], square pixels, upright, in `space`: uint8, or uint16 of deeper films."""
        try:
            return self._read(number)
        except self._av.error.FFmpegError as error:
            raise InputError(f"{self._path}: frame {number} is damaged ({_reason(error)})") from None

    def _read(self, number: int) -> np.ndarray:
        if number != self._next:
            self._container.seek(self._pts[number], stream=self._stream, backward=True)
            self._coming = self._decoded()
        for pts, frame in self._coming:
            if pts >= self._pts[number]:
                self._next = number + 1
                return self._pixels(frame)
        raise InputError(f"{self._path}: ends before frame {number}; copy it again")

    def _decoded(self) -> Iterator[tuple[int, Any]]:
        for frame in self._container.decode(self._stream):
            if frame.pts is not None:
                yield frame.pts, frame

    def _pixels(self, frame: Any) -> np.ndarray:
        width, height = self._square_size(frame)
        if width * height > _LARGEST_PX:
            raise InputError(f"{self._path}: {width} x {height} are too many pixels; scale it")
        if name := HDR_CURVES.get(int(frame.color_trc)):
            raise InputError(
                f"{self._path}: is an HDR film ({name}); convert it to Rec.709 (SDR), or give its frames as "
                "EXR with --sequence"
            )
        deep = max(component.bits for component in frame.format.components) > 8
        matrix = int(frame.colorspace)
        if matrix in (0, _UNKNOWN):
            matrix = _BT709 if min(frame.height, frame.width) >= _HD_LINES else _BT601
        form = "rgb48le" if deep else "rgb24"
        is_rgb = frame.format.name.startswith(("rgb", "gbr", "bgr"))
        colours = {} if is_rgb else {"src_colorspace": matrix, "interpolation": exact(self._av)}
        values = frame.to_ndarray(format=form, width=width, height=height, **colours)
        return _upright(values, frame.side_data.get("DISPLAYMATRIX"))

    def _square_size(self, frame: Any) -> tuple[int, int]:
        """Width and height of a frame whose samples are made square; none is lost."""
        aspect = Fraction(self._stream.sample_aspect_ratio or 1)
        if aspect <= 0:
            return frame.width, frame.height
        return round(frame.width * max(aspect, 1)), round(frame.height / min(aspect, 1))


def _upright(values: np.ndarray, matrix: Any) -> np.ndarray:
    """Turn and mirror a frame [H, W, 3] by a film's display matrix, to quarters.

    Its first two columns are a, b, of x, and c, d, of y: (x, y) is shown at (a x + c y, b x + d y).
    """
    if matrix is None:
        return np.ascontiguousarray(values)
    a, b, _, c, d = np.frombuffer(bytes(matrix), np.int32)[:5].tolist()
    if abs(a) < abs(b):
        values, to_right, to_bottom = values.swapaxes(0, 1), c, b
    else:
        to_right, to_bottom = a, d
    return np.ascontiguousarray(values[:: -1 if to_bottom < 0 else 1, :: -1 if to_right < 0 else 1])


def film_timing(path: Path) -> Timing:
    """Read the timing of a film; its first frame is decoded, so that an HDR film is refused here."""
    with closing(Film(path)) as film:
        film.read(0)
        return film.timing()


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)


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
