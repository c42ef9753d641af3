"""Films by PyAV, an extra (`facerf[video]`): frames read by number and with their times.

The wheel of PyAV holds FFmpeg with x264 and x265, which are under the GPL; facerf does not bundle it.
"""

import io
import logging
import struct
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
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
_HD_LINES = 720  # films without a stated matrix have BT.709 from here on
_MICROSECONDS = 1_000_000  # a second, in which FFmpeg counts for whole files
_WITH_ALPHA = {"vp8": "libvpx", "vp9": "libvpx-vp9"}  # FFmpeg's own decoders leave alpha out
_EARLIER = 50  # frames by which a seek that came to a later frame begins before

_Stamped = Iterator[tuple[int, Any]]  # frames, each after its time stamp


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


class Film:
    """An open film; frames are read fastest in order."""

    def __init__(self, path: Path) -> None:
        self._path, self._av = path, require_av(path)
        self._open()
        self._is_counted = self._container.format.name == "avi"  # it has no times of presentation
        self._clean = _clean_aperture(path) if "mp4" in self._container.format.name else ()
        self._pts = self._presented()
        self._coming: _Stamped = iter(())
        self._next = -1  # number of the frame that is decoded next, without a seek

    def _open(self) -> None:
        try:
            self._container = self._av.open(str(self._path))
        except (self._av.error.FFmpegError, OSError, ValueError) as error:
            raise InputError(f"{self._path}: not a readable film; convert it ({reason(error)})") from None
        self._stream = self._container.streams.best("video")
        if self._stream is None or self._stream.codec_context is None:
            raise InputError(
                f"{self._path}: holds no pictures that FFmpeg decodes; give a film, or convert it"
            )
        self._coder = self._stream.codec_context
        name = _WITH_ALPHA.get(self._coder.name)
        if name in self._av.codecs_available and self._stream.metadata.get("alpha_mode") == "1":
            self._coder = self._av.CodecContext.create(name, "r")
        self._coder.thread_type = "AUTO"

    def close(self) -> None:
        self._container.close()

    def _presented(self) -> list[int]:
        """Time stamps of all frames in the order of presentation; packets are read, and hardly decoded."""
        try:
            packets = self._container.demux(self._stream)
            whole = (packet for packet in packets if packet.size and not packet.is_discard)
            if self._coder.name == "h264" and self._coder.field_order > 1 and not self._is_counted:
                whole = self._container.decode(self._stream)  # since packets may be single fields
            pts = {one.dts if self._is_counted else one.pts for one in whole} - {None}
        except self._av.error.FFmpegError as error:
            raise InputError(f"{self._path}: damaged or cut short; copy it again ({reason(error)})") from None
        if not 0 < len(pts) <= _MOST_FRAMES:
            raise InputError(f"{self._path}: has {len(pts)} frames; give a film of 1 to {_MOST_FRAMES}")
        return sorted(pts)

    def timing(self) -> Timing:
        """Return the frame times in order, the mean rate, the timecode, and the film if it has sound."""
        base, begins_s = Fraction(self._stream.time_base), start_s(self._container)
        times_s = tuple(pts * base - begins_s for pts in self._pts)
        rate = Fraction(self._stream.average_rate or 0)
        if rate <= 0:
            length_s = times_s[-1] - times_s[0]
            rate = (len(times_s) - 1) / length_s if length_s else Fraction(24)
        parts = (self._container, *self._container.streams, self._stream)
        said = {key.lower(): value for part in parts for key, value in part.metadata.items()}
        sound = self._path if any(self.sounds) else None
        return Timing(times_s, rate, sound, said.get("timecode", ""))

    @property
    def sounds(self) -> list[Any]:
        """The decoders of the sound tracks; None of an unknown codec."""
        return [track.codec_context for track in self._container.streams.audio]

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
        """Frame `number` [H, W, 3 or, with alpha, 4], square pixels, upright, in `space`.

        It is uint8, or uint16 of deeper films; its colour is not multiplied by alpha.
        """
        try:
            return self._read(number)
        except self._av.error.FFmpegError as error:
            raise InputError(f"{self._path}: frame {number} is damaged ({reason(error)})") from None

    def _read(self, number: int) -> np.ndarray:
        if number != self._next:
            self._coming = self._from(number)
        for pts, frame in self._coming:
            if pts >= self._pts[number]:
                self._next = number + 1
                return self._pixels(frame)
        raise InputError(f"{self._path}: ends before frame {number}; copy it again")

    def _from(self, number: int) -> _Stamped:
        """Decode from the frame before `number`, which makes that progressive, or from an earlier one."""
        start = max(number - 1, 0)
        while not self._is_counted:
            self._container.seek(self._pts[start], stream=self._stream, backward=True)
            coming = self._decoded()
            first = next(coming, None)
            if first is not None and first[0] <= self._pts[start]:
                return chain([first], coming)
            if start == 0:
                break
            start = max(start - _EARLIER, 0)
        self._container.close()
        self._open()
        return self._decoded()

    def _decoded(self) -> _Stamped:
        self._coder.flush_buffers()
        packets = self._container.demux(self._stream)
        frames = (frame for packet in packets for frame in self._coder.decode(packet))
        if self._is_counted:
            return _progressive(self._av, zip(self._pts, frames, strict=False))
        return _progressive(self._av, ((frame.pts, frame) for frame in frames if frame.pts is not None))

    def _pixels(self, frame: Any) -> np.ndarray:
        width, height = self._square_size(frame)
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
        if alpha and deep and not is_rgb:  # FFmpeg fills up its bits with zeros
            white = 0x10000 - (0x10000 >> parts[-1].bits)
            values[..., 3] = np.round(values[..., 3] * (0xFFFF / white)).clip(0, 0xFFFF)
        return _upright(self._cropped(values, frame), frame.side_data.get("DISPLAYMATRIX"))

    def _cropped(self, values: np.ndarray, frame: Any) -> np.ndarray:
        """The clean aperture of a frame's values [H, W, C]; all of them where the frame does not hold it."""
        for axis, (length, offset) in enumerate(self._clean):
            whole = frame.width if axis else frame.height
            first = (whole - length) / 2 + offset
            if first >= 0 < length <= whole - first:
                step = values.shape[axis] / whole
                start, stop = round(first * step), round((first + length) * step)
                values = values[start:stop] if axis == 0 else values[:, start:stop]
        return values

    def _square_size(self, frame: Any) -> tuple[int, int]:
        """Width and height of a frame whose samples are made square; none is lost."""
        aspect = Fraction(self._stream.sample_aspect_ratio or 1)
        if aspect <= 0:
            return frame.width, frame.height
        return round(frame.width * max(aspect, 1)), round(frame.height / min(aspect, 1))


