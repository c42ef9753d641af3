"""Films written by PyAV from numbered images, with another film's sound: H.264 in .mp4, ProRes in .mov."""

import io
import logging
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.film import BT709, Film, Timing, exact, reason, require_av, start_s
from facerf_cli.files.read import PHOTO_LIMIT_PX, decode
from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear, unit_floats
from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
_LIMITED = 1  # range (ITU-T H.273)
_CLOCK = 90_000  # ticks per second, at least, in which the times of frames are written


@dataclass(frozen=True)
class _Form:
    """A way to write a film; sound of the codecs `copied` stays as it is, other is encoded again, as AAC."""

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
        (
            "aac",
            "mp3",
            "ac3",
            "alac",
            "pcm_s16le",
            "pcm_s16be",
            "pcm_s24le",
            "pcm_s24be",
            "pcm_s32le",
            "pcm_f32le",
        ),
    ),
}
_ALPHA_FORM = replace(
    _FORMS[".mov"],
    pixels="yuva444p10le",
    options={"profile": "4", "vendor": "apl0"},
    source="rgba64le",
)


def check_writable(path: Path, source: Path) -> None:
    """Raise InputError where a film cannot have the sound of another; say what it loses of it."""
    av = require_av(path)
    with closing(Film(source)) as film:
        timing, (height, width, channels) = film.timing(), film.read(0).shape
        lost = film.sounds.count(None)
    if lost:
        log.warning("%s: %d of its sounds are of unknown codecs and left out", source, lost)
    if channels == 4 and path.suffix.lower() == ".mp4":
        log.warning("%s: has no alpha, and shows %s over black; give FILE.mov for alpha", path, source)
    try:
        with av.open(io.BytesIO(), "w", format=path.suffix[1:].lower()) as container:
            _begun(av, container, _FORMS[path.suffix.lower()], (height, width), timing)
            container.start_encoding()
    except (av.error.FFmpegError, ValueError) as error:
        raise InputError(
            f"{source}: its sound cannot be written to {path} ({reason(error)}); convert it to AAC"
        ) from None


def write_film(path: Path, images: Sequence[Path], timing: Timing, comment: str) -> None:
    """Write PNG images as a film; it has its name when it is whole. `comment` goes into its metadata.

    Alpha is kept in ProRes 4444 in .mov, and .mp4 shows the images over black.
    """
    av, form = require_av(path), _FORMS[path.suffix.lower()]
    if path.suffix.lower() == ".mov" and decode(images[0], PHOTO_LIMIT_PX).alpha is not None:
        form = _ALPHA_FORM
    base = Fraction(1, _clock(timing))
    with atomic_path(path) as temporary:
        options = {"movflags": "+faststart"}
        with av.open(str(temporary), "w", options=options) as container:
            container.metadata["comment"] = comment
            stream, sounds = _begun(av, container, form, _pixels(images[0], form).shape[:2], timing)
            for ticks, lasts, image in _timed(images, timing):
                frame = av.VideoFrame.from_ndarray(_even(_pixels(image, form)), format=form.source)
                frame = frame.reformat(format=form.pixels, dst_colorspace=BT709, interpolation=exact(av))
                frame.pts, frame.time_base, frame.duration = ticks, base, lasts
                container.mux(stream.encode(frame))
                if sounds:
                    sounds.write_until(ticks * base)
            container.mux(stream.encode(None))
            if sounds:
                sounds.write_until(None)
                sounds.close()


def _begun(
    av: Any, container: Any, form: _Form, size_px: tuple[int, ...], timing: Timing
) -> tuple[Any, "_Sounds | None"]:
    """The streams of a film to write: pictures, and sound where it has some."""
    stream = container.add_stream(form.codec, rate=timing.rate)
    stream.options = dict(form.options)
    stream.pix_fmt = form.pixels
    stream.time_base = stream.codec_context.time_base = Fraction(1, _clock(timing))
    coded = stream.codec_context
    coded.colorspace = coded.color_primaries = coded.color_trc = BT709
    coded.color_range = _LIMITED
    stream.height, stream.width = (side + side % 2 for side in size_px)
    if timing.timecode:  # FFmpeg leaves out drop-frame ones at other rates than multiples of 30
        drops = round(timing.rate) % 30 == 0
        stream.metadata["timecode"] = timing.timecode if drops else timing.timecode.replace(";", ":")
    return stream, _Sounds(av, container, timing.sound, form.copied) if timing.sound else None


