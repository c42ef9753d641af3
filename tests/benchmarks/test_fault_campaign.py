"""The campaign of benchmarks/faults: doors take sound files, findings stay mended, the net catches."""

import contextlib
import io
import re
import runpy
import signal
import sys
import time
from pathlib import Path

import pytest

from benchmarks.faults import children
from benchmarks.faults.children import damaged, lay_out, outcome_of, run_door
from benchmarks.faults.doors import DOORS, Door
from facerf_cli.errors import InputError
from tests.kinds import Patch, Said

ROOT = Path(__file__).parents[2]
CORPUS = ROOT / "tests" / "corpus"
FINDINGS = sorted(path.relative_to(CORPUS) for path in CORPUS.rglob("*") if path.is_file())
BY_FOLDER = {re.sub(r"\W+", "_", name): name for name in DOORS}  # as inputs.py names them
NOT_FOR_IT = {"environment maps", "options", "command lines"}  # have samples that they refuse
SCRIPTS = ("inputs", "coverage", "kills", "places")


@pytest.mark.parametrize("finding", FINDINGS, ids=lambda path: path.as_posix())
def test_a_finding_stays_mended(finding: Path, tmp_path: Path) -> None:
    door = DOORS[BY_FOLDER[finding.parts[0]]]
    lay_out(door, tmp_path / finding.name, (CORPUS / finding).read_bytes())
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        outcome, said = outcome_of(door, tmp_path / finding.name)
    assert outcome in ("refused", "accepted"), said


@pytest.mark.parametrize("name", sorted(set(DOORS) - NOT_FOR_IT))
def test_a_door_takes_its_sound_files(name: str, tmp_path: Path) -> None:
    door = DOORS[name]
    for number, (file, content) in enumerate(door.sound().items()):
        place = tmp_path / str(number)
        place.mkdir()
        lay_out(door, place / file, content)
        outcome, said = outcome_of(door, place / file)
        assert outcome == "accepted", f"{file}: {said}"


def _trip(path: Path) -> None:
    content = path.read_bytes()
    if content == b"crash":
        signal.raise_signal(signal.SIGKILL)
    if content == b"hang":
        time.sleep(600)
    if content == b"uncaught":
        raise KeyError("x")
    if content == b"greedy":
        bytearray(64 << 30)
    if content == b"refused":
        raise InputError("a: is bad; mend it")
    if content == b"long":
        raise InputError("")


def test_the_net_catches_what_it_should_and_a_seed_says_the_case(monkeypatch: Patch) -> None:
    kinds = (b"fine", b"crash", b"refused", b"hang", b"uncaught", b"greedy", b"long")
    door = Door(lambda: {"a": b""}, _trip)
    monkeypatch.setitem(DOORS, "toy", door)
    monkeypatch.setattr(children, "CASE_S", 1.0)
    monkeypatch.setattr(children, "damaged", lambda door, name, seed, number: ("a", kinds[number]))
    ends = list(run_door("toy", 0, range(len(kinds))))
    assert [ended.number for ended in ends] == list(range(len(kinds)))
    wanted = ["accepted", "crash", "refused", "hang", "uncaught", "uncaught", "uncaught"]
    assert [ended.outcome for ended in ends] == wanted
    assert "SIGKILL" in ends[1].said and "KeyError" in ends[4].said and "MemoryError" in ends[5].said
    door = DOORS["light JSON"]
    assert damaged(door, "light JSON", 1, 5) == damaged(door, "light JSON", 1, 5)
    assert damaged(door, "light JSON", 1, 5) != damaged(door, "light JSON", 2, 5)


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_has_help(script: str, monkeypatch: Patch, capsys: Said) -> None:
    monkeypatch.setattr(sys, "argv", [script, "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(f"benchmarks.faults.{script}", run_name="__main__")
    assert ended.value.code in (0, None) and f"benchmarks.faults.{script}" in capsys.readouterr().out
