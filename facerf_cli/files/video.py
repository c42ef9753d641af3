"""Videos read by PyAV, an extra (`facerf[video]`): frames in order or by number, and their times.

PyAV's wheel contains FFmpeg with x264 and x265 under the GPL; facerf does not bundle it.
"""

import logging
import shutil
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import chain, groupby, repeat
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import hidden_folder
from facerf_cli.files.spaces import HDR_CURVES, space_of_codes
from facerf_cli.image.colour import SRGB, ColourSpace
from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
_LARGEST_PX = 8192 * 4320
_MOST_FRAMES = 1_000_000
_BT601, BT709, _UNKNOWN = 5, 1, 2
_HD_LINES = 720  # from this height, videos without a stated matrix are assumed to be BT.709
_MICROSECONDS = 1_000_000  # per second, FFmpeg's unit for whole files
_READERS = 2  # one for the key frames of each take, one for all frames
_MOST_STORED, _REACH = 64, 4  # decoded frames on the disk; neighbours on each side that are stored with one


@dataclass(frozen=True)
class Timing:
    """Times of a video's frames in seconds, the video with its sound, and its first frame's timecode.

    The timecode is 01:02:03:04, or 01:02:03;04 for drop-frame; empty without one.
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
    """Import PyAV; raise UsageError if it is not installed."""
    try:
        import av
    except ImportError:
        raise UsageError(
            f"{path}: videos need the package av (with GPL codecs); pip install 'facerf[video]', or pass the "
            "frames as images with --sequence"
        ) from None
    return av


def exact(av: Any) -> int:
    """Return the flags of a colour conversion that rounds to nearest; the default is a step too dark."""
    flags = av.video.reformatter.Interpolation
    return int(flags.BICUBIC | flags.ACCURATE_RND | flags.FULL_CHR_H_INT | flags.FULL_CHR_H_INP)


class Video:
    """Video file, decoded in order, without seeking; raises InputError for one that cannot be decoded.

    Attributes:
        timing: Times of the frames, their mean rate, the timecode, and the file itself if it has sound.
        has_hidden_alpha: True if FFmpeg does not decode its alpha (VP8 and VP9).
    """

    def __init__(self, path: Path) -> None:
        self._path, self._av = path, require_av(path)
        self._matrix: bytes | None = None
        with self._opened() as (container, stream):
            self._is_counted = container.format.name == "avi"  # without presentation times
            self._aspect = Fraction(stream.sample_aspect_ratio or 1)
            coded = stream.codec_context
            self._codes = int(coded.color_primaries), int(coded.color_trc)
            has_sound = any(track.codec_context for track in container.streams.audio)
            self.has_hidden_alpha = {"alpha_mode", "ALPHA_MODE"} & stream.metadata.keys() != set()
            self._pts = self._presented(container, stream)
            self.timing = self._timed(container, stream, has_sound)

    @contextmanager
    def _opened(self) -> Iterator[tuple[Any, Any]]:
        """Open the file and its video stream; FFmpeg's errors in the block become InputErrors."""
        try:
            with self._av.open(str(self._path), metadata_errors="replace") as container:
                stream = container.streams.best("video")
                if stream is None or stream.codec_context is None:
                    raise InputError(f"{self._path}: has no video that FFmpeg decodes; convert it")
                stream.thread_type = "AUTO"
                yield container, stream
        except (self._av.error.FFmpegError, OSError) as error:
            raise InputError(
                f"{self._path}: damaged, or not a readable video; convert or copy it again ({reason(error)})"
            ) from None

    def _presented(self, container: Any, stream: Any) -> list[int]:
        """Return the sorted presentation time stamps of all frames; few videos are decoded for this."""
        coder = stream.codec_context
        packets = (part for part in container.demux(stream) if part.size and not part.is_discard)
        if coder.name == "h264" and coder.field_order > 1 and not self._is_counted:
            packets = container.decode(stream)  # packets may be single fields
        pts = {part.dts if self._is_counted else part.pts for part in packets} - {None}
        if not 0 < len(pts) <= _MOST_FRAMES:
            raise InputError(f"{self._path}: has {len(pts)} frames; use a video of 1 to {_MOST_FRAMES}")
        return sorted(pts)

    def _timed(self, container: Any, stream: Any, has_sound: bool) -> Timing:
        base, begins_s = Fraction(stream.time_base), start_s(container)
        times_s = tuple(pts * base - begins_s for pts in self._pts)
        rate = Fraction(stream.average_rate or 0)
        if rate <= 0:
            length_s = times_s[-1] - times_s[0]
            rate = (len(times_s) - 1) / length_s if length_s else Fraction(24)
        parts = (container, *container.streams, stream)
        metadata = {key.lower(): value for part in parts for key, value in part.metadata.items()}
        return Timing(times_s, rate, self._path if has_sound else None, metadata.get("timecode", ""))

    @property
    def space(self) -> ColourSpace:
        """Colour space that the video's codes state; sRGB for unknown codes."""
        space = space_of_codes(*self._codes)
        if space is None:
            log.warning("%s: unknown colour codes %d and %d; assuming sRGB", self._path, *self._codes)
        return space or SRGB

    def frames(self) -> Iterator[np.ndarray]:
        """Yield each frame as `pixels`, in order."""
        return map(self.pixels, self.decoded())

    def decoded(self) -> Iterator[Any]:
        """Decode all frames as progressive, one per time stamp."""
        count = 0
        with self._opened() as (container, stream):
            frames = self._one_per_time(container.decode(stream))
            for _, alike in groupby(frames, lambda frame: (frame.width, frame.height, frame.format.name)):
                for frame in _progressive(self._av, alike):
                    yield frame
                    count += 1
        if count < len(self._pts):
            raise InputError(f"{self._path}: ends before frame {count}; copy it again")

    def _one_per_time(self, frames: Iterator[Any]) -> Iterator[Any]:
        """Yield the frame of each time stamp; a later frame replaces one that was not decoded."""
        count = 0
        for frame in frames:
            if self._is_counted:
                yield frame
            elif frame.pts is not None:
                due = bisect_right(self._pts, frame.pts)
                yield from repeat(frame, due - count)
                count = max(count, due)

    def pixels(self, frame: Any) -> np.ndarray:
        """Return a decoded frame [H, W, 3 or, with alpha, 4], upright, with square pixels, in `space`.

        It is uint8, or uint16 for deeper videos; the colour is not multiplied by alpha.
        """
        width = round(frame.width * max(self._aspect, 1))
        height = round(frame.height / min(self._aspect, 1))
        if width * height > _LARGEST_PX:
            raise InputError(f"{self._path}: {width} x {height} pixels are too many; scale it down")
        if name := HDR_CURVES.get(int(frame.color_trc)):
            advice = "convert it to SDR, or use --sequence with EXR frames"
            raise InputError(f"{self._path}: HDR ({name}) is not supported; {advice}")
        parts, is_rgb = frame.format.components, frame.format.is_rgb
        deep, alpha = max(part.bits for part in parts) > 8, parts[-1].is_alpha
        matrix = int(frame.colorspace)
        if matrix in (0, _UNKNOWN):
            matrix = BT709 if min(frame.height, frame.width) >= _HD_LINES else _BT601
        form = ("rgb24", "rgb48le", "rgba", "rgba64le")[2 * alpha + deep]
        colours = {} if is_rgb else {"src_colorspace": matrix, "interpolation": exact(self._av)}
        values = frame.to_ndarray(format=form, width=width, height=height, **colours)
        if alpha and not is_rgb:  # extends 10 or 12 bits to the white of 16
            values[..., 3] |= values[..., 3] >> parts[-1].bits
        if self._matrix is None:  # once, because side data keep their frame in memory
            matrix = frame.side_data.get("DISPLAYMATRIX")
            self._matrix = b"" if matrix is None else bytes(matrix)
        return _upright(values, self._matrix)


