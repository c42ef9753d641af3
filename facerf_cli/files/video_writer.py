"""Videos written by PyAV from images, with another video's sound: H.264 in .mp4, ProRes in .mov."""

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
from facerf_cli.files.read import PHOTO_LIMIT_PX, decode
from facerf_cli.files.video import BT709, Timing, Video, exact, reason, require_av, start_s
from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear, unit_floats
from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
_LIMITED = 1  # range (ITU-T H.273)
_CLOCK = 90_000  # fewest ticks per second for the times of frames
_COPIED = "aac mp3 ac3 alac"  # sound codecs that both kinds of files accept
_Packets = tuple[Fraction | float, list[Any]]  # start time in seconds, and packets to write


@dataclass(frozen=True)
class _Form:
    """Encoding of a video; sound in the codecs `copied` is copied, other sound is re-encoded as AAC."""

    codec: str
    pixels: str
    options: dict[str, str]
    source: str  # pixel format of the NumPy frames
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
    """Raise InputError, before frames are rendered, if a video cannot have the sound of another."""
    av, video = require_av(path), Video(source)
    try:
        with av.open(io.BytesIO(), "w", format=path.suffix[1:].lower()) as container:
            _begin(av, container, _FORMS[path.suffix.lower()], next(video.frames()).shape[:2], video.timing)
            container.start_encoding()
    except (av.error.FFmpegError, ValueError) as error:
        raise InputError(
            f"{source}: its sound cannot be written to {path} ({reason(error)}); convert it to AAC"
        ) from None


def write_video(path: Path, images: Sequence[Path], timing: Timing, comment: str) -> None:
    """Write PNG images as a video atomically; `comment` goes into its metadata.

    .mov keeps alpha in ProRes 4444, .mp4 shows the images over black.
    """
    av, form = require_av(path), _FORMS[path.suffix.lower()]
    if decode(images[0], PHOTO_LIMIT_PX).alpha is not None:
        if path.suffix.lower() == ".mov":
            form = _ALPHA_FORM
        else:
            log.warning("%s: has no alpha, and shows the images over black; use FILE.mov for alpha", path)
    clock = _clock(timing)
    starts = [round(time_s * clock) for time_s in timing.times_s]
    ends = [*starts[1:], starts[-1] + round(clock / timing.rate)]
    assert all(first < last for first, last in pairwise([*starts, ends[-1]]))

    def encoded(stream: Any) -> Iterator[_Packets]:
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
        for _, packets in merge(encoded(stream), sound, key=itemgetter(0)):
            container.mux(packets)


def _begin(
    av: Any, container: Any, form: _Form, size_px: tuple[int, ...], timing: Timing
) -> tuple[Any, Iterator[_Packets]]:
    """Add the streams of a video; return the video stream, and the packets of its sound."""
    stream = container.add_stream(form.codec, rate=timing.rate)
    stream.options = dict(form.options)
    stream.pix_fmt = form.pixels
    stream.time_base = stream.codec_context.time_base = Fraction(1, _clock(timing))
    context = stream.codec_context
    context.colorspace = context.color_primaries = context.color_trc = BT709
    context.color_range = _LIMITED
    stream.height, stream.width = (side + side % 2 for side in size_px)
    if timing.timecode:  # FFmpeg omits drop-frame at rates that are not multiples of 30
        drops = round(timing.rate) % 30 == 0
        stream.metadata["timecode"] = timing.timecode if drops else timing.timecode.replace(";", ":")
    if timing.sound is None:
        return stream, iter(())
    source = av.open(str(timing.sound), metadata_errors="replace")
    tracks: dict[int, tuple[Any, bool]] = {}
    for track in source.streams.audio:
        if coded := track.codec_context:
            is_copied = coded.name in form.copied.split()
            if is_copied:
                sound = container.add_stream_from_template(track)
            else:
                rates = av.Codec("aac", "w").audio_rates
                rate = max((rate for rate in rates if rate <= coded.sample_rate), default=min(rates))
                sound = container.add_stream("aac", rate=rate)
                sound.layout = coded.layout.name.replace(" channels", "c")  # the usual layout of that count
            sound.metadata.update({"language": track.language} if track.language else {})
            tracks[track.index] = sound, is_copied
        else:
            log.warning("%s: a sound track has an unknown codec and is omitted", timing.sound)
    return stream, _sound(av, source, tracks)


def _clock(timing: Timing) -> int:
    """Return the ticks per second, a multiple of the usual frame rates."""
    per_second = timing.rate.numerator
    return per_second * -(-_CLOCK // per_second) if per_second < 2 * _CLOCK else _CLOCK


def _pixels(path: Path, form: _Form) -> np.ndarray:
    """Return an image's colour [H, W, 3], or [H, W, 4] if the form has alpha, uint8 or uint16.

    An odd last row or column is repeated, since codecs halve colours.
    """
    image = decode(path, PHOTO_LIMIT_PX)
    if len(image.colour) < 3:
        raise InputError(f"{path}: not a frame of a video; remove it and render it again")
    values = unit_floats(image.values[..., image.colour])
    alpha = np.ones_like(values[..., :1])
    if image.alpha is not None:
        alpha = unit_floats(image.values[..., image.alpha])[..., None]
    if form is _ALPHA_FORM:
        values = np.concatenate([values, alpha], -1)
    elif image.alpha is not None:
        values = linear_to_srgb(srgb_to_linear(values) * alpha)
    kind = np.uint16 if form.source.endswith("le") else np.uint8
    pixels = np.round(values * np.iinfo(kind).max).astype(kind)
    height, width = pixels.shape[:2]
    return np.ascontiguousarray(np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), "edge"))


def _sound(av: Any, source: Any, tracks: dict[int, tuple[Any, bool]]) -> Iterator[_Packets]:
    """Yield the sound of an open video, copied or encoded into the streams of its tracks."""
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
            log.warning("%s: %d sound packets are damaged and omitted", source.name, damaged)
