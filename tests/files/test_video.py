"""Videos read by frame, and written with times, sound and metadata."""

import gc
import struct
import sys
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import is_temporary
from facerf_cli.files.read import read_image
from facerf_cli.files.video import StoredFrames, Timing, Video, video_timing
from facerf_cli.files.video_writer import write_video
from facerf_cli.files.write import write_display
from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear, to_linear_rec709
from tests.files.made import bt2020_of, write_png
from tests.kinds import Log, Patch
from tests.refusals import refused

av: Any = pytest.importorskip("av", reason="videos need av: pip install 'facerf[video]'")
PCM = "pcm_s16le"
COLOURS = np.array([[0.8, 0.3, 0.2], [0.2, 0.6, 0.3], [0.3, 0.3, 0.7], [0.5, 0.5, 0.5], [0.9, 0.8, 0.4]])


def images_of(folder: Path, size: tuple[int, int] = (36, 50), bits: int = 8) -> list[Path]:
    """Frames of one colour each, as PNG; the colours are display values."""
    from facerf_cli.image.colour import PLAIN_VIEW, srgb_to_linear

    paths = []
    for number, colour in enumerate(COLOURS):
        path = folder / f"frame.{number:04d}.png"
        pixels = np.broadcast_to(srgb_to_linear(colour), (*size, 3)).astype(np.float32)
        write_display(path, pixels, 0.0, view=PLAIN_VIEW, bits=16 if bits == 16 else 8)
        paths.append(path)
    return paths


@pytest.mark.parametrize(("suffix", "kind", "most"), [(".mp4", np.uint8, 255), (".mov", np.uint16, 65535)])
def test_colours_and_order_come_back(tmp_path: Path, suffix: str, kind: type, most: int) -> None:
    images = images_of(tmp_path, bits=16 if suffix == ".mov" else 8)
    path = tmp_path / f"video{suffix}"
    write_video(path, images, Timing.steady(5, Fraction(30000, 1001)), "Synthetic: a test")
    with av.open(str(path)) as container:
        assert container.metadata["comment"] == "Synthetic: a test"
    assert b"Synthetic: a test" in path.read_bytes()  # as a later run looks for it
    frames, timing = list(Video(path).frames()), video_timing(path)
    assert frames[0].shape == (36, 50, 3) and len(frames) == len(timing.times_s) == 5
    assert timing.sound is None and timing.rate == Fraction(30000, 1001)
    for number, frame in enumerate(frames):
        assert frame.dtype == kind
        # YCbCr of limited range has steps of 1 / 219 in 8 bits, and H.264 rounds once more
        found, steps = frame[8:-8, 8:-8].mean((0, 1)) / most, 1.6 if most == 255 else 0.6
        np.testing.assert_allclose(found, COLOURS[number], atol=steps / 255)


def test_an_odd_size_is_made_even_and_uneven_times_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "video.mp4"
    write_video(path, images_of(tmp_path, (35, 49)), Timing.steady(5, Fraction(24)), "")
    assert next(Video(path).frames()).shape == (36, 50, 3)
    times_s = tuple(map(Fraction, ("0", "1/30", "1/10", "1/5", "1/2")))
    write_video(path, images_of(tmp_path), Timing(times_s, Fraction(20)), "")
    assert [float(time_s) for time_s in video_timing(path).times_s] == pytest.approx(
        list(map(float, times_s))
    )


@pytest.mark.parametrize("rate", ["24000/1001", "60000/1001", "120000/1001", "25/2", "2997/125", "1/1000"])
def test_a_rate_is_exact(tmp_path: Path, rate: str) -> None:
    write_video(tmp_path / "video.mov", images_of(tmp_path)[:3], Timing.steady(3, Fraction(rate)), "")
    assert video_timing(tmp_path / "video.mov").rate == Fraction(rate)


