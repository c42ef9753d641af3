"""The items of a command line: which files, under which names."""

import io
import logging
import os
import subprocess
import sys
import unicodedata
from contextlib import suppress
from pathlib import Path, PurePosixPath
from subprocess import PIPE

import numpy as np
import pytest
from PIL import Image

from facerf_cli.batch import inputs as inputs_module
from facerf_cli.batch.inputs import (
    PHOTO_SUFFIXES,
    Item,
    NamePattern,
    collect_items,
    expand_inputs,
    split_frame,
)
from facerf_cli.batch.settings import BatchOptions, Settings
from facerf_cli.errors import InputError, UsageError
from facerf_cli.main import main
from facerf_cli.work.photo_options import PhotoOptions, check_companion
from facerf_cli.work.photos import companion
from facerf_cli.work.shots import ShotOptions, collect_frames
from tests.batch import toy_batch
from tests.folders import rows as rows_of
from tests.kinds import Log, Patch, Said
from tests.refusals import refused


def names(tmp_path: Path, *inputs: Path, pattern: str | None = None) -> list[str]:
    chosen = NamePattern.parse(pattern, "--name") if pattern else None
    items = collect_items([str(path) for path in inputs], tmp_path / "out", PHOTO_SUFFIXES, chosen)
    return [item.name for item in items]


def test_folders_are_mirrored_and_named_files_stand_alone(photos: Path, tmp_path: Path) -> None:
    assert names(tmp_path, photos) == ["Z", "a", "b", "x/a", "x/c"]
    (item,) = collect_items([str(photos / "x" / "a.jpg")], tmp_path / "out", PHOTO_SUFFIXES)
    assert item.output("/mesh.glb") == tmp_path / "out" / "a" / "mesh.glb"
    elsewhere = tmp_path / "elsewhere" / "deep" / "e.png"
    elsewhere.parent.mkdir(parents=True)
    elsewhere.touch()
    assert names(tmp_path, photos / "x", elsewhere) == [
        *names(tmp_path, elsewhere),
        *names(tmp_path, photos / "x"),
    ]
    assert names(tmp_path, photos / "x" / "a.jpg", photos / "x", photos) == ["Z", "a", "b", "x/a", "x/c"]


def test_what_a_folder_passes_over_is_counted_and_named(photos: Path, tmp_path: Path, caplog: Log) -> None:
    caplog.set_level(logging.INFO, "facerf")
    for name in ("a.nef", "x/b.NEF", "video.mp4", "LICENCE", "d.bmp", "e.gif", "f.jfif", "g.jpe"):
        (photos / name).touch()
    (tmp_path / "others").mkdir()
    (photos / "x" / "linked").symlink_to(tmp_path / "others")
    (photos / "out").symlink_to(tmp_path / "out")
    (tmp_path / "out").mkdir()
    assert names(tmp_path, photos) == ["Z", "a", "b", "d", "e", "f", "g", "x/a", "x/c"]
    (line,) = [record.getMessage() for record in caplog.records]
    kinds = "2 .nef, 1 .mp4, 1 without suffix, 1 .txt"
    assert sorted(line.partition("(")[2].partition(")")[0].split(", ")) == sorted(kinds.split(", "))
    assert "not read: 5 files (" in line and f"linked folder {photos}/x/linked; name a file" in line
    caplog.clear()
    names(tmp_path, photos / "b.jpg")
    assert not caplog.records


def test_two_inputs_that_meet_are_refused(photos: Path, tmp_path: Path) -> None:
    refused(UsageError, "a.png and ... --name", names, tmp_path, photos / "a.png", photos / "x" / "a.jpg")
    (photos / "b.png").touch()
    refused(UsageError, "b.jpg and ... b.png", names, tmp_path, photos)
    refused(UsageError, "--name names them alike", names, tmp_path, photos, pattern="{dir}/{light}")
    assert names(tmp_path, photos, pattern="{dir}/{stem}_{ext}_{light}")[1:3] == ["a_png", "b_jpg"]
    assert names(tmp_path, photos / "a.png", photos / "x" / "a.jpg", pattern="{parent}/{stem}") == [
        "photos/a",
        "x/a",
    ]


