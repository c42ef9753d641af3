"""Videos and sequences from the command line, by the face's field with a network that is Lambert's law."""

import json
import os
import shutil
from collections.abc import Iterator
from fractions import Fraction
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pytest
from PIL import Image
from skimage.data import astronaut

from facerf_cli.batch.inputs import Item, files_read
from facerf_cli.batch.settings import BatchOptions, Settings
from facerf_cli.cli.relight import plan_relight
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.light.setups import LightSources
from facerf_cli.main import main
from facerf_cli.work import estimate_light
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.relight import with_background
from facerf_cli.work.relight_options import RelightOptions, parse_background
from facerf_cli.work.sequence import OpenShot, ShotFrames
from facerf_cli.work.sequence import _made_from as made_from
from facerf_cli.work.shots import ShotOptions, Shots, VideoOutput, collect_frames, video_rate
from tests.cli.toy_checkpoint import save_toy_checkpoint
from tests.folders import only_row
from tests.folders import rows as rows_of
from tests.kinds import Folders, Log, Patch, Said

av: Any = pytest.importorskip("av", reason="videos need av: pip install 'facerf[video]'")
PHOTO = Path(__file__).parents[2] / "examples/astronaut.jpg"
FRAMES = 3
CHEAP = ("--reflectance", "field", "--lights", "12")
PHOTO_OPTIONS = PhotoOptions(Settings())


def frame_of(number: int) -> np.ndarray:
    """The astronaut's head, a little further to the left in each frame."""
    return np.ascontiguousarray(astronaut()[10:202, 110 + 2 * number : 334 + 2 * number])


def write_source(path: Path, frames: Iterator[np.ndarray] | list[np.ndarray]) -> None:
    """A video of 25 frames a second with silence."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.options = 224, 192, "yuv420p", {"crf": "12"}
        sound = container.add_stream("aac", rate=48000, layout="mono")
        for number, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixels)
            frame.pts, frame.time_base = number, Fraction(1, 25)
            container.mux(stream.encode(frame))
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
            silence.sample_rate, silence.pts = 48000, 1024 * number
            container.mux(sound.encode(silence))
        container.mux(stream.encode(None))
        container.mux(sound.encode(None))


def write_qtrle(path: Path, frames: list[np.ndarray]) -> None:
    """A video of frames [192, 224, 4], without loss."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("qtrle", rate=25)
        stream.width, stream.height, stream.pix_fmt = 224, 192, "argb"
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgba")))
        container.mux(stream.encode(None))


@pytest.fixture(scope="module")
def given(tmp_path_factory: Folders) -> Path:
    """A folder with a checkpoint, a small photo and a video."""
    folder = tmp_path_factory.mktemp("given")
    save_toy_checkpoint(folder / "lambert.safetensors")
    write_source(folder / "me.mp4", [frame_of(number) for number in range(FRAMES)])
    Image.fromarray(frame_of(0)).save(folder / "small.png")
    return folder


def facerf(given: Path, verb: str, *line: object) -> int:
    return main(["--checkpoint", str(given / "lambert.safetensors"), verb, *map(str, line)])


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))


def test_a_video_becomes_numbered_images_of_one_identity_and_exposure(
    given: Path, tmp_path: Path, capsys: Said
) -> None:
    out = tmp_path / "out"
    assert facerf(given, "relight", given / "me.mp4", "--light", "70,20", "-o", out, *CHEAP) == 0
    images = [f"me_light_70_20.{number:04d}.{kind}" for number in range(FRAMES) for kind in ("exr", "png")]
    assert names(out) == sorted([*images, "me_track.jsonl"])
    rows = list(rows_of(out).values())
    assert [row["item"] for row in rows] == [f"me.{number:04d}" for number in range(FRAMES)]
    assert len({tuple(row["exposure_ev"].values()) for row in rows}) == 1
    track = [json.loads(line) for line in (out / "me_track.jsonl").read_text().splitlines()][1:]
    left = [np.mean(row["landmarks"], 0)[0] for row in track]
    assert np.diff(left) == pytest.approx([-2] * (FRAMES - 1), abs=0.5)  # pixels: as the video moves
    capsys.readouterr()
    assert facerf(given, "relight", given / "me.mp4", "--light", "70,20", "-o", out, *CHEAP) == 0
    assert capsys.readouterr().out == "" and names(out) == sorted([*images, "me_track.jsonl"])