@pytest.mark.parametrize(
    ("name", "codec", "rate", "timecode", "on_container"),
    [
        ("a.mov", "libx264", "24000/1001", "01:02:03:04", True),
        ("a.mp4", "libx264", "60000/1001", "01:02:03;04", False),
        ("a.mxf", "mpeg2video", "25", "10:00:00:24", True),
        ("a.mkv", "libx264", "25", "10:00:00:24", True),
        ("a.mkv", "libx264", "25", "no timecode", False),
    ],
)
@pytest.mark.parametrize("made", ["b.mov", "b.mp4"])
def test_timecode_is_kept(
    tmp_path: Path, name: str, codec: str, rate: str, timecode: str, on_container: bool, made: str
) -> None:
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(rate))
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        (container if on_container else stream).metadata["timecode"] = timecode
        for _ in range(2):
            frame = av.VideoFrame.from_ndarray(np.zeros((32, 48, 3), np.uint8))
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    write_video(tmp_path / made, images_of(tmp_path)[:2], video_timing(tmp_path / name), "")
    found = video_timing(tmp_path / made)
    assert (found.timecode, found.rate) == ("" if timecode[0] == "n" else timecode, Fraction(rate))


def test_a_video_that_cannot_be_finished_is_not_there(tmp_path: Path) -> None:
    images = images_of(tmp_path)
    images[3].write_bytes(b"no image")
    with pytest.raises(InputError, match=r"frame\.0003\.png"):
        write_video(tmp_path / "video.mp4", images, Timing.steady(5, Fraction(24)), "")
    assert not list(tmp_path.glob("*video*"))


def test_what_is_no_video_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no video at all\n" * 50)
    refused(InputError, "text.mp4: ... not a readable video", video_timing, tmp_path / "text.mp4")
    with av.open(str(tmp_path / "tone.mp4"), "w") as container:
        tone = container.add_stream("aac", rate=48000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 48000
        container.mux(tone.encode(frame))
        container.mux(tone.encode(None))
    refused(InputError, "tone.mp4: has no video", video_timing, tmp_path / "tone.mp4")


def test_a_video_in_hdr_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hdr.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=24)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        stream.codec_context.color_trc = 18  # HLG
        frame = av.VideoFrame.from_ndarray(np.zeros((32, 48, 3), np.uint8))
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    refused(InputError, "hdr.mp4: HDR (HLG)", video_timing, path)


