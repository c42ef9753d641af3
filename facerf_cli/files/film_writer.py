"""Videos written by PyAV from numbered images, with another one's sound: H.264 in .mp4, ProRes in .mov."""

import io
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from heapq import merge
from itertools import pairwise
from math import inf
from operator import itemgetter
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
_COPIED = "aac mp3 ac3 alac"  # sound that stays as it is in both kinds of files
_Packets = tuple[Fraction | float, list[Any]]  # what is written, and the time in seconds at which it begins


@dataclass(frozen=True)
class _Form:
    """A way to write a film; sound of the codecs `copied` stays as it is, other is encoded again, as AAC."""

    codec: str
    pixels: str
    options: dict[str, str]
    source: str  # of numpy's frames
    copied: str


_FORMS = {
    ".mp4": _Form("libx264", "yuv420p", {"crf": "16", "preset": "medium"}, "rgb24", f"{_COPIED} eac3 opus"),
    ".mov": _Form(
        "prores_ks",
        "yuv422p10le",
        {"profile": "3", "vendor": "apl0"},
        "rgb48le",
        f"{_COPIED} pcm_s16le pcm_s16be pcm_s24le pcm_s24be pcm_s32le pcm_f32le",
    ),
}
_ALPHA_FORM = replace(
    _FORMS[".mov"], pixels="yuva444p10le", options={"profile": "4", "vendor": "apl0"}, source="rgba64le"
)


def check_writable(path: Path, source: Path) -> None:
    """Raise InputError where a film cannot have the sound of another; say what it loses of it."""
    av, film = require_av(path), Film(source)
    height, width, channels = film.read(0).shape
    if film.lost_sounds:
        log.warning("%s: %d of its sounds are of unknown codecs and left out", source, film.lost_sounds)
    if channels == 4 and path.suffix.lower() == ".mp4":
        log.warning("%s: has no alpha, and shows %s over black; give FILE.mov for alpha", path, source)
    try:
        with av.open(io.BytesIO(), "w", format=path.suffix[1:].lower()) as container:
            _begin(av, container, _FORMS[path.suffix.lower()], (height, width), film.timing)
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
    clock = _clock(timing)
    starts = [round(time_s * clock) for time_s in timing.times_s]
    ends = [*starts[1:], starts[-1] + round(clock / timing.rate)]
    assert all(first < last for first, last in pairwise([*starts, ends[-1]]))

    def pictures(stream: Any) -> Iterator[_Packets]:
        for image, start, end in zip(images, starts, ends, strict=True):
            frame = av.VideoFrame.from_ndarray(_pixels(image, form), format=form.source)
            frame = frame.reformat(format=form.pixels, dst_colorspace=BT709, interpolation=exact(av))
            frame.pts, frame.time_base, frame.duration = start, Fraction(1, clock), end - start
            yield Fraction(start, clock), stream.encode(frame)
        yield inf, stream.encode(None)

    options = {"movflags": "+faststart"}
    with atomic_path(path) as temporary, av.open(str(temporary), "w", options=options) as container:
        container.metadata["comment"] = comment
        stream, sound = _begin(av, container, form, _pixels(images[0], form).shape[:2], timing)
        for _, packets in merge(pictures(stream), sound, key=itemgetter(0)):
            container.mux(packets)


def _begin(
    av: Any, container: Any, form: _Form, size_px: tuple[int, ...], timing: Timing
) -> tuple[Any, Iterator[_Packets]]:
    """Add the streams of a film to write: return that of its pictures, and what is written to its sound."""
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
    if timing.sound is None:
        return stream, iter(())
    source = av.open(str(timing.sound), metadata_errors="replace")
    tracks = {
        track.index: _begin_sound(av, container, track, track.codec_context.name in form.copied.split())
        for track in source.streams.audio
        if track.codec_context
    }
    return stream, _sound(av, source, tracks)


def _clock(timing: Timing) -> int:
    """Return the ticks per second; a frame at a usual rate lasts a whole number of them."""
    per_second = timing.rate.numerator
    return per_second * -(-_CLOCK // per_second) if per_second < 2 * _CLOCK else _CLOCK


def _pixels(path: Path, form: _Form) -> np.ndarray:
    """An image's colour [H, W, 3], and alpha [H, W, 4] where the form has it, uint8 or uint16.

    An odd last row or column stands twice, since codecs halve colours.
    """
    found = decode(path, PHOTO_LIMIT_PX)
    if len(found.colour) < 3:
        raise InputError(f"{path}: is not an image of a film; remove it and make it again")
    values = unit_floats(found.values[..., found.colour])
    alpha = np.ones_like(values[..., :1])
    if found.alpha is not None:
        alpha = unit_floats(found.values[..., found.alpha])[..., None]
    if form is _ALPHA_FORM:
        values = np.concatenate([values, alpha], -1)
    elif found.alpha is not None:
        values = linear_to_srgb(srgb_to_linear(values) * alpha)
    kind = np.uint16 if form.source.endswith("le") else np.uint8
    pixels = np.round(values * np.iinfo(kind).max).astype(kind)
    height, width = pixels.shape[:2]
    return np.ascontiguousarray(np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), "edge"))


def _begin_sound(av: Any, container: Any, track: Any, copied: bool) -> tuple[Any, bool]:
    """Add the stream of a sound track; return it, and whether packets are copied into it."""
    if copied:
        stream = container.add_stream_from_template(track)
    else:
        coded, rates = track.codec_context, av.Codec("aac", "w").audio_rates
        rate = max((rate for rate in rates if rate <= coded.sample_rate), default=min(rates))
        stream = container.add_stream("aac", rate=rate)
        stream.layout = coded.layout.name.replace(" channels", "c")  # the usual layout of as many
    stream.metadata.update({"language": track.language} if track.language else {})
    return stream, copied


def _sound(av: Any, source: Any, tracks: dict[int, tuple[Any, bool]]) -> Iterator[_Packets]:
    """All sound of an open film, by the streams into which its tracks are copied or encoded."""
    begins_s, time_s, damaged = start_s(source), Fraction(0), 0
    with source:
        for packet in source.demux([source.streams[index] for index in tracks]):
            stream, copied = tracks[packet.stream.index]
            late = round(begins_s / packet.time_base)
            if packet.dts is not None:
                time_s = packet.dts * Fraction(packet.time_base) - begins_s
            if not copied:
                try:
                    frames = packet.decode()
                except av.error.FFmpegError:
                    damaged += 1
                    continue
                for frame in frames:
                    if frame.pts is not None:
                        frame.pts -= late
                    yield time_s, stream.encode(frame)
            elif packet.dts is not None:
                packet.dts, packet.pts, packet.stream = packet.dts - late, packet.pts - late, stream
                yield time_s, [packet]
        for stream, copied in tracks.values():
            if not copied:
                yield inf, stream.encode(None)
        if damaged:
            log.warning("%s: %d parts of its sound are damaged and left out", source.name, damaged)