def test_all_frames_have_the_one_light_of_the_picture_behind_them(
    given: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said
) -> None:
    """It is guessed once; a video in its place is refused."""
    guessed = []
    monkeypatch.setattr(estimate_light, "stated_fov_deg", lambda image: guessed.append(image))
    ramp = np.linspace(20, 220, 60).astype(np.uint8)[None, :, None]
    Image.fromarray(np.broadcast_to(ramp, (40, 60, 3))).save(tmp_path / "beach.png")
    line = ("--background", tmp_path / "beach.png", "--light-from", "background", "--light-wrap", "0.3")
    out = tmp_path / "out"
    assert facerf(given, "relight", given / "me.mp4", *line, "--format", "exr", "-o", out, *CHEAP) == 0
    assert len(guessed) == 1
    lights = {read_image(path).metadata["facerf:lights"] for path in out.glob("*.exr")}
    assert len(lights) == 1 and len(list(out.glob("*.exr"))) == FRAMES
    rows = list(rows_of(out).values())
    assert all(list(row["exposure_ev"].values()) == [0] for row in rows)
    capsys.readouterr()
    video = ("--background", given / "me.mp4", "--light-from", "background", "--dry-run")
    assert facerf(given, "relight", given / "small.png", *video, "-o", tmp_path / "no", *CHEAP) == 2
    assert "me.mp4: videos are not supported" in capsys.readouterr().err


def test_each_frame_has_its_image_of_a_moving_background(given: Path, tmp_path: Path, capsys: Said) -> None:
    """The first frame has the first image by its number; the light of the background is that image's."""
    greys = {"b.8.png": 40, "b.9.png": 120, "b.10.png": 200, "b.11.png": 250}
    for folder in ("plates", "bg"):
        (tmp_path / folder).mkdir()
    for name, grey in greys.items():
        Image.new("RGB", (60, 40), (grey,) * 3).save(tmp_path / "bg" / name)
    for number in range(FRAMES):
        Image.fromarray(frame_of(number)).save(tmp_path / f"plates/me.{1001 + number}.png")
    plates, more = (tmp_path / "plates", "--sequence"), ("--format", "png", *CHEAP)

    def made(background: str, *line: object) -> int:
        return facerf(given, "relight", *line, "--background", tmp_path / background, *more)

    out = ("--light", "60,20", "-o", tmp_path / "out")
    assert made("bg", *plates, *out) == 0
    shown = [np.asarray(Image.open(path)) for path in sorted((tmp_path / "out").glob("*.png"))]
    assert [int(image[0, 0, 0]) for image in shown] == [40, 120, 200]
    assert made("bg/b.%d.png", *plates, *out) == 0 and "finished and kept" in capsys.readouterr().err
    from_behind = ("--light-from", "background", "-o", tmp_path / "light", "--dry-run")
    assert made("bg/b.####.png", *plates, *from_behind) == 2  # four digits
    assert made("bg/b.8-10.png", *plates, *from_behind) == 0
    assert "me_b_light.1003.png" in capsys.readouterr().out
    shutil.copy(tmp_path / "bg/b.8.png", tmp_path / "bg/b.9.png")
    assert made("bg/b.%d.png", *plates, *out, "--dry-run") == 0
    assert "3 items out of date: options changed" in capsys.readouterr().err
    into = ("--light", "60,20", "--name", "b.{frame:1}", "-o", tmp_path / "bg")
    line = [tmp_path / f"plates/me.{number}.png" for number in (8, 9, 10)]
    for path in line:
        shutil.copy(tmp_path / "plates/me.1001.png", path)
    assert made("bg/b.%d.png", *line, "--sequence", *into) == 2
    assert "b.8.png: is the input" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("background", "inputs", "said"),
    [
        ("bg/b.1-2.png", ["me.mp4"], "2 images, but the shot has 3 frames"),
        ("bg/b.%d.png", ["small.png"], "small.png is not a frame of a shot"),
        ("bg/c.%d.png", ["me.mp4"], "c.%d.png"),
        ("empty", ["me.mp4"], "no inputs found"),
        ("bg/{frames}.png", ["small.png"], "unknown field {frames}"),
        ("bg/{stem}.mov", ["small.png"], "videos are not supported"),
        ("video", ["me.mp4"], "video: not a readable image"),
        ("text.png", ["small.png"], "text.png: not a readable image"),
    ],
)
def test_a_background_that_does_not_fit_is_refused_before_the_first_frame(
    given: Path, tmp_path: Path, background: str, inputs: list[str], said: str, capsys: Said
) -> None:
    for name in ("bg", "empty"):
        (tmp_path / name).mkdir()
    for number in (1, 2):
        Image.new("RGB", (6, 4)).save(tmp_path / f"bg/b.{number}.png")
    shutil.copy(given / "me.mp4", tmp_path / "video")
    (tmp_path / "text.png").write_text("not an image")
    line = ("--background", tmp_path / background, "--light", "60,20", "-o", tmp_path / "out", "--dry-run")
    assert facerf(given, "relight", *(given / name for name in inputs), *line, *CHEAP) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert said in error


