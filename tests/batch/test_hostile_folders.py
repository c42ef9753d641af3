"""Names, pipes, links and other processes in the folders of a verb."""

import json
import os
import sys
from pathlib import Path

import pytest

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, NamePattern, collect_items
from facerf_cli.batch.run import _exist, print_path
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import load_fit
from facerf_cli.face.landmarks import read_landmarks
from facerf_cli.files.olat_stack import is_olat_stack
from facerf_cli.files.read import decode, read_array
from facerf_cli.files.texts import is_regular, read_light_list, read_toml, require_regular
from facerf_cli.run.logs import json_line, printable_line
from tests.batch.toy_batch import run, started
from tests.folders import rows
from tests.kinds import Patch, Said
from tests.refusals import refused
from tests.stacks import read_olat_stack

HOSTILE = (
    "two\nlines",
    "\x1b[31mred",
    "line\u2028separator",
    "\x85next",
    "turned\u202etxt",
    "\x7fdel",
    "ba\udcffd",
)


def photos_of(folder: Path, *names: str) -> Path:
    folder.mkdir()
    for name in names:
        (folder / f"{name}.png").write_bytes(name.encode("utf-8", "surrogateescape"))
    return folder


def test_names_of_all_characters_have_a_row_an_output_and_a_pattern_each(tmp_path: Path) -> None:
    photos = photos_of(tmp_path / "in", *HOSTILE)
    assert run(photos, tmp_path / "out", report=True) == 0
    text = (tmp_path / "out" / "report.jsonl").read_text()
    assert all(line.isprintable() for line in text.split("\n")) and len(text.splitlines()) == len(HOSTILE)
    assert rows(tmp_path / "out").keys() == set(HOSTILE)
    assert run(photos, tmp_path / "out") == 0 and len(rows(tmp_path / "out")) == len(HOSTILE)
    photos = photos_of(tmp_path / "numbered", "two\nlines.0007")
    pattern = NamePattern.parse("{stem}_{frame}", "--name")
    (item,) = collect_items([str(photos)], tmp_path / "out", PHOTO_SUFFIXES, pattern)
    assert item.name == "two\nlines_0007"


def test_messages_and_names_are_printable_on_a_terminal(monkeypatch: Patch, capsys: Said) -> None:
    for name in HOSTILE:
        assert printable_line(f"{name}: is bad").isprintable() and "is bad" in printable_line(
            f"{name}: is bad"
        )
    assert printable_line("\x1b[31m\u2028x") == "\\x1b[31m x" and len(printable_line("x" * 10**6)) <= 2000
    assert json.loads(json_line({"name": "\x7f\u2028\U0001f642\U000e0001"})) == {
        "name": "\x7f\u2028\U0001f642\U000e0001"
    }
    print_path("\x1b[31m")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    print_path("\x1b[31m")
    assert capsys.readouterr().out == "\x1b[31m\n\\x1b[31m\n"


OPENERS = {
    "an image": lambda path: decode(path, 1000),
    "a stack": read_olat_stack,
    "landmarks": read_landmarks,
    "a list of lights": read_light_list,
    "TOML": lambda path: read_toml(path, ""),
    "a fit": load_fit,
    "an array": read_array,
}


@pytest.mark.parametrize("kind", OPENERS)
def test_a_pipe_is_refused_not_waited_for(kind: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.json")
    with pytest.raises(InputError, match="is a pipe or a device"):
        OPENERS[kind](tmp_path / "a.json")
    assert not is_olat_stack(tmp_path / "a.json") and not is_regular(tmp_path / "a.json")


def test_a_pipe_in_a_folder_costs_its_own_item(tmp_path: Path) -> None:
    photos = photos_of(tmp_path / "in", "a", "c")
    os.mkfifo(photos / "b.png")
    assert run(photos, tmp_path / "out") == 1
    assert {name: row["status"] for name, row in rows(tmp_path / "out").items()} == {
        "a": "done",
        "b": "failed",
        "c": "done",
    }


def test_an_output_folder_that_is_a_link_in_a_circle_is_refused(tmp_path: Path) -> None:
    photos = photos_of(tmp_path / "in", "a")
    (tmp_path / "out").symlink_to(tmp_path / "out")
    refused(UsageError, f"-o {tmp_path / 'out'}: cannot be written to", run, photos, tmp_path / "out")


def test_two_processes_in_a_folder_share_its_report(tmp_path: Path) -> None:
    photos = photos_of(tmp_path / "in", *map(str, range(20)))
    both = [started(photos, tmp_path / "out") for _ in range(2)]
    assert [process.communicate() and process.returncode for process in both] == [0, 0]
    assert sorted(map(int, rows(tmp_path / "out"))) == list(range(20))
    assert len((tmp_path / "written").read_text().split()) == 20  # each once


def test_an_empty_file_is_not_finished_and_links_in_a_circle_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    (tmp_path / "b").write_text("x")
    os.mkfifo(tmp_path / "c")
    assert [_exist([tmp_path / name]) for name in ("a", "b", "c")] == [False, True, False]
    assert _exist([tmp_path]) and not _exist([])
    (tmp_path / "a.png").symlink_to(tmp_path / "a.png")
    for path in (tmp_path / "a.png", tmp_path / ("n" * 300), tmp_path / "a\0b", tmp_path):
        with pytest.raises(InputError):
            require_regular(path)
        assert not is_regular(path)
    assert run(tmp_path / "a.png", tmp_path / "out") == 1


def test_a_worker_that_is_killed_leaves_no_temporary_file(tmp_path: Path) -> None:
    photos = photos_of(tmp_path / "in", "a", "b", "c")
    (photos / "b.png").write_bytes(b"fall")
    assert run(photos, tmp_path / "out", jobs=2) == 1
    assert not list((tmp_path / "out").rglob(".*part-*"))
    assert {name for name, row in rows(tmp_path / "out").items() if row["status"] == "done"} == {"a", "c"}