def _clock(timing: Timing) -> int:
    """Return the ticks per second; a frame at a usual rate lasts a whole number of them."""
    per_second = timing.rate.numerator
    return per_second * -(-_CLOCK // per_second) if per_second < 2 * _CLOCK else _CLOCK


def _timed(images: Sequence[Path], timing: Timing) -> Iterator[tuple[int, int, Path]]:
    """Start and length of each frame, in ticks."""
    clock = _clock(timing)
    starts = [round(time_s * clock) for time_s in timing.times_s]
    ends = [*starts[1:], starts[-1] + round(clock / timing.rate)]
    assert all(first < last for first, last in pairwise([*starts, ends[-1]]))
    for start, end, image in zip(starts, ends, images, strict=True):
        yield start, end - start, image


def _pixels(path: Path, form: _Form) -> np.ndarray:
    """An image's colour [H, W, 3], and alpha [H, W, 4] where the form has it, uint8 or uint16."""
    found = decode(path, PHOTO_LIMIT_PX)
    if len(found.colour) < 3:
        raise InputError(f"{path}: is not an image of a film; remove it and make it again")
    kind = np.uint16 if form.source.endswith("le") else np.uint8
    values = unit_floats(found.values[..., found.colour])
    alpha = np.ones_like(values[..., :1])
    if found.alpha is not None:
        alpha = unit_floats(found.values[..., found.alpha])[..., None]
    if form is _ALPHA_FORM:
        values = np.concatenate([values, alpha], -1)
    elif found.alpha is not None:
        values = linear_to_srgb(srgb_to_linear(values) * alpha)
    return np.round(values * np.iinfo(kind).max).astype(kind)


def _even(pixels: np.ndarray) -> np.ndarray:
    """The image with its last row or column twice where their number is odd, since codecs halve colours."""
    height, width = pixels.shape[:2]
    return np.ascontiguousarray(np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), "edge"))


class _Sounds:
    """All sound of a film, copied into another one; encoded again where that cannot hold it."""

    def __init__(self, av: Any, container: Any, path: Path, copied: Sequence[str]) -> None:
        self._av, self._container, self._path = av, container, path
        self._source = av.open(str(path))
        self._start_s, self._until_s, self._damaged = start_s(self._source), Fraction(-1), 0
        tracks = [track for track in self._source.streams.audio if track.codec_context]
        self._copies = {track.index: track.codec_context.name in copied for track in tracks}
        self._streams = {track.index: self._begun(track) for track in tracks}
        self._packets = self._source.demux(tracks)

    def _begun(self, track: Any) -> Any:
        if self._copies[track.index]:
            stream = self._container.add_stream_from_template(track)
        else:
            coded, rates = track.codec_context, self._av.Codec("aac", "w").audio_rates
            rate = max((rate for rate in rates if rate <= coded.sample_rate), default=min(rates))
            stream = self._container.add_stream("aac", rate=rate)
            stream.layout = coded.layout.name.replace(" channels", "c")  # the usual layout of as many
        stream.metadata.update({"language": track.language} if track.language else {})
        return stream

    def write_until(self, time_s: Fraction | None) -> None:
        """Write what begins before a time, or all; pictures and sound alternate in the file."""
        while time_s is None or self._until_s <= time_s:
            packet = next(self._packets, None)
            if packet is None:
                return
            if packet.dts is not None:
                self._until_s = packet.dts * Fraction(packet.time_base) - self._start_s
            self._write(packet, self._streams[packet.stream.index])

    def _write(self, packet: Any, stream: Any) -> None:
        late = round(self._start_s / packet.time_base)
        if self._copies[packet.stream.index]:
            if packet.dts is not None:
                packet.dts, packet.pts, packet.stream = packet.dts - late, packet.pts - late, stream
                self._container.mux(packet)
            return
        try:
            frames = packet.decode()
        except self._av.error.FFmpegError:
            self._damaged += 1
            return
        for frame in frames:
            if frame.pts is not None:
                frame.pts -= late
            self._container.mux(stream.encode(frame))

    def close(self) -> None:
        """End the streams and close the source."""
        for index, stream in self._streams.items():
            if not self._copies[index]:
                self._container.mux(stream.encode(None))
        self._source.close()
        if self._damaged:
            log.warning("%s: %d parts of its sound are damaged and left out", self._path, self._damaged)
