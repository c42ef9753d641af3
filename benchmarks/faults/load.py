"""Thousands of items in one folder: does memory or the time of an item grow, and what does a rerun cost?

    python -m benchmarks.faults.load [--verb convert-light] [--items 10000] [--with "--landmarks me.json"]

A first run that Ctrl-C ends three times, then to its end; the time of an item at the beginning and the end;
the most memory of a run over a tenth of the items and over all; and a rerun of the finished folder, with the
time of a bare `facerf --version`. Times of runs are of a processor, those of an item by the clock.
Photos are the astronaut at 256 x 256 pixels, each with another pixel; landmarks of one are those of all.
"""

import json
import os
import shlex
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from benchmarks._common import ROOT, arguments
from benchmarks.faults.runs import VERBS, Verb, fresh
from facerf_cli.batch.run import REPORT_NAME

_INTERRUPTS, _SIDE_PX = 3, 256


def main() -> None:
    parser = arguments(__doc__)
    folders = sorted(verb.name for verb in VERBS.values() if verb.reads == "inputs")
    parser.add_argument("--verb", choices=folders, default="convert-light")
    parser.add_argument("--items", type=int, default=10_000)
    parser.add_argument("--with", dest="more", default="", help="further arguments of the verb")
    given = parser.parse_args()
    signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a shell's background job ignores it, and its own
    verb = VERBS[given.verb]
    verb = replace(verb, arguments=(*verb.arguments, *shlex.split(given.more)))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        verb.fill(fresh(folder / "few"), given.items // 10, _SIDE_PX)
        few = _timed(verb.line(folder / "few", folder / "out of few"))
        print(
            f"{given.items // 10} items took {few.cpu_s:.0f} s of a processor, {few.most_mib:.0f} MiB",
            flush=True,
        )
        verb.fill(fresh(folder / "in"), given.items, _SIDE_PX)
        _report(verb, folder, given.items, few.most_mib)


def _report(verb: Verb, folder: Path, items: int, few_mib: float) -> None:
    line, report = verb.line(folder / "in", folder / "out"), folder / "out" / REPORT_NAME
    done = []
    for number in range(_INTERRUPTS):
        done.append(_interrupted(line, report, items * (number + 1) // 10))
        print(f"interrupted at {done[-1]} rows", flush=True)
    rest = _timed(line)
    rows = [json.loads(row) for row in report.read_text().split("\n") if row]
    times = [row["seconds"] for row in rows if row["status"] == "done"]
    tenth = max(1, len(times) // 10)
    first, last = statistics.median(times[:tenth]), statistics.median(times[-tenth:])
    again = [_timed(line) for _ in range(2)]
    bare = min(_timed(["--version"]).cpu_s for _ in range(2))
    print(f"{verb.name}, {items} items; {len(done)} times interrupted; exit {rest.code}")
    print(f"rows {len(rows)}, of items {len({row['item'] for row in rows})}")
    print(f"the rest took {rest.cpu_s:.0f} s of a processor")
    print(f"an item {1000 * first:.1f} ms in the first tenth, {1000 * last:.1f} ms in the last")
    print(f"most memory {few_mib:.0f} MiB of {items // 10} items, {rest.most_mib:.0f} MiB of {items}")
    rerun, clock = min(run.cpu_s for run in again), min(run.clock_s for run in again)
    print(
        f"a rerun of the finished folder {rerun:.2f} s, by the clock {clock:.2f}; {again[0].most_mib:.0f} MiB"
    )
    print(f"a bare start {bare:.2f} s")


def _command(line: list[str]) -> list[str]:
    return [sys.executable, "-c", "from facerf_cli.main import run; run()", *line]


class _Run(NamedTuple):
    """Seconds of a processor and by the clock, most memory in MiB, and the exit code."""

    cpu_s: float
    clock_s: float
    most_mib: float
    code: int


def _timed(line: list[str]) -> _Run:
    begin = time.monotonic()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        _command(line), env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    seconds, clock_s = usage.ru_utime + usage.ru_stime, time.monotonic() - begin
    return _Run(seconds, clock_s, usage.ru_maxrss / 1024, os.waitstatus_to_exitcode(status))


def _interrupted(line: list[str], report: Path, rows: int) -> int:
    """Run until the report has so many rows, then press Ctrl-C; return how many rows there are."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        _command(line), env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while process.poll() is None and _lines(report) < rows:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    process.wait()
    return _lines(report)


def _lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


if __name__ == "__main__":
    main()
