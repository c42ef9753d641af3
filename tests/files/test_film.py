"""Films read by frame, and written with times, sound and metadata."""

import struct
import sys
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.film import Film, Timing, comment_of, film_timing, write_film
from facerf_cli.files.images import read_image, write_display
from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear, to_linear_rec709
from tests.files.test_stated_by_files import bt2020_of, write_png

av: Any = pytest.importorskip("av", reason="films need av: pip install 'facerf[video]'")
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


def with_sound(path: Path, codec: str, frames: int = 30, rate: int = 25) -> Path:
    """A grey film with a tone."""
    with av.open(str(path), "w") as container:
        pictures = container.add_stream("libvpx-vp9" if path.suffix == ".webm" else "libx264", rate=rate)
        pictures.width, pictures.height, pictures.pix_fmt = 48, 32, "yuv420p"
        tone = container.add_stream(codec, rate=48000, layout="mono")
        for number in range(frames):
            frame = av.VideoFrame.from_ndarray(np.full((32, 48, 3), 8 * number, np.uint8))
            frame.pts, frame.time_base = number, Fraction(1, rate)
            container.mux(pictures.encode(frame))
        container.mux(pictures.encode(None))
        wave = 0.3 * np.sin(np.arange(48000 * frames // rate) * 0.06).astype(np.float32)
        resampler = av.AudioResampler(tone.format.name, "mono", 48000, frame_size=960)
        sound = av.AudioFrame.from_ndarray(wave[None], "fltp", "mono")
        sound.sample_rate, sound.pts, sound.time_base = 48000, 0, Fraction(1, 48000)
        for part in (*resampler.resample(sound), *resampler.resample(None)):
            container.mux(tone.encode(part))
        container.mux(tone.encode(None))
    return path


@pytest.mark.parametrize(("suffix", "kind", "most"), [(".mp4", np.uint8, 255), (".mov", np.uint16, 65535)])
def test_colours_and_order_come_back(tmp_path: Path, suffix: str, kind: type, most: int) -> None:
    images = images_of(tmp_path, bits=16 if suffix == ".mov" else 8)
    path = tmp_path / f"film{suffix}"
    write_film(path, images, Timing.steady(5, Fraction(30000, 1001)), "Synthetic: a test")
    assert comment_of(path) == "Synthetic: a test"
    with closing(Film(path)) as film:
        timing = film.timing()
        assert film.read(0).shape == (36, 50, 3) and len(timing.times_s) == 5 and timing.sound is None
        assert timing.rate == pytest.approx(30000 / 1001, rel=1e-4)
        for number in (3, 0, 4, 1, 2, 2):  # in any order
            frame = film.read(number)
            assert frame.dtype == kind
            # YCbCr of limited range has steps of 1 / 219 in 8 bits, and H.264 rounds once more
            found, steps = frame[8:-8, 8:-8].mean((0, 1)) / most, 1.6 if most == 255 else 0.6
            np.testing.assert_allclose(found, COLOURS[number], atol=steps / 255)


def test_an_odd_size_is_made_even(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    write_film(path, images_of(tmp_path, (35, 49)), Timing.steady(5, Fraction(24)), "")
    with closing(Film(path)) as film:
        assert film.read(0).shape == (36, 50, 3)


def test_times_of_a_film_with_an_uneven_rate_are_kept(tmp_path: Path) -> None:
    times_s = tuple(map(Fraction, ("0", "1/30", "1/10", "1/5", "1/2")))
    path = tmp_path / "film.mp4"
    write_film(path, images_of(tmp_path), Timing(times_s, Fraction(20)), "")
    assert [float(time_s) for time_s in film_timing(path).times_s] == pytest.approx(list(map(float, times_s)))


@pytest.mark.parametrize(
    ("source", "codec", "made", "kept"),
    [
        ("a.mp4", "aac", "b.mp4", "aac"),
        ("a.webm", "libopus", "b.mp4", "opus"),
        ("a.webm", "libopus", "b.mov", "aac"),
    ],
)
def test_sound_is_kept(tmp_path: Path, source: str, codec: str, made: str, kept: str) -> None:
    timing = film_timing(with_sound(tmp_path / source, codec))
    images = images_of(tmp_path)
    path = tmp_path / made
    write_film(path, [images[n % 5] for n in range(len(timing.times_s))], timing, "")
    with av.open(str(path)) as container:
        (track,) = container.streams.audio
        assert track.codec_context.name == kept
        loud = np.concatenate([frame.to_ndarray().ravel() for frame in container.decode(track)])
    assert len(loud) == pytest.approx(48000 * 30 / 25, rel=0.06)
    assert (
        0.1
        < np.abs(loud[4800:-4800].astype(np.float64)).mean() / (1 if loud.dtype.kind == "f" else 32768)
        < 0.3
    )


def test_a_film_that_cannot_be_finished_is_not_there(tmp_path: Path) -> None:
    images = images_of(tmp_path)
    images[3].write_bytes(b"no image")
    with pytest.raises(InputError, match=r"frame\.0003\.png"):
        write_film(tmp_path / "film.mp4", images, Timing.steady(5, Fraction(24)), "")
    assert not list(tmp_path.glob("*film*"))


def test_what_is_no_film_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no film at all\n" * 50)
    with pytest.raises(InputError, match=r"text\.mp4: not a readable film"):
        film_timing(tmp_path / "text.mp4")
    with av.open(str(tmp_path / "tone.mp4"), "w") as container:
        tone = container.add_stream("aac", rate=48000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 48000
        container.mux(tone.encode(frame))
        container.mux(tone.encode(None))
    with pytest.raises(InputError, match=r"tone\.mp4: holds no pictures"):
        film_timing(tmp_path / "tone.mp4")
    assert comment_of(tmp_path / "text.mp4") == ""


def test_a_film_in_hdr_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hdr.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=24)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        stream.codec_context.color_trc = 18  # HLG
        frame = av.VideoFrame.from_ndarray(np.zeros((32, 48, 3), np.uint8))
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(InputError, match="is an HDR film"):
        film_timing(path)


def coded_film(
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
    """The levels of the quarters, decoded by the film's space and encoded as sRGB; and the frame's shape."""
    with closing(Film(path)) as film:
        frame = film.read(0)
        linear = to_linear_rec709(frame, film.space)
    height, width = frame.shape[:2]
    at = np.s_[height // 4 :: height // 2, width // 4 :: width // 2]
    return 255 * linear_to_srgb(linear[at]), frame.shape[:2]


@pytest.mark.parametrize(("sar", "size"), [("2", (64, 192)), ("1/2", (128, 96)), ("4/3", (64, 128))])
def test_samples_become_square(tmp_path: Path, sar: str, size: tuple[int, int]) -> None:
    found, shape = quarters_of(coded_film(tmp_path / "a.mp4", SHOWN, sar))
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
    found, shape = quarters_of(coded_film(tmp_path / "a.mp4", SHOWN, turn=turn))
    np.testing.assert_allclose(found, expected, atol=4)
    assert shape == ((96, 64) if turn[0] == 0 else (64, 96))


def test_codes_of_a_film(tmp_path: Path) -> None:
    """BT.709 holds display values, as frames of it with cICP do; BT.2020 has its primaries and its curve."""
    plain = coded_film(tmp_path / "a.mp4", SHOWN, color_primaries=1, color_trc=1)
    np.testing.assert_allclose(quarters_of(plain)[0], QUARTERS, atol=4)
    stored = np.round(255 * bt2020_of(srgb_to_linear(SHOWN / np.float32(255)))).astype(np.uint8)
    wide = coded_film(tmp_path / "b.mp4", stored, color_primaries=9, color_trc=14)
    np.testing.assert_allclose(quarters_of(wide)[0], QUARTERS, atol=7)
    frame = write_png(tmp_path / "frame.png", SHOWN, (b"cICP", bytes([1, 1, 0, 1])))
    assert read_image(frame).pixels == pytest.approx(srgb_to_linear(SHOWN / np.float32(255)), abs=1e-6)


def test_without_av_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(UsageError, match=r"pip install 'facerf\[video\]'"):
        film_timing(tmp_path / "a.mp4")