def coded_video(
    path: Path, levels: np.ndarray, sar: str = "1", turn: tuple[int, ...] = (), **codes: int
) -> Path:
    """Two frames of levels [H, W, 3]; `turn` is a, b, c, d of the display matrix."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=24, options={"crf": "4"})
        stream.height, stream.width, stream.pix_fmt = *levels.shape[:2], "yuv444p"
        stream.codec_context.sample_aspect_ratio = Fraction(sar)
        for name, code in codes.items():
            setattr(stream.codec_context, name, code)
        for _ in range(2):
            frame = av.VideoFrame.from_ndarray(levels)
            container.mux(stream.encode(frame.reformat(format="yuv444p", dst_colorspace=5)))
        container.mux(stream.encode(None))
    if turn:
        data, (a, b, c, d) = bytearray(path.read_bytes()), (value << 16 for value in turn)
        matrix = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
        at = data.index(b"tkhd") + 44  # of the matrix in the track's header
        data[at : at + 36] = matrix
        path.write_bytes(data)
    return path


QUARTERS = np.uint8([[200, 60, 40], [40, 180, 60], [50, 70, 200], [128, 128, 128]]).reshape(2, 2, 3)
SHOWN = QUARTERS.repeat(32, 0).repeat(48, 1)


def quarters_of(path: Path) -> tuple[np.ndarray, tuple[int, ...]]:
    """The levels of the quarters, decoded by the video's space and encoded as sRGB; and the frame's shape."""
    video = Video(path)
    frame = next(video.frames())
    linear = to_linear_rec709(frame, video.space)
    height, width = frame.shape[:2]
    at = np.s_[height // 4 :: height // 2, width // 4 :: width // 2]
    return 255 * linear_to_srgb(linear[at]), frame.shape[:2]


@pytest.mark.parametrize(("sar", "size"), [("2", (64, 192)), ("1/2", (128, 96)), ("4/3", (64, 128))])
def test_samples_become_square(tmp_path: Path, sar: str, size: tuple[int, int]) -> None:
    found, shape = quarters_of(coded_video(tmp_path / "a.mp4", SHOWN, sar))
    assert shape == size
    np.testing.assert_allclose(found, QUARTERS, atol=4)


@pytest.mark.parametrize(
    ("turn", "expected"),
    [
        ((-1, 0, 0, 1), QUARTERS[:, ::-1]),
        ((1, 0, 0, -1), QUARTERS[::-1]),
        ((0, 1, -1, 0), np.rot90(QUARTERS, -1)),
        ((0, -1, 1, 0), np.rot90(QUARTERS)),
        ((0, 1, 1, 0), QUARTERS.swapaxes(0, 1)),
    ],
)
def test_display_matrices(tmp_path: Path, turn: tuple[int, ...], expected: np.ndarray) -> None:
    """Mirrored either way, turned either way, and both."""
    found, shape = quarters_of(coded_video(tmp_path / "a.mp4", SHOWN, turn=turn))
    np.testing.assert_allclose(found, expected, atol=4)
    assert shape == ((96, 64) if turn[0] == 0 else (64, 96))


def test_codes_of_a_video(tmp_path: Path) -> None:
    """BT.709 holds display values, as frames of it with cICP do; BT.2020 has its primaries and its curve."""
    plain = coded_video(tmp_path / "a.mp4", SHOWN, color_primaries=1, color_trc=1)
    np.testing.assert_allclose(quarters_of(plain)[0], QUARTERS, atol=4)
    stored = np.round(255 * bt2020_of(srgb_to_linear(SHOWN / np.float32(255)))).astype(np.uint8)
    wide = coded_video(tmp_path / "b.mp4", stored, color_primaries=9, color_trc=14)
    np.testing.assert_allclose(quarters_of(wide)[0], QUARTERS, atol=7)
    frame = write_png(tmp_path / "frame.png", SHOWN, (b"cICP", bytes([1, 1, 0, 1])))
    assert read_image(frame).pixels == pytest.approx(srgb_to_linear(SHOWN / np.float32(255)), abs=1e-6)


def video_of(path: Path, codec: str, form: str, frames: list[np.ndarray], **options: str) -> Path:
    """A video of RGB or RGBA frames in uint8, by a codec and a pixel format of FFmpeg."""
    muxer = "mpegts" if path.suffix == ".mts" else "mp4" if path.suffix == ".m4v" else None
    with av.open(str(path), "w", format=muxer) as container:
        stream = container.add_stream(codec, rate=25, options=options)
        stream.height, stream.width, stream.pix_fmt = *frames[0].shape[:2], form
        for number, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgba" if pixels.shape[2] == 4 else "rgb24")
            frame = frame.reformat(format=form, dst_colorspace=5)
            frame.pts, frame.time_base = number, Fraction(1, 25)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def bands() -> np.ndarray:
    """A frame [64, 96, 4] of alpha 0, 128 and 255 from the left, with colour under all of it."""
    alpha = np.uint8([0, 128, 255]).repeat(32)
    return np.dstack([SHOWN, np.broadcast_to(alpha, SHOWN.shape[:2])])


@pytest.mark.parametrize(
    ("name", "codec", "form"),
    [
        ("a.mov", "prores_ks", "yuva444p10le"),
        ("b.mov", "qtrle", "argb"),
    ],
)
def test_alpha_is_read(tmp_path: Path, name: str, codec: str, form: str) -> None:
    """White is white in any number of bits, and the colour under alpha stays."""
    options = {"profile": "4"} if codec == "prores_ks" else {}
    *_, frame = Video(video_of(tmp_path / name, codec, form, [bands()] * 3, **options)).frames()
    most = np.iinfo(frame.dtype).max
    assert most == (65535 if "10" in form else 255)
    found = frame[:, [4, 40, 92], 3] / most
    # lossy alpha is a level off; half of a code in 10 bits
    np.testing.assert_allclose(found, np.broadcast_to([0, 128 / 255, 1], found.shape), atol=1.1 / 255)
    assert (frame[:, 70:, 3] == most).all()
    np.testing.assert_allclose(frame[16::32, 24::48, :3] / most, QUARTERS / 255, atol=6 / 255)


def test_alpha_is_written(tmp_path: Path) -> None:
    """ProRes 4444 keeps it, and H.264 shows the image over black, as a JPEG does."""
    image = write_png(tmp_path / "a.png", bands())
    for name in ("a.mov", "a.mp4"):
        write_video(tmp_path / name, [image], Timing.steady(1, Fraction(24)), "")
    kept = next(Video(tmp_path / "a.mov").frames()) / 65535
    np.testing.assert_allclose(kept[:, [8, 40, 88], 3], [[0, 128 / 255, 1]] * 64, atol=1 / 1023)
    np.testing.assert_allclose(kept[16::32, 24::48, :3], QUARTERS / 255, atol=4 / 255)
    shown = next(Video(tmp_path / "a.mp4").frames()) / 255
    alpha = np.array([0, 128 / 255, 1])
    expected = linear_to_srgb(srgb_to_linear(SHOWN[:, [8, 40, 88]] / 255) * alpha[:, None])
    np.testing.assert_allclose(shown[8:24, [8, 40, 88]], expected[8:24], atol=4 / 255)


def bars(number: int, second: int) -> np.ndarray:
    """A bar that moves by 3 pixels a field: at frame `number` in odd rows, `second` fields later in even."""
    frame = np.full((64, 96, 3), 40, np.uint8)
    for row in range(64):
        left = 3 * (2 * number + second * (1 - row % 2))
        frame[row, left : left + 24] = 200
    return frame


@pytest.mark.parametrize("name", ["a.mp4", "a.mts", "a.avi"])
def test_interlaced_frames_become_progressive(tmp_path: Path, name: str) -> None:
    """Both rows show the time of the field that is first, in any order of reading."""
    frames = [bars(number, 1) for number in range(11)]
    coded = {"x264-params": "interlaced=1", "crf": "1", "g": "4"}
    path = video_of(tmp_path / name, "libx264", "yuv420p", frames, **coded)
    video = Video(path)
    assert len(video.timing.times_s) == 11
    for number, frame in enumerate(video.frames()):
        inside = np.s_[4:60]  # at the edge of the first frame bwdif has too little to go by
        np.testing.assert_allclose(frame[inside], bars(number, 0)[inside], atol=5)


def test_frames_that_are_not_marked_as_interlaced_are_not_filtered(tmp_path: Path) -> None:
    frames = [bars(number, 1) for number in range(3)]
    read = list(Video(video_of(tmp_path / "a.mp4", "libx264", "yuv444p", frames, crf="1")).frames())
    np.testing.assert_allclose(read[1], frames[1], atol=5)


@pytest.mark.parametrize(
    ("name", "codec", "form"),
    [
        ("a.mkv", "libx264", "yuv420p"),
        ("a.m4v", "libx264", "yuv420p"),
        ("a.mts", "libx264", "yuv420p"),
        ("a.mts", "mpeg2video", "yuv420p"),
        ("a.avi", "libx264", "yuv420p"),
        ("a.avi", "mpeg4", "yuv420p"),
        ("a.mxf", "mpeg2video", "yuv422p"),
    ],
)
def test_containers(tmp_path: Path, name: str, codec: str, form: str) -> None:
    """Frames with references to later ones, in their order and at their times, from the first to the last."""
    frames = [np.full((64, 96, 3), 12 * number, np.uint8) for number in range(20)]
    path = video_of(tmp_path / name, codec, form, frames, bf="2", g="6", b="4M")
    video = Video(path)
    assert video.timing.times_s == tuple(Fraction(number, 25) for number in range(20))
    means = [frame.mean() for frame in video.frames()]
    np.testing.assert_allclose(means, 12 * np.arange(20), atol=4)


def test_stored_frames_are_decoded_in_order_by_two_readers(tmp_path: Path, monkeypatch: Patch) -> None:
    """Key frames, the middle and all frames of each take, in turn, take two passes in all."""
    frames = [np.full((64, 96, 3), 3 * number, np.uint8) for number in range(80)]
    video = Video(video_of(tmp_path / "a.mp4", "libx264", "yuv420p", frames, bf="2", g="6"))
    passes, decoded = [], video.decoded
    monkeypatch.setattr(video, "decoded", lambda: passes.append(1) or decoded())
    stored = StoredFrames(video, tmp_path / "out" / "me")
    gc.collect()
    gc.disable()
    held = 0
    for take in (range(40), range(40, 80)):
        for number in (take.start, *take[::10], take.start + 20, *take):
            for near in (number, max(number - 4, take.start), min(number + 4, take.stop - 1)):
                assert stored.read(near).mean() == pytest.approx(3 * near, abs=2.5)
            if number % 20 == 19:
                held = max(held, sum(type(one) is av.VideoFrame for one in gc.get_objects()))
    gc.enable()
    assert len(passes) == 2 and held < 40, "frames are let go at once"
    (folder,) = (tmp_path / "out").iterdir()
    assert is_temporary(folder) and len(list(folder.iterdir())) == 64
    del stored
    assert not list((tmp_path / "out").iterdir())


def test_a_disk_without_room_for_frames_is_an_error(tmp_path: Path, monkeypatch: Patch) -> None:
    video = Video(video_of(tmp_path / "a.mp4", "libx264", "yuv420p", [SHOWN]))
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=64 * SHOWN.size - 1))
    refused(FacerfError, "choose another -o", StoredFrames(video, tmp_path / "out").read, 0)
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=64 * SHOWN.size))
    assert StoredFrames(video, tmp_path / "out").read(0).shape == SHOWN.shape
    (tmp_path / "file").touch()
    refused(FacerfError, "cannot store frames", StoredFrames(video, tmp_path / "file" / "me").read, 0)


def test_alpha_that_ffmpeg_does_not_decode_is_one_line(tmp_path: Path, caplog: Log) -> None:
    with av.open(str(tmp_path / "a.webm"), "w") as container:
        stream = container.add_stream("libvpx-vp9", rate=25)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuva420p"
        stream.metadata["alpha_mode"] = "1"
        container.mux(
            [*stream.encode(av.VideoFrame.from_ndarray(bands(), format="rgba")), *stream.encode(None)]
        )
    video_timing(tmp_path / "a.webm")
    (line,) = [record.getMessage() for record in caplog.records]
    assert "a.webm: alpha" in line and "convert it to ProRes 4444" in line


def with_sounds(path: Path, tones: list[tuple[str, int, float, float]], late_s: int = 0) -> Path:
    """Two frames, 0.08 s, and tones, each by codec, rate, frequency in Hz, and length in s."""
    with av.open(str(path), "w") as container:
        pictures = container.add_stream("libx264", rate=25)
        pictures.width, pictures.height, pictures.pix_fmt = 48, 32, "yuv420p"
        tracks = [container.add_stream(codec, rate=rate, layout="mono") for codec, rate, *_ in tones]
        for track, language in zip(tracks, ("eng", "ger"), strict=False):
            track.metadata["language"] = language
        for number in range(2):
            frame = av.VideoFrame.from_ndarray(np.full((32, 48, 3), 99, np.uint8))
            frame.pts, frame.time_base = 25 * late_s + number, Fraction(1, 25)
            container.mux(pictures.encode(frame))
        container.mux(pictures.encode(None))
        for track, (_, rate, hertz, length_s) in zip(tracks, tones, strict=True):
            wave = 0.3 * np.sin(2 * np.pi * hertz * np.arange(round(rate * length_s)) / rate)
            sound = av.AudioFrame.from_ndarray(wave[None].astype(np.float32), "fltp", "mono")
            sound.sample_rate, sound.pts, sound.time_base = rate, late_s * rate, Fraction(1, rate)
            container.mux(track.encode(sound))
            container.mux(track.encode(None))
    return path


def heard(path: Path) -> list[tuple[str, int, str | None, float, float]]:
    """Codec, rate, language, frequency and length of each tone of a video."""
    found = []
    with av.open(str(path)) as container:
        count = len(container.streams.audio)
    for number in range(count):
        with av.open(str(path)) as container:
            track = container.streams.audio[number]
            wave = np.concatenate([frame.to_ndarray().ravel() for frame in container.decode(track)])
            wave = wave / (32768 if wave.dtype.kind == "i" else 1)
            assert 0.1 < np.abs(wave).mean() < 0.2  # a tone of amplitude 0.3, and some silence
            coded, rate = track.codec_context, track.codec_context.sample_rate
            loudest = np.abs(np.fft.rfft(wave)).argmax() * rate / len(wave)
            found.append((coded.name, rate, track.language, loudest, len(wave) / rate))
    return found


@pytest.mark.parametrize(
    ("tones", "made", "codecs"),
    [
        ([("aac", 48000, 440, 0.08), ("aac", 48000, 880, 0.08)], "b.mp4", [("aac", 48000)] * 2),
        ([("aac", 44100, 440, 2.0)], "b.mp4", [("aac", 44100)]),
        ([(PCM, 192000, 440, 1.0), (PCM, 48000, 880, 2.0)], "b.mp4", [("aac", 96000), ("aac", 48000)]),
        ([(PCM, 5000, 440, 1.0)], "b.mp4", [("aac", 7350)]),
        ([("libopus", 48000, 440, 0.5)], "b.mp4", [("opus", 48000)]),
        ([("libopus", 48000, 440, 0.5)], "b.mov", [("aac", 48000)]),
        ([(PCM, 192000, 440, 1.0), (PCM, 50000, 880, 0.5)], "b.mov", [(PCM, 192000), (PCM, 50000)]),
    ],
)
def test_all_sound_is_kept(
    tmp_path: Path, tones: list[tuple[str, int, float, float]], made: str, codecs: list[tuple[str, int]]
) -> None:
    """Every track, as long as it is, at a rate that the codec takes."""
    source = tmp_path / ("a.mkv" if tones[0][0] == "libopus" else "a.mov")
    timing, path = video_timing(with_sounds(source, tones)), tmp_path / made
    write_video(path, images_of(tmp_path)[:2], timing, "")
    found = heard(path)
    assert [one[:2] for one in found] == codecs
    assert [one[2] for one in found] == ["eng", "ger"][: len(tones)]
    for (_, rate, hertz, length_s), (*_, loudest, lasts_s) in zip(tones, found, strict=True):
        assert loudest == pytest.approx(hertz, abs=1.5 / length_s)  # a step of the transform, and padding
        assert length_s - 1 / rate <= lasts_s < length_s + 3 * 1024 / min(rate, 7350)  # frames of AAC


@pytest.mark.parametrize("codec", ["aac", "pcm_s16le"])
def test_a_video_that_begins_late(tmp_path: Path, codec: str) -> None:
    """Cut out of another, at 2 s: it begins at 0, and its sound with it."""
    source = with_sounds(tmp_path / "a.mkv", [(codec, 48000, 440, 1.0)], late_s=2)
    timing = video_timing(source)
    assert timing.times_s == (0, Fraction(1, 25))
    write_video(tmp_path / "b.mp4", images_of(tmp_path)[:2], timing, "")
    with av.open(str(tmp_path / "b.mp4")) as container:
        starts = [float(stream.start_time * stream.time_base) for stream in container.streams]
    assert starts == pytest.approx([0, 0], abs=0.03)  # a frame of AAC


def test_sound_of_unknown_codecs_is_omitted_with_a_warning(tmp_path: Path, caplog: Log) -> None:
    data = bytearray(with_sounds(tmp_path / "a.mp4", [("aac", 48000, 440, 0.1)] * 2).read_bytes())
    at = data.rindex(b"mp4a")
    data[at : at + 4], config = b"apac", data.index(b"esds", at)
    data[config : config + 4] = b"free"
    (tmp_path / "b.mp4").write_bytes(data)
    write_video(tmp_path / "out.mp4", images_of(tmp_path)[:2], video_timing(tmp_path / "b.mp4"), "")
    assert "b.mp4: a sound track has an unknown codec" in caplog.text
    assert len(heard(tmp_path / "out.mp4")) == 1


def test_without_av_one_line_says_what_to_install(monkeypatch: Patch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    refused(UsageError, "pip install 'facerf[video]'", video_timing, tmp_path / "a.mp4")
