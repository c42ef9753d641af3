"""Places that fail: full disks, limits of a file's size, read-only folders, vanished inputs, a closed pipe.

    python -m benchmarks.faults.places [--verb convert-light]

Also two processes in one folder, a worker that is killed among others, and a clock that is set back. Each
run must end with an exit code of the contract and lines without a traceback, leave whole files only, and
finish to the same bytes as an undisturbed run once the fault is gone. Mounts need root; without it they are
left out, and said so. Exits 1 if anything was wrong.
"""

import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks._common import arguments
from benchmarks.faults.runs import VERBS, Ended, Verb, faults_of, fresh, outputs, run, start, wait, warm_up

_ITEMS = 8
_NOBODY = 65534


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--verb", choices=sorted(VERBS), default="convert-light")
    given = parser.parse_args()
    verb = VERBS[given.verb]
    warm_up(verb)
    bad = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        verb.fill(fresh(folder / "in"), _ITEMS)
        ended = run(verb.line(folder / "in", folder / "whole"), notes=folder / "said")
        assert ended.code == 0, ended.said
        whole = outputs(folder / "whole")
        for case in _CASES:
            found = case(verb, folder, whole)
            label = (case.__doc__ or "").rstrip(".")
            print(f"{verb.name}: {label}: {'; '.join(found) or 'well'}", flush=True)
            bad += bool(found) and not found[0].startswith("left out")
            shutil.rmtree(folder / "out", ignore_errors=True)
    sys.exit(int(bad > 0))


def _said_badly(ended: Ended, codes: tuple[int, ...]) -> list[str]:
    found = [] if ended.code in codes else [f"exit {ended.code}: {ended.said[-300:]}"]
    if "Traceback" in ended.said or "unexpected" in ended.said:
        found.append(f"said {ended.said[-500:]}")
    return found


def _then_whole(verb: Verb, folder: Path, whole: dict[str, bytes]) -> list[str]:
    ended = run(verb.line(folder / "in", folder / "out"), notes=folder / "said")
    return _said_badly(ended, (0,)) + faults_of(folder / "out", whole, finished=True)


