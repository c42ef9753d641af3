"""The contract of every verb that walks folders (docs/design.md), with a verb that only copies bytes."""

import os
import shutil
import signal
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Never

import pytest

from facerf_cli.batch import journal
from facerf_cli.batch.inputs import Item
from facerf_cli.batch.recipe import DigestOf, Recipe, recipe_of, require_same
from facerf_cli.batch.run import Outcome
from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.output_options import OutputOptions
from facerf_cli.files.texts import file_sha256
from facerf_cli.work.photo_options import PhotoOptions
from tests.batch.toy_batch import Copy, run, run_job, started
from tests.folders import rows
from tests.kinds import Patch, Said
from tests.processes import wait_until
from tests.refusals import refused


def test_nothing_to_work_on_and_an_output_folder_that_cannot_be(tmp_path: Path, photos: Path) -> None:
    (tmp_path / "empty").mkdir()
    refused(UsageError, "no inputs found", run, [tmp_path / "empty"], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(UsageError, match=f"-o {folder}: cannot be written to .*; use another"):
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
    assert run([photos / "b.jpg"], out) == 1
    assert run([photos / "a.png"], out) == 0 and rows(out)["b"]["status"] == "failed"  # as with xargs
    assert run([photos], out) == 1
    before = rows(out)
    (photos / "b.jpg").write_bytes(b"good")
    assert run([photos], out, report=True) == 0
    assert rows(out)["x/c"] == before["x/c"] and rows(out)["b"]["status"] == "done"
    assert rows(out, "report.jsonl") == rows(out)


def test_dry_run_writes_nothing(photos: Path, tmp_path: Path, capsys: Said) -> None:
    assert run([photos / "b.jpg"], tmp_path / "out", dry_run=True) == 0
    assert capsys.readouterr().out == f"{photos / 'b.jpg'} -> {tmp_path / 'out' / 'b_copy.bin'}\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_of_the_whole_run_ends_it(photos: Path, tmp_path: Path, jobs: int) -> None:
    (photos / "Z.EXR").write_bytes(b"stop")
    refused(FacerfError, "checkpoint", run, [photos], tmp_path / "out", jobs=jobs)


def test_old_reports_keep_the_rows_of_other_verbs_and_lose_half_lines(photos: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    other = '{"verb": "other", "item": "elsewhere", "status": "done"}'
    (out / "report.jsonl").write_text(other + '\n{"verb": "copy", "it')
    assert run([photos], out, report=True) == run([photos], out, report=True) == 0
    report = rows(out, "report.jsonl")
    assert len(report) == 6 and "elsewhere" in report


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_leaves_only_whole_files(photos: Path, tmp_path: Path, jobs: int) -> None:
    (photos / "Z.EXR").write_bytes(b"wait")
    out = tmp_path / "out"
    process = started(photos, out, jobs, start_new_session=True)
    wait_until((tmp_path / "victim").exists, process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    process.communicate()
    assert process.returncode != 0
    left = {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert left.pop(".facerf.jsonl") is not None and "Z_copy.bin" not in left
    assert set(left.values()) <= {b"a.png", b"b.jpg", b"x/a.jpg", b"x/c.png"}


@pytest.fixture
def two(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    for name in ("a", "b"):
        (tmp_path / "photos" / f"{name}.png").write_bytes(name.encode())
    return tmp_path / "photos"


def made(capsys: Said) -> list[str]:
    return [Path(line).name[0] for line in capsys.readouterr().out.splitlines()]


def test_another_photo_of_a_name_is_processed_and_the_same_from_elsewhere_is_not(
    two: Path, tmp_path: Path, capsys: Said
) -> None:
    run([two], tmp_path / "out")
    (two / "a.png").write_bytes(b"z")  # as long as before
    os.utime(two / "b.png", ns=(1, 1))  # touched, and the same
    capsys.readouterr()
    assert run([two], tmp_path / "out") == 0
    said = capsys.readouterr()
    assert said.out.split() == [str(tmp_path / "out" / "a_copy.bin")]
    assert "1 item out of date: input changed" in said.err
    assert (tmp_path / "out" / "a_copy.bin").read_bytes() == b"z"
    run([two], tmp_path / "out")
    two.rename(tmp_path / "moved")
    capsys.readouterr()
    run([tmp_path / "moved"], tmp_path / "out")
    assert made(capsys) == []


def test_another_photo_of_the_same_size_and_time_is_processed(
    two: Path, tmp_path: Path, capsys: Said
) -> None:
    run([two], tmp_path / "out")
    before = (two / "a.png").stat()
    (two / "a.png").write_bytes(b"z")
    os.utime(two / "a.png", ns=(before.st_atime_ns, before.st_mtime_ns))
    capsys.readouterr()
    run([two], tmp_path / "out")
    assert made(capsys) == ["a"]


def test_other_options_make_all_again(two: Path, tmp_path: Path, capsys: Said) -> None:
    run([two], tmp_path / "out", recipe={"lights": 150})
    (two / "a.png").write_bytes(b"A")
    capsys.readouterr()
    run([two], tmp_path / "out", recipe={"lights": 150}, dry_run=True)
    said = capsys.readouterr()
    assert [Path(line).name for line in said.out.splitlines()] == ["a_copy.bin"]
    assert "1 of 2 results are finished" in said.err and "1 result would be made" in said.err
    run([two], tmp_path / "out", recipe={"lights": 200})
    assert "2 items out of date: options changed" in capsys.readouterr().err


def test_results_of_a_relative_folder_are_recognised(two: Path, monkeypatch: Patch, capsys: Said) -> None:
    monkeypatch.chdir(two.parent)
    run([Path("photos")], Path("out"))
    capsys.readouterr()
    assert run([Path("photos")], Path("out")) == 0 and made(capsys) == []
    assert run([two], two.parent / "out") == 0 and made(capsys) == []


@pytest.mark.parametrize(("overwrite", "expected"), [("never", ""), ("changed", "a"), ("always", "ab")])
def test_overwrite(two: Path, tmp_path: Path, capsys: Said, overwrite: str, expected: str) -> None:
    run([two], tmp_path / "out")
    (two / "a.png").write_bytes(b"new")
    capsys.readouterr()
    run([two], tmp_path / "out", overwrite=overwrite)
    assert "".join(made(capsys)) == expected


@pytest.mark.parametrize("edited", [True, False])
def test_a_file_of_the_user_fails_its_item_only(
    two: Path, tmp_path: Path, capsys: Said, edited: bool
) -> None:
    """As a retouched result, or a file that facerf never wrote, which other options would replace."""
    out = tmp_path / "out"
    if edited:
        run([two], out, recipe={"lights": 1})
    out.mkdir(exist_ok=True)
    mine = out / "a_copy.bin"
    mine.write_bytes(b"mine")
    for dry_run in (True, False):
        capsys.readouterr()
        assert run([two], out, recipe={"lights": 2}, dry_run=dry_run) == 1
        said = capsys.readouterr()
        assert said.err.count(f"error: {mine}: was ") == 1 and "--overwrite always" in said.err
        assert "b_copy.bin" in said.out and "a_copy.bin" not in said.out
    assert mine.read_bytes() == b"mine" and rows(out)["a"]["status"] == "failed"
    assert run([two], out, recipe={"lights": 2}, overwrite="never") == 0 and mine.read_bytes() == b"mine"
    assert run([two], out, recipe={"lights": 2}, overwrite="always") == 0 and mine.read_bytes() == b"a"


def test_copies_are_recognised_by_their_content_with_the_index_and_not_without(
    two: Path, tmp_path: Path, capsys: Said
) -> None:
    run([two], tmp_path / "out")
    for name in ("copied", "bare"):
        shutil.copytree(tmp_path / "out", tmp_path / name)
        for path in (tmp_path / name).glob("*.bin"):
            os.utime(path, (1, 1))
    (tmp_path / "bare/.facerf.jsonl").unlink()
    capsys.readouterr()
    assert run([two], tmp_path / "copied", recipe={"lights": 2}) == 0 and made(capsys) == ["a", "b"]
    (tmp_path / "bare/a_copy.bin").write_bytes(b"")  # holds nothing that could be lost
    assert run([two], tmp_path / "bare") == 1 and made(capsys) == ["a"]


def test_a_file_beside_the_outputs_follows_the_same_rule(two: Path, tmp_path: Path, capsys: Said) -> None:
    """As those of further faces, of which no run knows before it has looked at the photo."""
    out, beside = tmp_path / "out", tmp_path / "out/a_face1.bin"

    @dataclass(frozen=True)
    class Several(Copy):
        def __call__(self, item: Item) -> Outcome:
            for ending in ("_face1.bin", "_copy.bin"):
                with atomic_path(item.output(ending)) as temporary:
                    temporary.write_bytes(str(self.recipe).encode())
            return Outcome([item.output("_copy.bin"), item.output("_face1.bin")])

    def call(number: int, **options: object) -> int:
        return run_job(Several(out, {"lights": number}), two / "a.png", out, **options)

    assert call(1) == call(2) == 0 and beside.read_bytes() == b"{'lights': 2}"
    beside.write_bytes(b"mine")
    assert call(3) == 1 and beside.read_bytes() == b"mine"
    assert f"{beside}: was " in capsys.readouterr().err
    (out / "a_copy.bin").unlink()
    assert call(2, overwrite="never") == 0 and beside.read_bytes() == b"mine"
    assert capsys.readouterr().out.split() == [str(out / "a_copy.bin")]
    assert call(3) == 1 and beside.read_bytes() == b"mine", "a file that was left is not facerf's"


def test_outputs_of_a_run_that_was_killed_are_facerfs(tmp_path: Path) -> None:
    """The process ends after an output has its name, before the run has noted the item."""
    (tmp_path / "a.png").write_bytes(b"late")
    process = started(tmp_path / "a.png", tmp_path / "out")
    assert process.communicate() and process.returncode == -signal.SIGKILL
    assert (tmp_path / "out/a_copy.bin").read_bytes() == b"late"
    assert run([tmp_path / "a.png"], tmp_path / "out") == 0
    assert rows(tmp_path / "out")["a"]["status"] == "done"
    assert [path.name for path in (tmp_path / "out").glob(".facerf*")] == [".facerf.jsonl"]


def test_outputs_of_a_worker_that_died_are_facerfs(two: Path, tmp_path: Path, capsys: Said) -> None:
    (two / "a.png").write_bytes(b"late")
    assert run([two], tmp_path / "out", jobs=2) == 1 and "process died" in capsys.readouterr().err
    assert (tmp_path / "out/a_copy.bin").read_bytes() == b"late"
    for number in range(3):  # rows of items without an end are not multiplied
        assert run([two], tmp_path / "out", recipe={"lights": number}, overwrite="never") == 0
    assert (tmp_path / "out/.facerf.jsonl").read_text().count('"output": "a_copy.bin"') == 1
    assert run([two], tmp_path / "out") == 0


def test_a_run_with_other_options_that_was_ended_leaves_nothing_finished(two: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"

    @dataclass(frozen=True)
    class Said(Copy):
        def __call__(self, item: Item) -> Outcome:
            with atomic_path(item.output("_copy.bin")) as temporary:
                temporary.write_bytes(str(self.recipe).encode())
            if self.recipe == {"lights": 2}:
                raise KeyboardInterrupt
            return Outcome([item.output("_copy.bin")])

    def call(number: int) -> int:
        return run_job(Said(out, {"lights": number}), two / "a.png", out)

    assert call(1) == 0
    with pytest.raises(KeyboardInterrupt):
        call(2)
    assert (out / "a_copy.bin").read_bytes() == b"{'lights': 2}"
    assert call(1) == 0 and (out / "a_copy.bin").read_bytes() == b"{'lights': 1}"


def test_a_result_that_is_edited_while_its_item_runs_is_the_users(two: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"

    @dataclass(frozen=True)
    class Slow(Copy):
        def __call__(self, item: Item) -> Outcome:
            with atomic_path(item.output("_copy.bin")) as temporary:
                temporary.write_bytes(b"made")
            if self.recipe == {"lights": 1}:
                item.output("_copy.bin").write_bytes(b"mine")
            return Outcome([item.output("_copy.bin")])

    def call(number: int) -> int:
        return run_job(Slow(out, {"lights": number}), two / "a.png", out)

    assert call(1) == 0 and call(2) == 1
    assert (out / "a_copy.bin").read_bytes() == b"mine"


def test_a_report_of_another_program_stays(two: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/report.jsonl").write_text('{"test": "passed"}\n')
    line = ([two], tmp_path / "out")
    refused(UsageError, "report.jsonl: was not written by facerf", run, *line, report=True)
    assert (tmp_path / "out/report.jsonl").read_text() == '{"test": "passed"}\n'


@pytest.mark.parametrize("ignores", [True, False])
def test_outputs_that_differ_only_in_case(tmp_path: Path, ignores: bool) -> None:
    for name in ("Me", "me"):
        (tmp_path / f"{name}.png").write_bytes(name.encode())
    photos, out = [tmp_path / "Me.png", tmp_path / "me.png"], tmp_path / "out"
    if ignores:  # there the lock also has this name
        out.mkdir()
        (out / ".FACERF-LOCK").touch()
        refused(UsageError, "ignores case", run, photos, out)
        assert not list(out.glob("*.bin"))
    else:
        assert run(photos, out) == 0


def test_only_stale_outputs_are_made(two: Path, tmp_path: Path, capsys: Said) -> None:
    """As when a light is added: what was made, and then changed by hand, stays."""
    out, lights = tmp_path / "out", ["a"]

    class Lit(Copy):
        def outputs_of(self, item: Item) -> list[Path]:
            return [item.output(f"_{light}.bin") for light in lights]

        def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
            return [{"light": light} for light in lights]

        def __call__(self, item: Item) -> Outcome:
            for path in self.outputs_of(item):
                with atomic_path(path) as temporary:
                    temporary.write_bytes(b"made")
            return Outcome(self.outputs_of(item))

    assert run_job(Lit(out), two, out) == 0
    (out / "a_a.bin").write_bytes(b"retouched")
    lights.append("b")
    capsys.readouterr()
    assert run_job(Lit(out), two, out) == 0
    said = capsys.readouterr()
    assert [Path(line).name for line in said.out.split()] == ["a_b.bin", "b_b.bin"]
    assert "out of date" not in said.err
    assert (out / "a_a.bin").read_bytes() == b"retouched"
    (out / "b_a.bin").unlink()
    assert run_job(Lit(out), two, out) == 0
    assert "1 item out of date: missing or empty" in capsys.readouterr().err


def test_a_finished_folder_is_read_without_writing_or_reading_much(
    two: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    run([two], tmp_path / "out")
    read: list[Path] = []
    monkeypatch.setattr(journal, "file_sha256", lambda path: read.append(path) or file_sha256(path))
    run([two], tmp_path / "out")
    assert read == []
    # So that a rerun of thousands of items is quick; a file whose time changed is noted.
    run([two], tmp_path / "out")
    index = tmp_path / "out/.facerf.jsonl"
    inode = index.stat().st_ino
    run([two], tmp_path / "out")
    assert index.stat().st_ino == inode
    os.utime(next(two.glob("*")), (1, 1))
    run([two], tmp_path / "out")
    assert index.stat().st_ino != inode and "1000000000" in index.read_text()


def test_damaged_rows_are_passed_over(two: Path, tmp_path: Path, capsys: Said) -> None:
    run([two], tmp_path / "out")
    index = tmp_path / "out/.facerf.jsonl"
    index.write_text('5\n{"output": 3}\n{"of": {}}\n{"sha256"' + "\n" + index.read_text() + '{"outp')
    capsys.readouterr()
    assert run([two], tmp_path / "out") == 0
    assert made(capsys) == []


def test_a_finished_folder_loads_nothing_for_its_work(two: Path, tmp_path: Path) -> None:
    class Lazy(Copy):
        @property
        def process(self) -> Never:
            raise AssertionError("torch is imported here")

    assert run([two], tmp_path / "out") == 0
    assert run_job(Lazy(tmp_path), two, tmp_path / "out") == 0


@dataclass(frozen=True)
class Inner:
    matte: Path
    jobs: int = field(default=1, metadata=NOT_IN_RECIPE)


@dataclass(frozen=True)
class Outer:
    inner: Inner
    lights: str
    checkpoints: tuple[Path, ...] = ()


def test_recipes_hold_the_content_of_files_folders_and_patterns(tmp_path: Path) -> None:
    (tmp_path / "one").write_bytes(b"1")
    (tmp_path / "two").write_bytes(b"1")
    one = recipe_of(Outer(Inner(tmp_path / "one"), "150"), file_sha256)
    assert recipe_of(Outer(Inner(tmp_path / "two", jobs=8), "150"), file_sha256) == one
    (tmp_path / "two").write_bytes(b"2")
    other = recipe_of(Outer(Inner(tmp_path / "two"), str(tmp_path / "one")), file_sha256)
    refused(UsageError, "run: other lights, matte; advice", require_same, one, other, "run", "advice")
    assert len(one["checkpoint"]) > 32  # the networks that facerf ships
    (tmp_path / "mattes").mkdir()
    (tmp_path / "mattes" / "a.png").write_bytes(b"1")
    given = [tmp_path / "mattes", tmp_path / "mattes" / "{stem}.png"]
    before = [recipe_of(Inner(path), file_sha256)["matte"] for path in given]
    (tmp_path / "mattes" / "a.png").write_bytes(b"2")
    assert all(
        recipe_of(Inner(path), file_sha256)["matte"] != old for path, old in zip(given, before, strict=True)
    )
    both = {field.name for part in (PhotoOptions, OutputOptions) for field in fields(part)}
    assert len(both) == len(fields(PhotoOptions)) + len(fields(OutputOptions))  # one would hide the other