def _upright(values: np.ndarray, matrix: Any) -> np.ndarray:
    """Turn and mirror a frame [H, W, C] by a film's display matrix, to quarters.

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


def start_s(container: Any) -> Fraction:
    """The time at which pictures or sound begin, which is late in streams that were cut out of others."""
    return max(Fraction(0), Fraction(container.start_time or 0, _MICROSECONDS))


def _progressive(av: Any, frames: _Stamped) -> _Stamped:
    """Frames, of which interlaced ones are made progressive."""
    before, now = None, next(frames, None)
    while now is not None:
        if not now[1].interlaced_frame:
            yield now
            before, now = now, next(frames, None)
        else:
            after = next(frames, None)
            around = [one[1] for one in (before, now, after) if one is not None]
            yield now[0], _deinterlaced(av, around, around.index(now[1]))
            before, now = now, after


def _deinterlaced(av: Any, frames: list[Any], number: int) -> Any:
    """One of some frames, at the time of its first field, by FFmpeg's bwdif, which looks at those around."""
    frame, graph = frames[number], av.filter.Graph()
    size = {"width": frame.width, "height": frame.height}
    source = graph.add_buffer(format=frame.format, time_base=frame.time_base, **size)
    bwdif = graph.add("bwdif", "mode=send_frame:deint=interlaced")
    graph.link_nodes(source, bwdif, graph.add("buffersink")).configure()
    for one in (*frames, None):
        graph.vpush(one)
    return [graph.vpull() for _ in range(number + 1)][number]


def _clean_aperture(path: Path) -> tuple[tuple[Fraction, Fraction], ...]:
    """Height and width of the clean aperture of an MP4 or QuickTime file, each with its middle's offset.

    Nothing where the file has none (ISO 14496-12, `clap`).
    """
    with path.open("rb") as stream:
        while len(head := stream.read(16)) == 16:
            short, kind, long = struct.unpack(">I4sQ", head)
            size = long if short == 1 else short
            if kind == b"moov":
                boxes = stream.read(min(size, path.stat().st_size))
                at = boxes.find(b"\0\0\0\x28clap")
                values = struct.unpack(">8i", boxes[at + 8 : at + 40].ljust(32, b"\0"))
                if at < 0 or min(values[1::2]) <= 0:
                    break
                width, height, right, down = map(Fraction, values[::2], values[1::2])
                return (height, down), (width, right)
            if size < 8:
                break
            stream.seek(size - 16, io.SEEK_CUR)
    return ()


def film_timing(path: Path) -> Timing:
    """Read the timing of a film; its first frame is decoded, so that an HDR film is refused here."""
    with closing(Film(path)) as film:
        film.read(0)
        return film.timing()


def reason(error: Exception) -> str:
    """The cause of an error of FFmpeg."""
    return str(getattr(error, "strerror", None) or error)