class StoredFrames:
    """Frames of a video by number; at most 64 are stored, without loss, in a hidden folder next to an output.

    Two readers move through the video in order. So reading the key frames of each take and then all of its
    frames decodes the video at most twice, whatever its length.
    """

    def __init__(self, video: Video, output: Path) -> None:
        self._video, self._output, self._hidden = video, output, hidden_folder(output)
        self._stored: dict[int, Path] = {}  # least recently used first, as the readers
        self._readers: dict[int, Iterator[Any]] = {}  # by the number of their next frame

    @cached_property
    def _folder(self) -> Path:
        return self._hidden.__enter__()  # removed with this object, or at the end of the process

    def read(self, number: int) -> np.ndarray:
        """Return a frame as `Video.pixels`."""
        if number not in self._stored:
            try:
                self._decode(number)
            except OSError as error:
                raise FacerfError(f"{self._output.parent}: cannot store frames: {error.strerror}") from None
        self._stored[number] = path = self._stored.pop(number)
        return np.asarray(np.load(path, mmap_mode="r"))

    def _decode(self, number: int) -> None:
        """Store a frame and its neighbours."""
        start = max((following for following in self._readers if following <= number), default=0)
        frames = self._readers.pop(start, None) or self._video.decoded()
        past = min(number + _REACH + 1, len(self._video.timing.times_s))
        for at, frame in zip(range(start, past), frames, strict=False):
            if at >= number - _REACH:
                path = self._stored.pop(at, None)
                self._stored[at] = path or self._saved(at, self._video.pixels(frame))
            if len(self._stored) > _MOST_STORED:
                self._stored.pop(next(iter(self._stored))).unlink()
        self._readers[past] = frames
        if len(self._readers) > _READERS:
            del self._readers[next(iter(self._readers))]

    def _saved(self, number: int, pixels: np.ndarray) -> Path:
        """Save a frame; for the first, raise FacerfError if the disk has no room for 64."""
        needed, folder = _MOST_STORED * pixels.nbytes, self._folder
        if not self._stored and (free := shutil.disk_usage(folder).free) < needed:
            raise FacerfError(
                f"{folder.parent}: {free / 1e9:.1f} GB are free, but decoding a video needs"
                f" {needed / 1e9:.1f} GB; remove files, or choose another -o"
            )
        np.save(path := folder / f"{number}.npy", pixels)
        return path


