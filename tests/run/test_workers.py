"""Processes that work for `--jobs`: what one that dies costs, what they say, and how they end."""

import ctypes
import logging
import os
import signal
import time
from collections.abc import Generator
from pathlib import Path

import pytest
from OpenImageIO import ImageSpec

from facerf_cli.errors import FacerfError
from facerf_cli.run.logs import LOGGER_NAME, configure_logging
from facerf_cli.run.workers import Workers, in_shards, spread
from tests.refusals import refused


def work(item: str) -> str:
    logging.getLogger(LOGGER_NAME).warning("at %s", item)
    if item == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if item == "raise":
        raise ValueError(item)
    if item == "library":
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(ImageSpec()))  # reported where the interpreter ends
    if item.startswith("slow"):
        time.sleep(0.5)
    if item.startswith("/"):
        try:
            Path(item).touch()
            time.sleep(60)
        finally:
            Path(item).unlink()
    return item.upper()


def broken(item: str, error: Exception) -> str:
    return f"{item}: {error}"


def run(*items: str, jobs: int = 2) -> Generator[str]:
    configure_logging()
    return spread(work, items, Workers(jobs), broken)


def test_a_process_that_dies_costs_its_own_item(capsys: pytest.CaptureFixture) -> None:
    found = list(run("slow a", "die", "b", "die", "die", "c"))
    dead = "die: killed by SIGKILL"
    assert found == ["SLOW A", dead, "B", dead, dead, "C"]
    err = capsys.readouterr().err
    assert [f"facerf: warning: at {item}\n" in err for item in ("slow a", "b", "c")] == [True] * 3


def test_every_one_dies() -> None:
    assert list(run(*["die"] * 3)) == ["die: killed by SIGKILL"] * 3


def test_what_the_work_raises_is_raised_here() -> None:
    refused(ValueError, "raise", list, run("a", "raise", "slow b"))


def test_who_stops_listening_ends_the_workers(tmp_path: Path) -> None:
    results = run("a", str(tmp_path / "b"), jobs=2)
    assert next(results) == "A"
    while not (tmp_path / "b").exists():
        time.sleep(0.01)
    results.close()
    assert not (tmp_path / "b").exists(), "SIGTERM unwinds; SIGKILL would leave it"


def test_workers_end_without_what_libraries_say_at_their_end(capfd: pytest.CaptureFixture) -> None:
    assert list(run("library", "b")) == ["LIBRARY", "B"]
    assert "leaked" not in capfd.readouterr().err


def _refuse(pipe: object, level: int, threads: int) -> None:
    raise SystemExit(3)


def test_processes_that_cannot_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facerf_cli.run.workers._serve", _refuse)
    refused(FacerfError, "could not start (exit code 3); try --jobs 1", list, run("a", "b"))


def process_of(item: str) -> str:
    if item == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    return str(os.getpid())


def test_neighbours_go_to_one_process_and_outlive_another() -> None:
    items = ["a", "b", "c", "d", "e", "die", "f", "g"]
    found = list(spread(process_of, items, Workers(2, in_a_row=4), broken))
    assert len(set(found[:4])) == 1 and found[5] == "die: killed by SIGKILL"
    assert found[4] not in found[:4] and found[6].isdecimal() and found[6] == found[7]


def _fail_or_wait(items: list[Path]) -> None:
    if items[0].name == "fails":
        raise ValueError("no")
    time.sleep(60)
    items[0].touch()


def _write(items: list[Path]) -> None:
    for path in items:
        path.touch()


def test_every_item_is_worked_on_once(tmp_path: Path) -> None:
    paths = [tmp_path / str(i) for i in range(5)]
    in_shards(_write, paths, 2)
    assert all(path.exists() for path in paths)


def test_an_error_ends_the_other_shards(tmp_path: Path) -> None:
    refused(ValueError, "no", in_shards, _fail_or_wait, [tmp_path / "fails", tmp_path / "waits"], 2)
    assert not (tmp_path / "waits").exists()
