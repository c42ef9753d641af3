"""Cases in child processes with limits of memory and time; a crash or a hang costs its own case.

A child is a fork, after the imports, and runs cases one after another; it sends a line for each. Where it
dies, the next child goes on behind the case that killed it.
"""

import json
import logging
import os
import random
import resource
import select
import shutil
import signal
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.faults import mutations
from benchmarks.faults.doors import DOORS, Door
from facerf_cli.errors import FacerfError
from facerf_cli.run.logs import LOGGER_NAME, printable_line

MEMORY_BYTES, CASE_S, CHILD_CASES = 4 << 30, 60.0, 2000
_LONGEST_MESSAGE = 3000
LARGEST_BYTES = 4 << 20  # of a case's file
_PACKAGE = "facerf_cli"


@dataclass(frozen=True)
class Ended:
    """The end of a case: `refused`, `accepted`, `uncaught`, `crash` or `hang`."""

    number: int
    outcome: str
    said: str = ""  # of an uncaught error: its class, its place and its message
    grown_mib: float = 0.0  # the peak of the child's memory so far, over that at its start
    seconds: float = 0.0


def damaged(door: Door, name: str, seed: int, number: int) -> tuple[str, bytes]:
    """The file of a case: its name and its content, the same for the same seed."""
    draw = random.Random(f"{seed}/{name}/{number}")
    sound = door.sound()
    file = draw.choice(sorted(sound))
    content = sound[file]
    for _ in range(draw.choice((1, 1, 2))):
        try:
            content = draw.choice(door.faults)(content, draw)[:LARGEST_BYTES]
        except Exception:  # an earlier fault broke the structure that this one changes
            content = mutations.bytes_(content, draw)
    return file, content


def lay_out(door: Door, path: Path, content: bytes) -> None:
    """Write a case's file, and those that stand beside it."""
    for fixed, sound in door.fixed().items():
        (path.parent / fixed).parent.mkdir(parents=True, exist_ok=True)
        (path.parent / fixed).write_bytes(sound)
    path.write_bytes(content)


def outcome_of(door: Door, path: Path) -> tuple[str, str]:
    """Open a file; an error that is not a clean line is `uncaught`."""
    try:
        door.open(path)
    except FacerfError as error:
        return _said_well(str(error))
    except BaseException as error:  # also SystemExit: a reader must not end the program
        return "uncaught", f"{type(error).__name__} at {_place(error)}: {str(error)[:200]!a}"
    return "accepted", ""


def _said_well(message: str) -> tuple[str, str]:
    line = printable_line(message)
    if not line or len(line) > _LONGEST_MESSAGE or not line.isprintable():
        return "uncaught", f"message: {len(line)} characters: {line[:200]!a}"
    return "refused", ""


def _place(error: BaseException) -> str:
    """The innermost line of the package in a traceback."""
    frames = traceback.extract_tb(error.__traceback__)[-400:]
    ours = [frame for frame in frames if _PACKAGE in frame.filename] or frames
    return f"{Path(ours[-1].filename).name}:{ours[-1].name}"


def run_door(name: str, seed: int, cases: range) -> Iterator[Ended]:
    """Run cases of a door and yield their ends, in order."""
    door = DOORS[name]
    door.sound()  # before the fork: made once
    ahead = cases.start
    while ahead < cases.stop:
        last = min(ahead + CHILD_CASES, cases.stop)
        for ended in _one_child(name, seed, range(ahead, last)):
            yield ended
            ahead = ended.number + 1


def _one_child(name: str, seed: int, cases: range) -> Iterator[Ended]:
    """Run cases in one child until it ends, dies or hangs; the last one says how."""
    ours, theirs = os.pipe()
    folder = Path(tempfile.mkdtemp(prefix="faults-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None))
    child = os.fork()
    if child == 0:
        os.close(ours)
        try:
            _serve(DOORS[name], name, seed, cases, folder, theirs)
        finally:
            os._exit(0)
    os.close(theirs)
    number, rest, hung = cases.start, b"", False
    try:
        while True:
            if not select.select([ours], [], [], CASE_S)[0]:
                hung = True
                os.kill(child, signal.SIGKILL)
                break
            block = os.read(ours, 1 << 16)
            if not block:
                break
            *lines, rest = (rest + block).split(b"\n")
            for line in lines:
                yield Ended(**json.loads(line))
                number += 1
    finally:
        os.close(ours)
        _, status = os.waitpid(child, 0)
        shutil.rmtree(folder, ignore_errors=True)
    if number < cases.stop:
        cause = signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else f"exit {status >> 8}"
        yield Ended(number, "hang" if hung else "crash", "" if hung else cause, seconds=CASE_S * hung)


def _serve(door: Door, name: str, seed: int, cases: range, folder: Path, pipe: int) -> None:
    """The child: each case's file is written, opened and removed."""
    confine()
    begin = _peak_mib()
    for number in cases:
        place = folder / str(number)
        place.mkdir()
        file, content = damaged(door, name, seed, number)
        lay_out(door, place / file, content)
        start = time.perf_counter()
        outcome, said = outcome_of(door, place / file)
        seconds = time.perf_counter() - start
        grown = _peak_mib() - begin
        shutil.rmtree(place, ignore_errors=True)
        row = [number, outcome, said, round(grown, 1), round(seconds, 3)]
        fields = ("number", "outcome", "said", "grown_mib", "seconds")
        os.write(pipe, json.dumps(dict(zip(fields, row, strict=True))).encode() + b"\n")


def confine() -> None:
    """Let this process say nothing, have `MEMORY_BYTES` more than now, and leave no core file."""
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)
    logging.getLogger(LOGGER_NAME).handlers[:] = [logging.NullHandler()]
    logging.getLogger(LOGGER_NAME).propagate = False
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _peak_mib() -> float:
    """The most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