def test_names_that_only_case_or_unicode_form_tells_apart(tmp_path: Path) -> None:
    for name in ("f/a.jpg", "f/A.tif", "g/A.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert names(tmp_path, tmp_path / "f") == ["A", "a"]
    assert names(tmp_path, tmp_path / "f" / "a.jpg", tmp_path / "g" / "A.jpg") == ["a", "A"]
    for form in ("NFC", "NFD"):
        (tmp_path / unicodedata.normalize(form, "né.png")).touch()
    if len(list(tmp_path.iterdir())) == 2:  # not on every file system
        refused(UsageError, "would both be written", names, tmp_path, tmp_path)


def test_outputs_and_contact_sheets_are_no_inputs(photos: Path, tmp_path: Path) -> None:
    (photos / "out").mkdir()
    (photos / "out" / "b_relit.png").touch()
    names = [item.name for item in collect_items([str(photos)], photos / "out", PHOTO_SUFFIXES)]
    assert not [name for name in names if name.startswith("out")]
    refused(UsageError, "output folder", collect_items, [str(photos)], photos, PHOTO_SUFFIXES)
    (tmp_path / "stacks").mkdir()
    for name in ("a_olat.exr", "a_olat.png", "b_olat.png"):
        (tmp_path / "stacks" / name).touch()
    names = [
        item.name for item in collect_items([str(tmp_path / "stacks")], tmp_path / "out", PHOTO_SUFFIXES)
    ]
    assert names == ["a_olat", "b_olat"]


def pipe(monkeypatch: Patch, content: bytes) -> None:
    """Let standard input hold some bytes; temporary files are not removed before the tests end."""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(content)))