def _upright(values: np.ndarray, matrix: bytes) -> np.ndarray:
    """Rotate by quarter turns and mirror a frame [H, W, C] by the display matrix, which may be empty.

    Its first two columns are a, b, for x, and c, d, for y: (x, y) is shown at (a x + c y, b x + d y).
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
    """Yield frames of one size, with interlaced ones deinterlaced by FFmpeg's bwdif.

    These then show the time of their first field. From the first interlaced frame on, all frames pass the
    filter, which uses neighbouring frames and leaves progressive ones unchanged.
    """
    graph: Any = None
    for frame in chain(frames, (None,)):  # None flushes the graph
        if graph is None and frame and frame.interlaced_frame:
            graph = av.filter.Graph()
            size = {"width": frame.width, "height": frame.height}
            source = graph.add_buffer(format=frame.format, time_base=frame.time_base, **size)
            bwdif = graph.add("bwdif", "mode=send_frame:deint=interlaced")
            graph.link_nodes(source, bwdif, graph.add("buffersink")).configure()
        if graph is not None:
            graph.vpush(frame)
            with suppress(BlockingIOError, EOFError):
                while True:
                    yield graph.vpull()
        elif frame:
            yield frame


def start_s(container: Any) -> Fraction:
    """Return the time at which video or sound starts; streams cut from others start late."""
    return max(Fraction(0), Fraction(container.start_time or 0, _MICROSECONDS))


def video_timing(path: Path) -> Timing:
    """Read the timing of a video; decoding its first frame also rejects HDR. Log alpha that is not read."""
    video = Video(path)
    next(video.frames())
    if video.has_hidden_alpha:
        log.warning("%s: alpha of VP8 and VP9 is not supported; convert it to ProRes 4444 to keep it", path)
    return video.timing


def reason(error: Exception) -> str:
    """Return the cause of FFmpeg's error."""
    return str(getattr(error, "strerror", None) or error)
