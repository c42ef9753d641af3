"""Videos read by PyAV, an extra (`facerf[video]`): frames by number, decoded in order, and their times.

The wheel of PyAV holds FFmpeg with x264 and x265, which are under the GPL; facerf does not bundle it.
"""

import logging
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import groupby, repeat
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.spaces import HDR_CURVES, space_of_codes
from facerf_cli.image.colour import SRGB, ColourSpace
from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
_LARGEST_PX = 8192 * 4320
_MOST_FRAMES = 1_000_000
_BT601, BT709, _UNKNOWN = 5, 1, 2
_HD_LINES = 720  # videos without a stated matrix have BT.709 from here on
_MICROSECONDS = 1_000_000  # a second, in which FFmpeg counts for whole files
_READERS = (
    3  # one goes from key frame to key frame, one to the middle of each take, and one through all frames
)
_KEPT, _BEFORE = 12, 5  # decoded frames that are kept; of those that a reader passes over, the last ones


@dataclass(frozen=True)
class Timing:
    """Times of a film's frames in seconds, the film whose sound it has, and its first frame's timecode.

    The timecode is 01:02:03:04, or 01:02:03;04 for drop-frame; empty for none.
    """

    times_s: tuple[Fraction, ...]
    rate: Fraction
    sound: Path | None = None
    timecode: str = ""

    @staticmethod
    def steady(count: int, rate: Fraction, timecode: str = "") -> "Timing":
        """Return the timing of frames at a constant rate, without sound."""
        return Timing(tuple(number / rate for number in range(count)), rate, timecode=timecode)


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


@dataclass(eq=False)
class _Reader:
    """A pass through a video: the frames that it has yet to decode, and the number of the next one."""

    frames: Iterator[Any]
    next: int = 0


class Film:
    """The frames of a video, by number; decoded in order, without seeking.

    A frame is decoded by the nearest of up to three readers before it, each of which only goes forward. So a
    pass over the frames of each take after its key frames decodes the video at most three times. Few frames
    are held at a time. Raises InputError for a file that cannot be decoded.

    Attributes:
        timing: Times of the frames, their mean rate, the timecode, and the file itself if it has sound.
        lost_sounds: Number of sound tracks of unknown codecs.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._av = path, require_av(path)
        self._matrix: bytes | None = None
        self._kept: dict[int, np.ndarray] = {}
        self._readers: list[_Reader] = []  # the last used one last
        with self._opened() as (container, stream):
            self._is_counted = container.format.name == "avi"  # it has no times of presentation
            self._aspect = Fraction(stream.sample_aspect_ratio or 1)
            coded = stream.codec_context
            self._codes = int(coded.color_primaries), int(coded.color_trc)
            sounds = [track.codec_context for track in container.streams.audio]
            self.lost_sounds = sounds.count(None)
            self._pts = self._presented(container, stream)
            self.timing = self._timed(container, stream, any(sounds))

    @contextmanager
    def _opened(self) -> Iterator[tuple[Any, Any]]:
        """Open the file and its video stream; raise InputError for what FFmpeg cannot read in the block."""
        try:
            with self._av.open(str(self._path), metadata_errors="replace") as container:
                stream = container.streams.best("video")
                if stream is None or stream.codec_context is None:
                    raise InputError(
                        f"{self._path}: holds no pictures that FFmpeg decodes; give a film, or convert it"
                    )
                stream.thread_type = "AUTO"
                yield container, stream
        except (self._av.error.FFmpegError, OSError) as error:
            raise InputError(
                f"{self._path}: not a readable film, or a damaged one; convert it, or copy it again "
                f"({reason(error)})"
            ) from None

    def _presented(self, container: Any, stream: Any) -> list[int]:
        """Time stamps of all frames in the order of presentation; packets are read, and hardly decoded."""
        coder = stream.codec_context
        packets = (one for one in container.demux(stream) if one.size and not one.is_discard)
        if coder.name == "h264" and coder.field_order > 1 and not self._is_counted:
            packets = container.decode(stream)  # since packets may be single fields
        pts = {one.dts if self._is_counted else one.pts for one in packets} - {None}
        if not 0 < len(pts) <= _MOST_FRAMES:
            raise InputError(f"{self._path}: has {len(pts)} frames; give a film of 1 to {_MOST_FRAMES}")
        return sorted(pts)

    def _timed(self, container: Any, stream: Any, has_sound: bool) -> Timing:
        base, begins_s = Fraction(stream.time_base), start_s(container)
        times_s = tuple(pts * base - begins_s for pts in self._pts)
        rate = Fraction(stream.average_rate or 0)
        if rate <= 0:
            length_s = times_s[-1] - times_s[0]
            rate = (len(times_s) - 1) / length_s if length_s else Fraction(24)
        parts = (container, *container.streams, stream)
        said = {key.lower(): value for part in parts for key, value in part.metadata.items()}
        return Timing(times_s, rate, self._path if has_sound else None, said.get("timecode", ""))

    @property
    def space(self) -> ColourSpace:
        """The colour space that the film's codes state; sRGB where they say nothing that is known."""
        found = space_of_codes(*self._codes)
        if found is None:
            log.warning("%s: colour codes %d and %d are not known; taken for sRGB", self._path, *self._codes)
        return found or SRGB

    def read(self, number: int) -> np.ndarray:
        """Frame `number` [H, W, 3 or, with alpha, 4], square pixels, upright, in `space`.

        It is uint8, or uint16 of deeper films; its colour is not multiplied by alpha.
        """
        if number not in self._kept:
            before = [reader for reader in self._readers if reader.next <= number]
            reader = max(before, key=lambda one: one.next) if before else _Reader(self._decoded())
            self._readers = [*(one for one in self._readers if one is not reader), reader][-_READERS:]
            while reader.next <= number:
                if (frame := next(reader.frames, None)) is None:
                    raise InputError(f"{self._path}: ends before frame {number}; copy it again")
                if number - reader.next < _BEFORE:
                    self._kept[reader.next] = self._pixels(frame)
                reader.next += 1
            for earlier in list(self._kept)[:-_KEPT]:
                del self._kept[earlier]
        return self._kept[number]

    def _decoded(self) -> Iterator[Any]:
        """Decode the frames from the first to the last, progressive, one for each time."""
        with self._opened() as (container, stream):
            frames = self._one_for_each_time(container.decode(stream))
            for _, alike in groupby(frames, lambda one: (one.width, one.height, one.format.name)):
                yield from _progressive(self._av, alike)

    def _one_for_each_time(self, frames: Iterator[Any]) -> Iterator[Any]:
        """The frame of each time stamp; a later one in place of one that was not decoded."""
        count = 0
        for frame in frames:
            if self._is_counted:
                yield frame
            elif frame.pts is not None:
                due = bisect_right(self._pts, frame.pts)
                yield from repeat(frame, due - count)
                count = max(count, due)

    def _pixels(self, frame: Any) -> np.ndarray:
        width = round(frame.width * max(self._aspect, 1))
        height = round(frame.height / min(self._aspect, 1))
        if width * height > _LARGEST_PX:
            raise InputError(f"{self._path}: {width} x {height} are too many pixels; scale it")
        if name := HDR_CURVES.get(int(frame.color_trc)):
            raise InputError(
                f"{self._path}: is an HDR film ({name}); convert it to Rec.709 (SDR), or give its frames as "
                "EXR with --sequence"
            )
        parts, is_rgb = frame.format.components, frame.format.is_rgb
        deep, alpha = max(part.bits for part in parts) > 8, parts[-1].is_alpha
        matrix = int(frame.colorspace)
        if matrix in (0, _UNKNOWN):
            matrix = BT709 if min(frame.height, frame.width) >= _HD_LINES else _BT601
        form = ("rgb24", "rgb48le", "rgba", "rgba64le")[2 * alpha + deep]
        colours = {} if is_rgb else {"src_colorspace": matrix, "interpolation": exact(self._av)}
        values = frame.to_ndarray(format=form, width=width, height=height, **colours)
        if alpha and not is_rgb:  # 10 or 12 bits, whose white is to be white
            values[..., 3] |= values[..., 3] >> parts[-1].bits
        if self._matrix is None:  # once, since side data keep their frame until garbage is collected
            matrix = frame.side_data.get("DISPLAYMATRIX")
            self._matrix = b"" if matrix is None else bytes(matrix)
        return _upright(values, self._matrix)


