"""A verb killed at random and at aimed moments, then run again: are all outputs there, byte for byte?

    python -m benchmarks.faults.kills [--verb convert-light] [--kills 100] [--items 6] [--seed 0]

Aimed kills fall before or after a call that changes the disk (mkdir, fsync, replace, a row of the report);
random ones anywhere between the start and the end of an undisturbed run, and some send SIGTERM, SIGHUP or
SIGINT. After each, every visible output must be whole; after one to three interrupted runs and a last one
all must be there, the same as an undisturbed run's, with one row an item and nothing left over. Exits 1 if
anything was wrong.
"""

import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks._common import arguments
from benchmarks.faults.runs import PART, VERBS, Verb, faults_of, fresh, outputs, run, start, wait, warm_up

_CALLS = ("mkdir", "fsync", "replace", "row")
_SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--verb", choices=sorted(VERBS), default="convert-light")
    parser.add_argument("--kills", type=int, default=100, help="of each kind: aimed and random")
    parser.add_argument("--items", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    verb = VERBS[given.verb]
    warm_up(verb)
    wrong: Counter[str] = Counter()
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        verb.fill(fresh(folder / "in"), given.items)
        whole, seconds = _undisturbed(verb, folder)
        draw = random.Random(given.seed)
        for number in range(given.kills):
            wrong.update(_aimed(verb, folder, whole, draw, 3 * given.items))
            wrong.update(_random(verb, folder, whole, draw, seconds))
            if set(wrong) - {"interrupted"} and number % 10 == 0:
                print(dict(wrong), file=sys.stderr)
    minutes = (time.monotonic() - begin) / 60
    done = wrong.pop("interrupted", 0)
    cases = f"{2 * given.kills} cases, {done} runs interrupted"
    print(f"{verb.name}: {cases}, {wrong.total()} faults, {minutes:.1f} min")
    for what, count in wrong.items():
        print(f"  {what}: {count}")
    sys.exit(int(bool(wrong)))


def _undisturbed(verb: Verb, folder: Path) -> tuple[dict[str, bytes], float]:
    verb.begin(folder / "in", folder / "whole")
    begin = time.monotonic()
    ended = run(verb.line(folder / "in", folder / "whole"), notes=folder / "said")
    assert ended.code == 0, ended.said
    return outputs(folder / "whole"), time.monotonic() - begin


def _aimed(verb: Verb, folder: Path, whole: dict[str, bytes], draw: random.Random, most: int) -> list[str]:
    """Kill at one of the first `most` calls that change the disk, up to three times, then finish."""
    out, found = folder / "out", []
    verb.begin(folder / "in", out)
    for _ in range(draw.choice((1, 1, 2, 3))):
        call, count, after = draw.choice(_CALLS), draw.randrange(1, most), draw.random() < 0.5
        ended = run(verb.line(folder / "in", out), partial(_kill_at, call, count, after))
        found += ["interrupted"] if ended.code == -signal.SIGKILL else []
        found += faults_of(out, whole, finished=False, grows=verb.grows)
    return found + _finish(verb, folder, out, whole)


def _random(
    verb: Verb, folder: Path, whole: dict[str, bytes], draw: random.Random, seconds: float
) -> list[str]:
    """Send a signal at any time, up to three times, then finish."""
    out, found = folder / "out", []
    verb.begin(folder / "in", out)
    for _ in range(draw.choice((1, 1, 2, 3))):
        notes, number = folder / "said", draw.choice(_SIGNALS)
        before = set(out.rglob(PART))  # of a killed run
        process = start(verb.line(folder / "in", out), lambda: None, notes)
        time.sleep(draw.uniform(0, 1.1 * seconds))
        os.kill(process, number)
        ended = wait(process, notes)
        found += ["interrupted"] if ended.code != 0 else []
        if ended.code not in (0, -number, 128 + number):
            found.append(f"exit {ended.code} after {number.name}")
        if "Traceback" in ended.said or "unexpected" in ended.said:
            found.append(f"traceback after {number.name}: {ended.said[-300:]}")
        found += faults_of(out, whole, finished=False, grows=verb.grows)
        if number != signal.SIGKILL:
            found += [f"left after {number.name}" for _ in set(out.rglob(PART)) - before]
    return found + _finish(verb, folder, out, whole)


def _finish(verb: Verb, folder: Path, out: Path, whole: dict[str, bytes]) -> list[str]:
    ended = run(verb.line(folder / "in", out), notes=folder / "said")
    found = [] if ended.code == 0 else [f"exit {ended.code} of the last run"]
    return found + faults_of(out, whole, finished=True, reported=verb.reports)


def _kill_at(call: str, count: int, after: bool) -> None:
    """Let this process kill itself at the `count`th call."""
    left = [count]

    def counted(real: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*given: Any, **named: Any) -> Any:
            left[0] -= 1
            if left[0] == 0 and not after:
                os.kill(os.getpid(), signal.SIGKILL)
            result = real(*given, **named)
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return result

        return wrapped

    if call == "row":
        from facerf_cli.batch import run as report

        report.json_line = counted(report.json_line)
    else:
        setattr(os, call, counted(getattr(os, call)))


if __name__ == "__main__":
    main()