def test_photos_have_backgrounds_by_their_names(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.png", "c_sky.png"):
        Image.new("RGB", (6, 4)).save(tmp_path / name)
    photo, sources = PhotoOptions(Settings(device="cpu")), LightSources(light=["60,20"])
    shown = {}
    for background, stem in ((tmp_path, "a"), (tmp_path, "b"), (tmp_path / "{stem}_sky.png", "c")):
        item = Item(Path(f"photos/{stem}.jpg"), tmp_path / "out" / stem, stem, PurePosixPath(f"{stem}.jpg"))
        options = RelightOptions(photo=photo, background=parse_background(str(background)))
        plan = plan_relight(options, sources, tmp_path / "out").of_items([item], Shots(), tmp_path / "out")
        shown[stem] = with_background(plan, item).options.background.path
        assert list(files_read(plan, [item])) == [shown[stem]]
    assert shown == {"a": tmp_path / "a.jpg", "b": tmp_path / "b.png", "c": tmp_path / "c_sky.png"}


@pytest.mark.slow
def test_an_interrupted_video_goes_on_where_it_was(given: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    out, made = tmp_path / "relit.mp4", []
    line = ("relight", given / "me.mp4", "--light", "70,20", "-o", out, "--exposure", "0", *CHEAP)
    fitted = OpenShot.fitted

    def counted(shot: OpenShot, number: int, *rest: Any) -> Any:
        if len(made) == 1:
            made.append("stop")
            raise KeyboardInterrupt
        made.append(number)
        return fitted(shot, number, *rest)

    monkeypatch.setattr(OpenShot, "fitted", counted)
    assert facerf(given, *line) == 130
    assert not out.exists() and made == [0, "stop"]
    assert facerf(given, *line) == 0
    assert made == [0, "stop", 1, 2]
    assert names(tmp_path) == ["relit.mp4"]  # the folder of the frames is gone
    with av.open(str(out)) as container:
        assert container.streams.video[0].frames == FRAMES and container.streams.video[0].average_rate == 25
        assert container.streams.audio[0].codec_context.name == "aac"
        comment = container.metadata["comment"]
    assert comment.startswith("Synthetic") and "IPTC:DigitalSourceType" in comment
    before = out.stat().st_mtime_ns
    assert facerf(given, *line) == 0 and out.stat().st_mtime_ns == before and len(made) == 4
    assert facerf(given, *line, "--light", "60,20") == 2  # two lights are two videos


def test_a_still_photo_under_a_turning_map_is_smooth(given: Path, tmp_path: Path) -> None:
    """Under the map 1 + cos(azimuth) each pixel is a + b cos(turn) + c sin(turn), whatever the face is."""
    height, turns = 64, 5
    azimuth = (0.5 - (np.arange(2 * height) + 0.5) / (2 * height)) * 2 * np.pi
    row = (1 + np.cos(azimuth)).astype(np.float32)[None, :, None]
    write_exr(tmp_path / "wave.exr", np.broadcast_to(row, (height, 2 * height, 3)).copy())
    out = tmp_path / "out"
    line = ("--envmap", tmp_path / "wave.exr", "--rotate", f"0:360:{turns}", "--format", "exr")
    line = (given / "small.png", *line, "-o", out, "--reflectance", "field", "--lights", "60")
    assert facerf(given, "relight", *line) == 0
    frames = np.stack([read_image(path).pixels for path in sorted(out.glob("*.exr"))])
    angles = 2 * np.pi * np.arange(turns) / turns
    waves = np.stack([np.ones(turns), np.cos(angles), np.sin(angles)], 1)
    flat = frames.reshape(turns, -1)
    left = flat - waves @ np.linalg.lstsq(waves, flat, rcond=None)[0]
    assert np.abs(flat - flat.mean(0)).max() > 0.05 * flat.mean()
    # half floats have steps of 1 / 2048; cells of the rig and texels of the map do not divide each other
    assert np.abs(left).max() < 4e-3 * flat.max()


def test_a_photo_under_a_turning_map_becomes_a_video(
    given: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said
) -> None:
    write_exr(tmp_path / "grey.exr", np.full((8, 16, 3), 0.3, np.float32))
    out = tmp_path / "me.mov"
    line = ("--envmap", tmp_path / "grey.exr", "--rotate", "0:360:3", "--fps", "30000/1001", "-o", out)
    assert facerf(given, "relight", given / "small.png", *line, *CHEAP) == 0
    with av.open(str(out)) as container:
        (stream,) = container.streams
        assert stream.codec_context.name == "prores" and stream.frames == 3
        assert float(stream.average_rate) == pytest.approx(30000 / 1001, rel=1e-3)
        assert "facerf:key=" in container.metadata["comment"]
    before = out.read_bytes()
    for cache in ("here", "elsewhere"):  # a fresh cache knows the video by the key that it carries
        in_cache = partial(lambda cache, file: tmp_path / cache / f"{file.name}.jsonl", cache)
        monkeypatch.setattr("facerf_cli.batch.journal._in_cache", in_cache)
        capsys.readouterr()
        assert facerf(given, "relight", given / "small.png", *line, *CHEAP) == 0
        assert "up to date" in capsys.readouterr().err and out.read_bytes() == before
    other = (*line, *CHEAP, "--white-balance", "neutral")
    for more in ((), ("--dry-run",)):
        assert facerf(given, "relight", given / "small.png", *other, *more) == 1
        assert f"{out}: was not written by facerf" in capsys.readouterr().err
    assert out.read_bytes() == before and not out.with_name("me.mov.frames").exists()
    assert facerf(given, "relight", given / "small.png", *other, "--overwrite", "always") == 0
    assert facerf(given, "relight", given / "small.png", *line, *CHEAP) == 0, "it is facerf's, by the index"


@pytest.mark.slow
def test_images_are_a_shot_with_sequence_and_a_frame_without_a_face_is_bridged(
    given: Path, tmp_path: Path, caplog: Log
) -> None:
    plates = tmp_path / "plates"
    plates.mkdir()
    for number in range(3):
        pixels = frame_of(number) if number != 1 else np.full((192, 224, 3), 90, np.uint8)
        write_exr(plates / f"plate.{1001 + number}.exr", (pixels / np.float32(255)) ** np.float32(2.2))
    out = tmp_path / "out"
    line = (plates / "plate.%04d.exr", "--sequence", "--light", "70,20", "--format", "png", "-o", out)
    assert facerf(given, "relight", *line, *CHEAP) == 0
    assert [name for name in names(out) if name.endswith(".png")] == [
        f"plate_light_70_20.{number}.png" for number in (1001, 1002, 1003)
    ]
    track = [json.loads(line) for line in (out / "plate_track.jsonl").read_text().splitlines()][1:]
    assert [row["landmarks"] is None for row in track] == [False, True, False]


@pytest.mark.parametrize("more", [(), ("--dry-run",)])
@pytest.mark.parametrize("frames", [("plate.1-4.exr",), ("plate.%d.exr",), ("plate.3.exr", "plate.4.exr")])
def test_a_sequence_with_a_hole_is_said(
    given: Path, tmp_path: Path, capsys: Said, frames: tuple[str, ...], more: tuple[str, ...]
) -> None:
    """Before anything is made."""
    for number in (1, 2, 4):
        write_exr(tmp_path / f"plate.{number}.exr", frame_of(number) / np.float32(255))
    line = (*(tmp_path / name for name in frames), "--sequence", "--light", "0,0")
    for out in ("out", "out.mp4"):
        assert facerf(given, "relight", *line, "-o", tmp_path / out, *CHEAP, *more) == 1
        said = capsys.readouterr()
        assert "plate.3.exr: no such file" in said.err or "frame, 3, is missing" in said.err
        assert said.out == "" and len(names(tmp_path)) == 3


@pytest.mark.parametrize(
    ("stated", "given_rate", "timecode", "expected"),
    [
        ([(30000, 1001)] * 2, None, 0x01020344, (Fraction(30000, 1001), "01:02:03;04")),
        ([(30000, 1001)] * 2, "25", 0x01020344, (25, "01:02:03:04")),  # 25 has no drop-frame
        ([(25, 1), (24, 1)], None, None, (25, None)),
        ([(48, 1), None], None, None, (48, None)),
        ([None, None], None, None, (24, None)),
        *(([bad, bad], None, None, (24, None)) for bad in ((0, 0), (-24, 1), (2**31 - 1, 1), (24, 0))),
        ([(2**31 - 1, 89478485)] * 2, None, None, (24, None)),  # almost
    ],
)
def test_rates_that_headers_state(
    tmp_path: Path,
    stated: list[tuple[int, int] | None],
    given_rate: str | None,
    timecode: int | None,
    expected: tuple[Any, str | None],
    caplog: Log,
) -> None:
    images = []
    for number, rate in enumerate(stated):
        of_rate: dict[str, Any] = {"framesPerSecond": rate} if rate else {}
        header = of_rate | ({} if timecode is None else {"smpte:TimeCode": (timecode, 0)})
        write_exr(tmp_path / f"me_{number}.exr", np.zeros((16, 16, 3), np.float32), metadata=header)
        images.append(tmp_path / f"lit_{number}.png")
        Image.fromarray(np.zeros((16, 16, 3), np.uint8)).save(images[-1])
    batch = BatchOptions(output=tmp_path / "me.mp4.frames")
    items, shots = collect_frames([str(tmp_path / "me_%d.exr")], ShotOptions(True), batch, PHOTO_OPTIONS)
    video = VideoOutput(tmp_path / "me.mp4", video_rate(given_rate) if given_rate else None)
    video.folder.mkdir()
    recipe = video.recipe_if_new(items, shots, images, lambda digest_of: [], batch)
    assert ("me.mp4: frames state different rates" in caplog.text) == (len(set(stated)) > 1)
    slow = VideoOutput(video.path, Fraction(12))
    assert slow.recipe_if_new(items, shots, images, lambda digest_of: [], batch) != recipe
    assert video.joined(items, images, shots, recipe, 0) == 0
    with av.open(str(video.path)) as container:
        (stream, *_) = container.streams
        assert (stream.average_rate, stream.metadata.get("timecode")) == expected


@pytest.mark.slow
def test_alpha_of_a_video_is_kept(given: Path, tmp_path: Path, capsys: Said) -> None:
    """As a photo's: in frames, and in a video of frames that can have it; the other is said."""
    clear = np.zeros((192, 224), np.uint8)
    clear[:, 112:] = 255
    write_qtrle(tmp_path / "cut.mov", [np.dstack([frame_of(number), clear]) for number in range(2)])
    line = ("relight", tmp_path / "cut.mov", "--light", "70,20", *CHEAP)
    assert facerf(given, *line, "--format", "exr", "-o", tmp_path / "out") == 0
    for number in range(2):
        alpha = read_image(tmp_path / "out" / f"cut_light_70_20.{number:04d}.exr").alpha
        np.testing.assert_array_equal(alpha, clear / np.float32(255))
    assert facerf(given, *line, "-o", tmp_path / "out.mov") == 0
    with av.open(str(tmp_path / "out.mov")) as container:
        found = next(container.decode(video=0)).to_ndarray(format="rgba")[..., 3]
    np.testing.assert_allclose(found, clear, atol=1)
    capsys.readouterr()
    assert facerf(given, *line, "-o", tmp_path / "out.mp4") == 0
    assert "over black; use FILE.mov for alpha" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["plates", "shot.mov"])
def test_alpha_that_is_0_in_every_frame_is_none(tmp_path: Path, name: str, caplog: Log) -> None:
    """One frame alone is empty: the person has not entered."""
    for shown in (0, 255):
        frames = [np.dstack([frame_of(0), np.full((192, 224), alpha, np.uint8)]) for alpha in (0, shown, 0)]
        given = tmp_path / str(shown) / name
        (given if name == "plates" else given.parent).mkdir(parents=True)
        if name == "plates":
            for number, pixels in enumerate(frames):
                Image.fromarray(pixels).save(given / f"me_{number}.png")
        else:
            write_qtrle(given, frames)
        options = PhotoOptions(Settings())
        batch = BatchOptions(output=tmp_path / "out")
        (shot,) = collect_frames([str(given)], ShotOptions(sequence=True), batch, options)[1]
        read = ShotFrames(shot, options)
        alphas = [read.image(number).alpha for number in (2, 0, 1)]
        if shown:
            assert [float(alpha.mean()) for alpha in alphas if alpha is not None] == [0, 0, 1]
        else:
            assert alphas == [None] * 3
        assert (caplog.text.count("transparent in every frame") == 1) == (not shown)
        caplog.clear()


def test_a_video_of_the_same_size_and_time_has_another_track(tmp_path: Path) -> None:
    video, options = tmp_path / "me.mov", PhotoOptions(Settings())
    write_qtrle(video, [np.dstack([frame_of(0), np.full((192, 224), 255, np.uint8)])] * 2)
    (shot,) = collect_frames([str(video)], ShotOptions(), BatchOptions(tmp_path / "out"), options)[1]
    head, before = made_from(shot, options), video.stat()
    assert made_from(shot, options) == head
    video.write_bytes(video.read_bytes())
    os.utime(video, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert made_from(shot, options) != head


@pytest.mark.slow
def test_a_frame_whose_matte_is_black_is_left_as_it_is(tmp_path: Path, capsys: Said) -> None:
    """By the portrait field, too, which its neighbours have without it; all black is refused."""
    for folder in ("plates", "roto", "black"):
        (tmp_path / folder).mkdir()
    matte = np.zeros((192, 224), np.uint8)
    matte[10:, 40:190] = 255
    for number in range(2):
        Image.fromarray(frame_of(number)).save(tmp_path / f"plates/me_{number}.png")
        Image.fromarray(matte * np.uint8(number)).save(tmp_path / f"roto/me_{number}.png")
        Image.fromarray(matte * np.uint8(0)).save(tmp_path / f"black/me_{number}.png")

    def made(mattes: str) -> int:
        line = ("relight", tmp_path / "plates", "--sequence", "--person", tmp_path / mattes, "--lights", "12")
        more = ("--light", "70,20", "--format", "png", "--exposure", "0", "-o", tmp_path / f"{mattes}_lit")
        return main([str(part) for part in (*line, *more)])

    assert made("roto") == 0
    lit = [np.asarray(Image.open(path)) for path in sorted((tmp_path / "roto_lit").glob("*.png"))]
    np.testing.assert_array_equal(lit[0], frame_of(0))
    assert np.abs(lit[1].astype(int) - frame_of(1))[matte > 0].mean() > 5
    assert made("black") == 1
    assert "its mattes are black in every frame" in capsys.readouterr().err


def test_sound_that_cannot_be_written_is_said_before_the_first_frame(
    given: Path, tmp_path: Path, capsys: Said
) -> None:
    """AAC has no 24 channels."""
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 224, 192, "yuv420p"
        sound = container.add_stream("pcm_s16le", rate=48000, layout="22.2")
        container.mux([*stream.encode(av.VideoFrame.from_ndarray(frame_of(0))), *stream.encode(None)])
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 24 * 960), np.int16), "s16", "22.2")
        silence.sample_rate = 48000
        container.mux(sound.encode(silence))
    out = tmp_path / "out.mp4"
    assert facerf(given, "relight", tmp_path / "a.mkv", "--light", "70,20", "-o", out, *CHEAP) == 1
    assert "a.mkv: its sound cannot be written" in capsys.readouterr().err
    assert names(tmp_path) == ["a.mkv"]


