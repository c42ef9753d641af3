"""Films: frames read by PyAV, an extra (`facerf[video]`), by number and with their times.

The wheel of PyAV holds FFmpeg with x264 and x265, which are under the GPL; facerf does not bundle it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from facerf_cli.errors import InputError, UsageError

_LARGEST_PX = 8192 * 4320
_MOST_FRAMES = 1_000_000
_BRIGHTER = {16: "PQ", 18: "HLG"}  # transfer functions of HDR, by their code points (ITU-T H.273)
_BT601, _BT709, _UNKNOWN = 5, 1, 2
_HD_LINES = 720  # films without a stated matrix have BT.709 from here on


@dataclass(frozen=True)
class FilmFacts:
    """A film's upright size, the times of its frames in seconds, in order, and the mean frame rate."""

    width: int
    height: int
    times_s: tuple[Fraction, ...]
    rate: Fraction

    def __len__(self) -> int:
        return len(self.times_s)


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

    def __enter__(self) -> "Film":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    @property
    def has_sound(self) -> bool:
        """True if the film has a sound track."""
        return bool(self._container.streams.audio)

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

    def facts(self) -> FilmFacts:
        """Size, times and rate; decodes the first frame, which knows how the film is turned."""
        height, width = self.read(0).shape[:2]
        base = Fraction(self._stream.time_base)
        times_s = tuple(pts * base for pts in self._pts)
        rate = Fraction(self._stream.average_rate or 0)
        if rate <= 0:
            length_s = times_s[-1] - times_s[0]
            rate = (len(times_s) - 1) / length_s if length_s else Fraction(24)
        return FilmFacts(width, height, times_s, rate)

    def read(self, number: int) -> np.ndarray:
        """Frame `number` [H, W, 3], upright, display-encoded R'G'B', uint8 or, of deeper films, uint16."""
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
        if frame.width * frame.height > _LARGEST_PX:
            raise InputError(f"{self._path}: {frame.width} x {frame.height} are too many pixels; scale it")
        if name := _BRIGHTER.get(int(frame.color_trc)):
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
        values = frame.to_ndarray(format=form, **colours)
        return np.ascontiguousarray(np.rot90(values, round(frame.rotation / 90) % 4))


def film_facts(path: Path) -> FilmFacts:
    """Read the facts of a film."""
    with Film(path) as film:
        return film.facts()


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)