def _upright(values: np.ndarray, matrix: bytes) -> np.ndarray:
    """Turn and mirror a frame [H, W, C] by a film's display matrix, to quarters; it may have none.

    Its first two columns are a, b, of x, and c, d, of y: (x, y) is shown at (a x + c y, b x + d y).
    """
    if not matrix:
        return np.ascontiguousarray(values)
    a, b, _, c, d = np.frombuffer(matrix, np.int32)[:5].tolist()
    if abs(a) < abs(b):
        values, to_right, to_bottom = values.swapaxes(0, 1), c, b
    else:
        to_right, to_bottom = a, d
    return np.ascontiguousarray(values[:: -1 if to_bottom < 0 else 1, :: -1 if to_right < 0 else 1])


def _progressive(av: Any, frames: Iterator[Any]) -> Iterator[Any]:
    """Frames of one size, of which interlaced ones are made progressive by FFmpeg's bwdif.

    They then show the time of their first field. From the first interlaced frame on, all pass the filter,
    which looks at the frames around each, and leaves progressive ones as they are.
    """
    graph: Any = None
    for frame in frames:
        if graph is None and frame.interlaced_frame:
            graph = av.filter.Graph()
            size = {"width": frame.width, "height": frame.height}
            source = graph.add_buffer(format=frame.format, time_base=frame.time_base, **size)
            bwdif = graph.add("bwdif", "mode=send_frame:deint=interlaced")
            graph.link_nodes(source, bwdif, graph.add("buffersink")).configure()
        if graph is None:
            yield frame
        else:
            yield from _filtered(graph, frame)
    if graph is not None:
        yield from _filtered(graph, None)


def _filtered(graph: Any, frame: Any) -> Iterator[Any]:
    """Give a graph a frame, or None at the end; yield the frames that it has ready."""
    graph.vpush(frame)
    with suppress(BlockingIOError, EOFError):
        while True:
            yield graph.vpull()


def start_s(container: Any) -> Fraction:
    """The time at which pictures or sound begin, which is late in streams that were cut out of others."""
    return max(Fraction(0), Fraction(container.start_time or 0, _MICROSECONDS))


def film_timing(path: Path) -> Timing:
    """Read the timing of a film; its first frame is decoded, so that an HDR film is refused here."""
    film = Film(path)
    film.read(0)
    return film.timing


def reason(error: Exception) -> str:
    """The cause of an error of FFmpeg."""
    return str(getattr(error, "strerror", None) or error)