def test_one_light_is_estimated_for_a_video(given: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert facerf(given, "estimate-light", given / "me.mp4", "--lights", "20", "-o", out) == 0
    assert names(out) == ["me_light.exr", "me_light.json", "me_light.png", "me_track.jsonl"]
    row = only_row(out)
    assert row["frames"] == [0, 1, 2] and row["residual"] < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("edited", [True, False])
def test_a_track_of_the_user_is_not_replaced(given: Path, tmp_path: Path, capsys: Said, edited: bool) -> None:
    path, line = tmp_path / "me_track.jsonl", (given / "me.mp4", "--light", "70,20", *CHEAP, "-o", tmp_path)
    if edited:
        assert facerf(given, "relight", *line) == 0
        changed = path.read_text().replace('"expected_error": 0.0', '"expected_error": 0.5', 1)
        path.write_text(changed.removesuffix("\n"))  # as some editors save it
    else:
        path.write_text('{"mine": true}\nand half a line')
    before = path.read_bytes()
    assert facerf(given, "relight", *line, "--no-cuts") == 1
    assert f"{path}: not written by facerf" in capsys.readouterr().err
    assert path.read_bytes() == before
    assert not edited or facerf(given, "relight", *line) == 0, "its edits count"
    assert path.read_bytes() == before


@pytest.mark.slow
def test_nothing_crosses_a_cut(given: Path, tmp_path: Path, capsys: Said) -> None:
    """The second take is dark and mirrored."""
    takes = [frame_of(0)] * 2 + [(frame_of(0)[:, ::-1] * 0.5).astype(np.uint8)] * 2
    write_source(tmp_path / "cut.mp4", takes)
    line = (tmp_path / "cut.mp4", "--light", "70,20", "--format", "png", *CHEAP)

    def made(folder: str, *more: str) -> tuple[list[dict[str, Any]], list[float]]:
        assert facerf(given, "relight", *line, "-o", tmp_path / folder, *more) == 0
        track = (tmp_path / folder / "cut_track.jsonl").read_text().splitlines()[1:]
        ended = rows_of(tmp_path / folder).values()
        exposures = [next(iter(row["exposure_ev"].values())) for row in ended]
        return [json.loads(row) for row in track], exposures

    rows, exposures = made("out")
    assert [row.get("cut", False) for row in rows] == [False, False, True, False]
    assert "cut: cuts at frame 2:" in capsys.readouterr().err
    places = np.array([np.mean(row["landmarks"], 0) for row in rows])
    assert np.abs(np.diff(places[:2], axis=0)).max() < 1 > np.abs(np.diff(places[2:], axis=0)).max()
    first, second = exposures[:2], exposures[2:]
    assert len(set(first)) == len(set(second)) == 1 and first[0] != second[0]
    capsys.readouterr()
    rows, exposures = made("one", "--no-cuts")
    assert not any("cut" in row for row in rows) and len(set(exposures)) == 1
    assert "cuts at" not in capsys.readouterr().err


@pytest.mark.slow
def test_each_take_has_its_light(given: Path, tmp_path: Path) -> None:
    write_source(tmp_path / "cut.mp4", [frame_of(0)] * 2 + [np.ascontiguousarray(frame_of(0)[:, ::-1])] * 2)
    out = tmp_path / "out"
    assert facerf(given, "estimate-light", tmp_path / "cut.mp4", "--lights", "20", "-o", out) == 0
    lights = {name for name in names(out) if name.endswith("_light.json")}
    assert lights == {"cut_light.json", "cut_take2_light.json"}
    row = only_row(out)
    assert [take["frames"] for take in row["takes"]] == [[0, 1], [2, 3]]


def test_people_are_cut_out_of_a_video(given: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["segment", str(given / "me.mp4"), "-o", str(out)]) == 0
    mattes = [read_image(out / f"me.{number:04d}_segment.exr").alpha for number in range(FRAMES)]
    assert all(matte is not None and 0.2 < matte.mean() < 0.9 for matte in mattes)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (("{video}", "--light", "0,0", "-o", "{out}.mp4", "--format", "png"), "--format"),
        (("{video}", "--light", "0,0", "-o", "{out}.mp4", "--background", "none"), "has no alpha"),
        (("{video}", "--light", "0,0", "-o", "{out}.mp4", "--fps", "25"), "--fps: "),
        (("{video}", "--light", "0,0", "-o", "{video}"), "is the input"),
        (("{video}", "--light", "0,0", "-o", "{out}.webm"), "use one of these"),
        (("{photo}", "--light", "0,0", "-o", "{out}.mp4", "--fps", "0"), "--fps"),
        (("{photo}", "--light", "0,0", "-o", "{out}.mp4", "--fps", "1/9999999"), "--fps"),
        (("{photo}", "--light", "0,0", "-o", "{out}.mp4"), "-o "),
        (("{video}", "--light", "0,0", "-o", "{out}", "--face", "all"), "--face INDEX"),
        (("{video}", "--light", "20,0;face=0", "-o", "{out}"), "add --face 0"),
        (("{video}", "--light", "20,0;face=0", "-o", "{out}", "--face", "1"), "add --face 0"),
        (("{video}", "--light", "0,0", "-o", "{out}", "--geometry", "network"), "--geometry network: "),
        (("{video}", "--light", "0,0", "-o", "{out}", "--landmarks", "{photo}"), "--landmarks: "),
        (("{video}", "--light", "0,0", "-o", "{out}", "--shard", "1/2"), "use --jobs"),
    ],
)
def test_options_that_a_video_cannot_have(
    given: Path, tmp_path: Path, line: tuple[str, ...], message: str, capsys: Said
) -> None:
    filled = [part.format(video=given / "me.mp4", photo=PHOTO, out=tmp_path / "out") for part in line]
    assert main(["relight", *filled]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