def test_lists_on_stdin_end_in_lines_or_nul(photos: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    pipe(monkeypatch, f"{photos / 'b.jpg'}\n\n{photos / 'x'}\r\n".encode())
    names = [item.name for item in collect_items(["-"], tmp_path / "out", PHOTO_SUFFIXES)]
    assert names == ["b", "a", "c"]
    (photos / "two\r\nlines.png").touch()
    pipe(monkeypatch, f"{photos / 'b.jpg'}\0{photos}/two\r\nlines.png\0".encode())
    items = collect_items(["-"], tmp_path / "out", PHOTO_SUFFIXES, null_separated=True)
    assert [item.name for item in items] == ["b", "two\r\nlines"]
    pipe(monkeypatch, b"\xef\xbb\xbfodd\xff.jpg\n")
    monkeypatch.chdir(photos)
    Path(os.fsdecode(b"odd\xff.jpg")).touch()
    assert list(expand_inputs(["-"])) == [os.fsdecode(b"odd\xff.jpg")]


@pytest.mark.parametrize(
    "start",
    [
        b"\x89PNG\r\n\x1a\n",
        b"MM\0+\0\x08\0\0",
        b"v/1\x01\x02\0\0\0",
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 9\n\2\2\0\x09",
        b"\0\0\0\x18ftypheic\0\0\0\0mif1",
        b"P6\n# by hand\n40 30\n255\n" + b"\xff" * 5000,
        b"P3 4 3 255 9 9 9",
    ],
)
@pytest.mark.parametrize("null_separated", [False, True])
def test_an_image_on_stdin_is_copied(start: bytes, null_separated: bool, monkeypatch: Patch) -> None:
    pipe(monkeypatch, start + bytes(5000))
    (path,) = map(Path, expand_inputs(["-"], null_separated))
    assert path.stem == "stdin" and path.read_bytes() == start + bytes(5000)
    assert path.suffix == (".exr" if start.startswith(b"v/1") else "")


@pytest.mark.parametrize(
    ("content", "null_separated"),
    [
        (b"".join(bytes([n, n + 1, 10]) for n in range(128, 250)), False),
        (b"# Title\n\nSome text\n.\n" + b"- more\n" * 20, False),
        ("a.png\nb.jpg\n".encode("utf-16"), False),
        ("a.png\n.\n".encode("utf-16"), True),
        (b"b.jpg\0Z.EXR\0", False),
    ],
)
def test_what_is_neither_an_image_nor_a_list_costs_a_line(
    photos: Path, content: bytes, null_separated: bool, monkeypatch: Patch, capsys: Said
) -> None:
    monkeypatch.chdir(photos)
    pipe(monkeypatch, content)
    more = ["-0"] if null_separated else []
    assert main([*more, "segment", "-", "-o", str(photos.parent / "out"), "--dry-run"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "standard input is neither an image nor a list" in line and len(line) < 500


def test_a_video_on_stdin_is_no_image(tmp_path: Path, monkeypatch: Patch, capsys: Said) -> None:
    pipe(monkeypatch, b"\0\0\0\x20ftypisom" + bytes(range(256)) * 40)
    assert main(["segment", "-", "-o", str(tmp_path / "out")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("facerf: error: -: ")


def test_what_stdin_may_hold_is_bounded(monkeypatch: Patch) -> None:
    monkeypatch.setattr(inputs_module, "_MOST_LIST_BYTES", 5000)
    monkeypatch.setattr(inputs_module, "_MOST_IMAGE_BYTES", 12000)
    for content, said in ((b"\x89PNG\x1a" + bytes(20000), "more than 1 GiB"), (b".\n" * 2501, "neither")):
        pipe(monkeypatch, content)
        with pytest.raises(UsageError, match=said):
            list(expand_inputs(["-"]))


def test_an_image_on_stdin_is_not_named_by_its_temporary_file(
    tmp_path: Path, monkeypatch: Patch, capsys: Said
) -> None:
    """In any line, in the report, and in what makes a finished result fit; the file goes with the run."""
    temporary, out = tmp_path / "temporary", tmp_path / "out"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    for code, said in ((0, "- -> "), (1, "-: damaged")):
        pipe(monkeypatch, b"\x89PNG\r\n\x1a\n cut short")
        assert main(["segment", "-", "-o", str(out), *["--dry-run"][code:]]) == code
        streams = capsys.readouterr()
        lines = streams.out + streams.err
        assert said in lines and str(temporary) not in lines
    for _ in range(2):
        pipe(monkeypatch, b"\x89PNG\x1a of toys")
        assert toy_batch.run(Path("-"), out) == 0
        assert (tmp_path / "written").read_text() == "stdin\n"
    assert "finished and kept" in capsys.readouterr().err
    rows = rows_of(out).values()
    assert {(row["item"], row["input"]) for row in rows} == {("stdin", "-")}
    pipe(monkeypatch, b"\x89PNG\x1a")
    assert names(tmp_path, Path("-"), pattern="{parent}-{stem}-{ext}") == ["stdin-stdin"]


@pytest.mark.parametrize("unwinds", [True, False])
def test_an_image_on_stdin_goes_with_its_process(tmp_path: Path, unwinds: bool) -> None:
    code = """if True:
        import sys, time
        from facerf_cli.batch.inputs import expand_inputs
        from facerf_cli.run.stopping import end_on_signals
        end_on_signals(0.1)
        print(*expand_inputs(["-"]), flush=True)
        try:
            time.sleep(60)
        except SystemExit:
            if sys.argv[1] == "True":
                raise
            time.sleep(60)
    """
    command = [sys.executable, "-c", code, str(unwinds)]
    settings = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, env=settings, stdin=PIPE, stdout=PIPE) as process:
        assert process.stdin and process.stdout
        process.stdin.write(b"\x89PNG\x1a")
        process.stdin.close()
        assert Path(process.stdout.readline().decode().strip()).read_bytes() == b"\x89PNG\x1a"
        process.terminate()
    assert process.returncode == 143 and not list(tmp_path.iterdir())


def test_frames(tmp_path: Path) -> None:
    frames = [tmp_path / f"plate.{number:04d}.exr" for number in (998, 999, 1000, 1001)]
    for path in frames:
        path.touch()
    for pattern in ("plate.%04d.exr", "plate.####.exr", "plate.0998-1001.exr"):
        assert list(map(Path, expand_inputs([str(tmp_path / pattern)]))) == frames
    for wrong in ("plate.5-4.exr", "plate.1-900000.exr", str(tmp_path / "other.%04d.exr")):
        with pytest.raises(UsageError, match=r"use FIRST-LAST|no such files"):
            list(expand_inputs([wrong]))
    (tmp_path / "2020-2021.jpg").touch()
    assert list(expand_inputs([str(tmp_path / "2020-2021.jpg")])) == [str(tmp_path / "2020-2021.jpg")]


def test_frames_of_several_sequences_stay_apart(tmp_path: Path, monkeypatch: Patch) -> None:
    """As printf and Nuke count: with zeros up to the width, and more digits where the number needs them."""
    monkeypatch.chdir(tmp_path)
    for name in ("a_9999", "a_10000", "a_09997", "a_9998", "ab_0001", "a_0998_b", "a9999", "a#1"):
        Path(f"{name}.png").touch()
    for pattern in ("a_%04d.png", "a_####.png"):
        assert list(expand_inputs([pattern])) == ["a_9998.png", "a_9999.png", "a_10000.png"]
    assert list(expand_inputs(["a_%d.png"])) == ["a_09997.png", "a_9998.png", "a_9999.png", "a_10000.png"]
    assert list(expand_inputs(["a_####_b.png"])) == ["a_0998_b.png"]
    assert list(expand_inputs(["a_*9.png", "a?.png", "a#1.png"])) == ["a_9999.png", "a?.png", "a#1.png"]


@pytest.mark.parametrize(
    ("names", "pattern", "named"),
    [
        ("p.1001 p.1003 p.1005", "p.%04d.png", ()),
        ("p.1001", "p.####.png", ()),
        ("p.0008 p.0009 p.0011", "p.%04d.png", ("p.0009.png", "0010")),
        ("p.9998 p.9999 p.10001", "p.####.png", ("p.9999.png", "10000")),
        ("p.1001 p.1003 p.1007", "p.%d.png", ("p.1003.png", "1005")),
        ("p1_1001_v2 p1_1002_v2 p1_1004_v2", "p1_####_v2.png", ("p1_1002_v2.png", "1003")),
        ("p.1 p.0001 p.2", "p.%d.png", ("p.1.png", "p.0001.png")),
        ("p.1001 p.1003", "p.1001-1003.png", ("p.1002.png",)),
        ("p.1001 p.1002", "p.1001-1003.png", ("p.1003.png",)),
    ],
)
def test_a_missing_frame_is_named(
    tmp_path: Path, monkeypatch: Patch, names: str, pattern: str, named: tuple[str, ...]
) -> None:
    """In a pattern, and in a folder that is a sequence; files that are named themselves may have gaps."""
    monkeypatch.chdir(tmp_path)
    Path("p").mkdir()
    frames = sorted(f"p/{name}.png" for name in names.split())
    for name in ("other.0001", "other.0002", *names.split()):
        Path(f"p/{name}.png").touch()
    batch, options = BatchOptions(output=Path("out")), PhotoOptions(Settings())
    is_range = "-" in pattern
    for inputs, sequence in ((f"p/{pattern}", False), (f"p/{pattern}", True), ("p", True)):
        if named and not (is_range and inputs == "p"):
            words = " ... ".join(named)
            refused(InputError, words, collect_frames, [inputs], ShotOptions(sequence), batch, options)
        else:
            collect_frames([inputs], ShotOptions(sequence), batch, options)
    assert len(collect_frames(frames, ShotOptions(), batch, options)[0]) == len(frames)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["shot_9999", "shot_10000"], {"shot": ["9999", "10000"]}),
        (["shot0001", "shot0002"], {"shot": ["0001", "0002"]}),
        (["0001", "0003", "0005"], {"plates": ["0001", "0003", "0005"]}),
        (["shot.9999", "shot.10000"], {"shot": ["9999", "10000"]}),
        (["shot.01.0001", "shot.02.0001"], {"shot.01": ["0001"], "shot.02": ["0001"]}),
        (["a_0001", "a_0002", "b_0001", "b_0002"], {"a": ["0001", "0002"], "b": ["0001", "0002"]}),
        (["cam1_01", "cam1_02", "cam2_01"], {"cam1": ["01", "02"], "cam2": ["01"]}),
        (["me_v2_1001_beauty", "me_v2_1002_beauty"], {"me_v2_beauty": ["1001", "1002"]}),
        (["me_1001_v02", "me_1002_v02"], {"me_v02": ["1001", "1002"]}),
        (["sub/x 1", "sub/x 2", "x 1"], {"sub/x": ["1", "2"], "x": ["1"]}),
        (["portrait"], {"portrait": [""]}),
    ],
)
def test_images_become_the_frames_of_shots(
    tmp_path: Path, given: list[str], expected: dict[str, list[str]], caplog: Log
) -> None:
    folder, out = tmp_path / "plates", tmp_path / "out"
    for name in given:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.png").touch()
    batch = BatchOptions(output=out)
    items, shots = collect_frames([str(folder)], ShotOptions(sequence=True), batch, PhotoOptions(Settings()))
    found = {
        shot.base.relative_to(out).as_posix(): [
            item.pattern_text(NamePattern.parse("n{frame}", "--name"))[1:] for item in shot.frames
        ]
        for shot in shots
    }
    assert found == expected and len(items) == len(given)
    assert sum("the only frame of its shot" in record.message for record in caplog.records) == sum(
        len(frames) == 1 for frames in expected.values()
    )
    if "plates" in found:
        assert [item.name for item in items] == [f"plates.{name}" for name in given]
    photos, none = collect_frames([str(folder)], ShotOptions(), batch, PhotoOptions(Settings()))
    assert sorted(item.name for item in photos) == sorted(given) and not none


@pytest.mark.parametrize(
    ("names", "hints"),
    [
        ("shot.0009 shot.0010 shot.0011 a.01 a.02 a.03", 1),
        ("shot.0009 shot.0010", 0),
        ("shot.0009 shot.0010 shot.0012", 0),
        ("v2_08_left v2_09_left v2_10_left", 1),
        ("me1 me2 me3", 0),
        ("me99 me100 me101", 0),
    ],
)
def test_numbered_photos_may_be_a_shot(names: str, hints: int, tmp_path: Path, caplog: Log) -> None:
    folder = tmp_path / "plates"
    folder.mkdir()
    for name in names.split():
        (folder / f"{name}.png").touch()
    caplog.set_level(logging.INFO)
    for sequence in (False, True):
        batch = BatchOptions(output=tmp_path / "out")
        with suppress(InputError):  # for the frame that a sequence lacks
            collect_frames([str(folder)], ShotOptions(sequence), batch, PhotoOptions(Settings()))
        assert sum("add --sequence if" in record.message for record in caplog.records) == hints


def test_sequences_meet_by_the_names_of_their_images(tmp_path: Path) -> None:
    for name in ("shot_0001", "shot0001"):
        (tmp_path / f"{name}.png").touch()
    both = "shot0001.png and ... shot_0001.png"
    refused(UsageError, both, collect_items, [str(tmp_path)], tmp_path / "out", sequence=True)
    for folder in ("plates/a", "roto/a"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "shot_0001.png").touch()
    (item,) = collect_items([str(tmp_path / "plates")], tmp_path / "out", sequence=True)
    assert item.name == "a/shot.0001"
    assert companion(item, tmp_path / "roto", "--person") == tmp_path / "roto/a/shot_0001.png"


def test_patterns_and_frame_numbers_of_names(tmp_path: Path) -> None:
    def path(text: str, **fields: str) -> str:
        item = Item(
            Path("d/in/me.0007.PNG"), tmp_path / "in" / "me.0007", "in/me.0007", Path("in/me.0007.PNG")
        )
        return item.filled(NamePattern.parse(text, "--name"), **fields).relative_to(tmp_path).as_posix()

    assert path("{dir}/{stem}_{light}.{frame:04}", light="sky") == "in/me_sky.0007"
    assert path("{dir}/{stem}_{light}.{frame:04}", light="sky", frame="0012") == "in/me_sky.0012"
    assert path("{light}/{stem}.{ext}", light="sky", tag="_face0") == "sky/me_face0.png"
    assert path("{stem}_{light}-x") == "me-x"
    wrong = (
        "{x}",
        "{stem.__class__}",
        "{stem!r}",
        "{stem:>9}",
        "{",
        "../{stem}",
        "/{stem}",
        "{frame:99}",
        "",
    )
    for text in wrong:
        refused(UsageError, "--name", NamePattern.parse, text, "--name")
    assert split_frame("sky.0012") == ("sky", ".0012")
    assert split_frame("v2.final") == ("v2.final", "")
    assert split_frame("a\nb.01") == ("a\nb", ".01")


VERBS = {
    "predict-olat": "_olat.exr",
    "fit-geometry": "_mesh.glb",
    "estimate-light": "_light.exr",
    "segment": "_segment.exr",
}


@pytest.fixture
def plates(tmp_path: Path) -> Path:
    folder = tmp_path / "plates"
    (folder / "a").mkdir(parents=True)
    for name in ("a/me.jpg", "a/me.png", "shot.0007.png"):
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(folder / name)
    return folder


@pytest.mark.parametrize("verb", VERBS)
def test_outputs_have_the_given_names(verb: str, plates: Path, capsys: Said) -> None:
    line = [verb, str(plates), "-o", str(plates.parent / "out"), "--dry-run"]
    assert main([*line, "--name", "{parent}/{stem}_{ext}_{frame:06}"]) == 0
    said = capsys.readouterr().out
    for name in ("a/me_jpg", "a/me_png", "plates/shot_png_000007"):
        assert f" -> {plates.parent / 'out' / name}{VERBS[verb]}\n" in said
    assert main([*line, "--name", "{dir}/{stem}"]) == 2
    assert "--name names them alike; use more fields" in capsys.readouterr().err
    assert main([*line, "--name", "{stem}_{light}"]) == 2
    assert "unknown field {light}" in capsys.readouterr().err
    assert main([*line, "--name", "../{stem}"]) == 2


@pytest.mark.parametrize("forms", [("NFC", "NFD"), ("NFD", "NFC")])
def test_names_of_companions_are_one_in_both_forms_of_unicode(tmp_path: Path, forms: tuple[str, str]) -> None:
    """A Mac's archive has NFD where most keyboards type NFC."""
    photo, other = (unicodedata.normalize(form, "été/José") for form in forms)
    item = Item(tmp_path / f"photos/{photo}.jpg", tmp_path / f"out/{photo}", photo)
    mattes, name = tmp_path / "mattes", unicodedata.normalize(forms[1], "José")
    for file in (f"{other}.tif", f"{name}.pts", f"x/{name}_matte.png"):
        (mattes / file).parent.mkdir(parents=True, exist_ok=True)
        (mattes / file).touch()
    found = [
        (mattes, "--person", f"{other}.tif"),
        (mattes, "--landmarks", f"{name}.pts"),
        (mattes / "x/{stem}_matte.png", "--matte", f"x/{name}_matte.png"),
    ]
    for given, option, file in found:
        assert companion(item, given, option).samefile(mattes / file)


def test_a_missing_companion_is_said_with_the_files_that_serve(tmp_path: Path) -> None:
    item = Item(Path("a/me.0001.jpg"), Path("out/me.0001"), "me.0001")
    with pytest.raises(InputError) as error:
        companion(item, tmp_path, "--landmarks")
    missing = f"{tmp_path}/me.0001 with one of the suffixes .json .pts"
    assert str(error.value) == f"a/me.0001.jpg: --landmarks has no {missing}; add it there"
    refused(InputError, "--person has no ... /me.0001 with ... .bmp", companion, item, tmp_path, "--person")
    refused(InputError, "mattes/me.png; add it there", companion, item, Path("mattes/{stem}.png"), "--person")


@pytest.fixture
def item(tmp_path: Path) -> Item:
    return Item(
        tmp_path / "in" / "x" / "me.jpg", tmp_path / "out" / "x" / "me", "x/me", PurePosixPath("x/me.jpg")
    )


def touched(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def test_a_file_a_folder_and_a_pattern_are_companions(item: Item, tmp_path: Path) -> None:
    assert companion(item, tmp_path / "all.pts", "--landmarks") == tmp_path / "all.pts"
    flat = touched(tmp_path / "points" / "me.json")
    assert companion(item, tmp_path / "points", "--landmarks") == flat
    mirrored = touched(tmp_path / "points" / "x" / "me.pts")
    assert companion(item, tmp_path / "points", "--landmarks") == mirrored
    there = touched(tmp_path / "mattes" / "x" / "me_matte.png")
    pattern = tmp_path / "mattes" / "{dir}" / "{stem}_matte.png"
    assert companion(item, pattern, "--matte") == there
    there.unlink()
    refused(InputError, "me_matte.png; add it there", companion, item, pattern, "--matte")


def test_what_does_not_exist_is_refused_before_the_first_photo(tmp_path: Path) -> None:
    check_companion(None, "--matte")
    check_companion(tmp_path / "{stem}.png", "--matte")
    for wrong in (tmp_path / "none.png", tmp_path / "{light}.png"):
        refused(UsageError, "--matte", check_companion, wrong, "--matte")