def _size_limit(verb: Verb, folder: Path, whole: dict[str, bytes]) -> list[str]:
    """A limit of a file's size (ulimit -f), from none to that of all files."""
    found, most = [], max(map(len, whole.values())) + 4096
    for limit in sorted({*range(0, most, max(1, most // 24)), 1, 100, 1000}):

        def limited(size: int = limit) -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

        fresh(folder / "out").rmdir()
        ended = run(verb.line(folder / "in", folder / "out"), limited)
        found += _said_badly(ended, (0, 1, 2))
        found += faults_of(folder / "out", whole, finished=False)
        found += _then_whole(verb, folder, whole)
    return found


@contextmanager
def _mounted(at: Path, options: str) -> Iterator[bool]:
    at.mkdir(exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", options, "none", str(at)]
    good = subprocess.run(command, capture_output=True).returncode == 0
    try:
        yield good
    finally:
        if good:
            subprocess.run(["umount", str(at)], check=True)
        shutil.rmtree(at, ignore_errors=True)


def _full_disk(verb: Verb, folder: Path, whole: dict[str, bytes]) -> list[str]:
    """A full disk (tmpfs), from one page to room for nearly all."""
    total = sum(map(len, whole.values())) + 4096 * (len(whole) + 8)
    found: list[str] = []
    for size in range(4096, total, max(4096, total // 12)):
        with _mounted(folder / "disk", f"size={size}") as good:
            if not good:
                return ["left out: mount needs root"]
            out = folder / "disk" / "out"
            ended = run(verb.line(folder / "in", out), notes=folder / "said")
            found += _said_badly(ended, (0, 1, 2)) + faults_of(out, whole, finished=False)
            subprocess.run(["mount", "-o", "remount,size=512m", str(folder / "disk")], check=True)
            ended = run(verb.line(folder / "in", out), notes=folder / "said")
            found += _said_badly(ended, (0,)) + faults_of(out, whole, finished=True)
    return found


def _read_only(verb: Verb, folder: Path, whole: dict[str, bytes]) -> list[str]:
    """A read-only file system, and a folder of another user."""
    with _mounted(folder / "disk", "ro") as good:
        if not good:
            return ["left out: mount needs root"]
        ended = run(verb.line(folder / "in", folder / "disk" / "out"), notes=folder / "said")
        found = _said_badly(ended, (2,))
    fresh(folder / "out").chmod(0o755)
    (folder / "in").chmod(0o755)
    ended = run(verb.line(folder / "in", folder / "out"), lambda: os.setuid(_NOBODY), notes=folder / "said")
    return found + _said_badly(ended, (2,)) + faults_of(folder / "out", {}, finished=False)


def _vanished(verb: Verb, folder: Path, whole: dict[str, bytes]) -> list[str]:
    """Inputs that vanish while others are processed."""
    shutil.copytree(folder / "in", folder / "kept")
    names = sorted((folder / "in").iterdir())

    def vanishing() -> None:
        real = os.replace

        def replace(*given: object) -> None:
            real(*given)  # type: ignore[arg-type]
            for path in names[-2:]:
                path.unlink(missing_ok=True)

        os.replace = replace  # type: ignore[assignment]

    ended = run(verb.line(folder / "in", folder / "out"), vanishing, folder / "said")
    found = _said_badly(ended, (1,)) + faults_of(folder / "out", whole, finished=False)
    shutil.rmtree(folder / "in")
    (folder / "kept").rename(folder / "in")
    return found + _then_whole(verb, folder, whole)


def _closed_pipe(verb: Verb, folder: Path, whole: dict[str, bytes]) -> list[str]:
    """A reader that closes the pipe of results."""

    def closing() -> None:
        ours, theirs = os.pipe()
        os.close(ours)
        os.dup2(theirs, 1)

    ended = run(verb.line(folder / "in", folder / "out"), closing, folder / "said")
    found = _said_badly(ended, (128 + signal.SIGPIPE,))
    return found + faults_of(folder / "out", whole, finished=False) + _then_whole(verb, folder, whole)


def _two_at_once(verb: Verb, folder: Path, whole: dict[str, bytes]) -> list[str]:
    """Two processes in one folder, five times."""
    found = []
    for round_ in range(5):
        fresh(folder / "out").rmdir()
        line = verb.line(folder / "in", folder / "out")
        both = [start(line, lambda: None, folder / f"said{number}") for number in (0, 1)]
        if round_ == 4:
            time.sleep(0.3)
            os.kill(both[0], signal.SIGKILL)
        ends = [wait(process, folder / f"said{number}") for number, process in enumerate(both)]
        found += _said_badly(ends[1], (0,)) + _said_badly(ends[0], (0, -signal.SIGKILL))
        found += faults_of(folder / "out", whole, finished=True)
    return found


def _killed_worker(verb: Verb, folder: Path, whole: dict[str, bytes]) -> list[str]:
    """A worker of two that is killed, at four times, and four of eight."""
    found = []
    for delay_s, jobs in ((1.0, 2), (2.0, 2), (3.0, 2), (5.0, 2), (8.0, 8)):
        fresh(folder / "out").rmdir()
        line = [*verb.line(folder / "in", folder / "out"), "--jobs", str(jobs)]
        process = start(line, lambda: None, folder / "said")
        time.sleep(delay_s)
        children = Path(f"/proc/{process}/task/{process}/children")
        ids = [int(word) for word in children.read_text().split()] if children.exists() else []
        workers = [number for number in ids if b"spawn_main" in _command_of(number)]
        for worker in workers[: jobs // 2]:
            os.kill(worker, signal.SIGKILL)
        ended = wait(process, folder / "said")
        found += _said_badly(ended, (0, 1)) + faults_of(folder / "out", whole, finished=False)
        found += [f"left: {path.name}" for path in (folder / "out").rglob(".*part-*")]
        found += _then_whole(verb, folder, whole)
    return found


def _command_of(process: int) -> bytes:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return b""


def _clock(verb: Verb, folder: Path, whole: dict[str, bytes]) -> list[str]:
    """A clock set back: outputs and inputs from the future, and an input changed with an old time."""
    found = _then_whole(verb, folder, whole)
    future = time.time() + 50 * 365 * 86400
    for path in [*(folder / "out").iterdir(), *(folder / "in").iterdir()]:
        os.utime(path, (future, future))
    real = time.time

    def back() -> None:
        time.time = lambda: real() - 10 * 365 * 86400

    ended = run(verb.line(folder / "in", folder / "out"), back, folder / "said")
    found += _said_badly(ended, (0,)) + faults_of(folder / "out", whole, finished=True)
    first, second = sorted((folder / "in").iterdir())[:2]
    kept = first.read_bytes()
    first.write_bytes(second.read_bytes())
    os.utime(first, (1, 1))
    ended = run(verb.line(folder / "in", folder / "out"), back, folder / "said")
    stale = [name for name, content in outputs(folder / "out").items() if content != whole[name]]
    found += [] if ended.code == 0 and stale else ["a changed input with an old time was not read again"]
    first.write_bytes(kept)
    return found + _then_whole(verb, folder, whole)


_CASES: tuple[Callable[[Verb, Path, dict[str, bytes]], list[str]], ...] = (
    _size_limit,
    _full_disk,
    _read_only,
    _vanished,
    _closed_pipe,
    _two_at_once,
    _killed_worker,
    _clock,
)


if __name__ == "__main__":
    main()
