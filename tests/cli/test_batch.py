"""The contract of every verb that walks folders (docs/design.md), with a verb that only copies bytes."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from facerf_cli.errors import FacerfError, UsageError
from tests.cli.folders import rows
from tests.cli.toy_batch import run
from tests.kinds import Said
from tests.processes import wait_until


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    for name in ("b.jpg", "a.png", "x/a.jpg", "x/c.png", "x/note.txt", ".hidden/c.jpg", "x/.d.jpg", "Z.EXR"):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return folder


def test_a_name_that_is_not_utf8_is_in_the_report(tmp_path: Path) -> None:
    photo = tmp_path / os.fsdecode(b"a\xff.png")
    photo.write_bytes(b"bad")
    (tmp_path / "b.png").write_bytes(b"good")
    assert run([photo, tmp_path / "b.png"], tmp_path / "out") == 1
    assert rows(tmp_path / "out")["a\udcff"]["status"] == "failed"


def test_nothing_to_work_on_and_an_output_folder_that_cannot_be(tmp_path: Path, photos: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="no inputs found"):
        run([tmp_path / "empty"], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(UsageError, match=f"-o {folder}: cannot be written to .*; give another"):
            run([photos], folder)


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_bad_item_does_not_harm_the_others(photos: Path, tmp_path: Path, capsys: Said, jobs: int) -> None:
    (photos / "b.jpg").write_bytes(b"bad")
    (photos / "Z.EXR").write_bytes(b"bug")
    out = tmp_path / "out"
    assert run([photos, photos / "gone.jpg"], out, jobs=jobs) == 1
    streams = capsys.readouterr()
    assert [Path(line).name for line in streams.out.splitlines()] == [
        "a_copy.bin",
        "a_copy.bin",
        "c_copy.bin",
    ]
    assert f"facerf: error: {photos / 'b.jpg'}: is bad; try another\n" in streams.err
    assert "gone.jpg: no such file" in streams.err and "unexpected RuntimeError: a bug" in streams.err
    assert "Traceback" not in streams.err
    report = rows(out)
    assert {name: row["status"] for name, row in report.items()} == {
        "Z": "failed", "a": "done", "b": "failed", "gone": "failed", "x/a": "done", "x/c": "done",
    }  # fmt: skip
    assert report["a"]["bytes"] == 5 and report["a"]["ratio"] is None and report["a"]["error"] is None
    assert (out / report["x/c"]["outputs"][0]).read_bytes() == b"x/c.png"


def test_finished_items_are_skipped_and_keep_their_row(photos: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (photos / "b.jpg").write_bytes(b"bad")
    assert run([photos], out) == 1
    before = rows(out)
    (photos / "b.jpg").write_bytes(b"good")
    assert run([photos], out) == 0
    assert rows(out)["x/c"] == before["x/c"] and rows(out)["b"]["status"] == "done"
    assert len((out / "report.jsonl").read_text().splitlines()) == 5  # the older row of b is gone
    (out / "report.jsonl").unlink()
    assert run([photos], out) == 0
    assert [row["status"] for row in rows(out).values()] == ["skipped"] * 5
    (out / "a_copy.bin").write_bytes(b"mine!")
    assert run([photos], out) == 0
    assert (out / "a_copy.bin").read_bytes() == b"mine!"
    assert run([photos], out, overwrite="always") == 0
    assert (out / "a_copy.bin").read_bytes() == b"a.png"


def test_dry_run_writes_nothing(photos: Path, tmp_path: Path, capsys: Said) -> None:
    assert run([photos / "b.jpg"], tmp_path / "out", dry_run=True) == 0
    assert capsys.readouterr().out == f"{photos / 'b.jpg'} -> {tmp_path / 'out' / 'b_copy.bin'}\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_of_the_whole_run_ends_it(photos: Path, tmp_path: Path, jobs: int) -> None:
    (photos / "Z.EXR").write_bytes(b"stop")
    with pytest.raises(FacerfError, match="checkpoint"):
        run([photos], tmp_path / "out", jobs=jobs)


def test_a_worker_that_dies_is_reported(photos: Path, tmp_path: Path, capsys: Said) -> None:
    (photos / "Z.EXR").write_bytes(b"die")
    assert run([photos], tmp_path / "out", jobs=2) == 1
    assert "Z.EXR: its process died" in capsys.readouterr().err


def test_old_reports_keep_the_rows_of_other_verbs_and_lose_half_lines(photos: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "report.jsonl").write_text('{"verb": "other", "item": "elsewhere"}\n')
    run([photos], out)
    with (out / "report.jsonl").open("a") as stream:
        stream.write('{"verb": "copy", "it')
    assert run([photos], out) == 0
    assert len(rows(out)) == 6 and "elsewhere" in rows(out)


ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
SLOW_VERB = """
import sys, time
from pathlib import Path
from facerf_cli.batch.inputs import collect_items
from facerf_cli.batch.run import BatchOptions, run_items
from facerf_cli.batch.run import Outcome
from facerf_cli.batch.settings import Settings
from facerf_cli.batch.made_from import Recipe
from facerf_cli.files.atomic import atomic_path

def outputs_of(item):
    return [item.output(".bin")]

def slow(item):
    with atomic_path(outputs_of(item)[0]) as temporary:
        temporary.write_bytes(b"half")
        Path(sys.argv[2], "started").touch()
        time.sleep(60)
        temporary.write_bytes(b"whole")
    return Outcome(outputs_of(item))

if __name__ == "__main__":
    options = BatchOptions(Path(sys.argv[2]), jobs=int(sys.argv[3]))
    items = collect_items([sys.argv[1]], Path(sys.argv[2]))
    run_items("slow", items, slow, outputs_of, options, Settings(), lambda digest_of: [{}])
"""


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_leaves_only_whole_files(photos: Path, tmp_path: Path, jobs: int) -> None:
    (tmp_path / "slow_verb.py").write_text(SLOW_VERB)
    out = tmp_path / "out"
    command = [sys.executable, str(tmp_path / "slow_verb.py"), str(photos), str(out), str(jobs)]
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL, env=ENVIRONMENT)
    wait_until((out / "started").exists, process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    process.wait()
    assert process.returncode != 0
    left = sorted(path.name for path in out.rglob("*") if path.is_file())
    assert left == [".facerf-index.jsonl", "report.jsonl", "started"]
