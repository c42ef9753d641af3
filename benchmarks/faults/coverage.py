"""Inputs led by the code that they reach: damaged files at a door, made by atheris (libFuzzer).

    python -m benchmarks.faults.coverage [--door landmarks] [--seconds 60] [--seed 1] [--findings DIR]

Needs `pip install atheris==3.0.0`. facerf's Python is instrumented as it is imported; libraries in C are not.
A door begins with its sound samples; half of the changes are libFuzzer's, half those of `mutations.py`. A
case that reaches new code is changed further. A row a door: edges of code that the samples reach, and those
reached at the end. Of each kind of finding the first file is kept. Exits 1 if anything was uncaught, crashed
or hung. The same seed gives the same cases only while the machine reaches the same ones in the time.
"""

import os
import random
import re
import shutil
import sys
import tempfile
from contextlib import nullcontext
from multiprocessing.sharedctypes import RawArray
from pathlib import Path

try:
    import atheris
except ImportError:
    atheris = None

with atheris.instrument_imports(["facerf_cli"]) if atheris else nullcontext():
    from benchmarks._common import arguments, skip
    from benchmarks.faults.children import CASE_S, LARGEST_BYTES, confine, lay_out, outcome_of
    from benchmarks.faults.doors import DOORS, Door

_OUTCOMES = ("refused", "accepted", "uncaught")
_ENDS = {0: "time", 70: "hang", 71: "memory", 77: "crash"}  # exit codes of libFuzzer
_CONFINED = ("HEIC", "Basel 2009", "Basel 2017")  # a child process a case: too slow, and C


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--door", action="append", choices=sorted(DOORS), help="these only; may be repeated")
    parser.add_argument("--seconds", type=int, default=60, help="of each door")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--findings", type=Path, help="folder for files that were uncaught, crashed or hung")
    given = parser.parse_args()
    if atheris is None:
        skip("the package atheris", "pip install atheris==3.0.0")
    findings = given.findings or Path(tempfile.mkdtemp(prefix="findings-"))
    findings.mkdir(parents=True, exist_ok=True)
    print("| door | cases | refused | accepted | uncaught | edges of samples | at the end | ended by |")
    print("|---|---|---|---|---|---|---|---|")
    wrong = False
    for name in given.door or [name for name in DOORS if name not in _CONFINED]:
        wrong |= _row(name, given.seed, given.seconds, findings / re.sub(r"\W+", "_", name))
    if wrong:
        print(f"findings: {findings}", file=sys.stderr)
    sys.exit(int(wrong))


def _row(name: str, seed: int, seconds: int, findings: Path) -> bool:
    """Fuzz a door in a fork and print its row; return whether anything was wrong."""
    findings.mkdir(parents=True, exist_ok=True)
    counts = RawArray("Q", len(_OUTCOMES))
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as folder:
        child = os.fork()
        if child == 0:
            try:
                _fuzz(DOORS[name], seed, seconds, Path(folder), findings, counts)
            finally:
                os._exit(1)
        _, status = os.waitpid(child, 0)
        said = (Path(folder) / "said").read_text(errors="replace")
    edges = [int(found) for found in re.findall(r"(?:INITED|DONE)\s+cov: (\d+)", said)] or [0]
    code = os.waitstatus_to_exitcode(status)
    ended = _ENDS.get(code, f"exit {code}")
    figures = " | ".join(str(count) for count in (sum(counts), *counts))
    print(f"| {name} | {figures} | {edges[0]} | {edges[-1]} | {ended} |", flush=True)
    if code:
        (findings / "said.txt").write_text(said[-20_000:])
    return code != 0 or counts[_OUTCOMES.index("uncaught")] > 0


def _fuzz(door: Door, seed: int, seconds: int, folder: Path, findings: Path, counts: RawArray) -> None:
    """The child: libFuzzer ends it after so many seconds, or at a crash or a hang."""
    begin = folder / "begin"
    begin.mkdir()
    with atheris.instrument_imports(["facerf_cli"]):  # of what only this door and its samples import
        sound = door.sound()
        files = sorted(sound)
        for number, file in enumerate(files):
            (begin / str(number)).write_bytes(bytes([number]) + sound[file])
            _outcome(door, folder / "case", file, sound[file])
    confine()
    os.dup2(os.open(folder / "said", os.O_WRONLY | os.O_CREAT), 2)
    kinds = set()

    def test(data: bytes) -> None:
        file = files[data[0] % len(files)] if data else files[0]
        outcome, said = _outcome(door, folder / "case", file, data[1:])
        counts[_OUTCOMES.index(outcome)] += 1
        kind = said.split(": ")[0]
        if outcome == "uncaught" and kind not in kinds:
            kinds.add(kind)
            place = findings / re.sub(r"\W+", "_", kind)[:60]
            place.mkdir(exist_ok=True)
            (place / file).write_bytes(data[1:])
            (place / "said.txt").write_text(said)

    def change(data: bytes, most: int, number: int) -> bytes:
        draw = random.Random(number)
        if draw.random() < 0.5:
            return atheris.Mutate(data, most)
        try:
            return data[:1] + draw.choice(door.faults)(data[1:], draw)[: most - 1]
        except Exception:  # an earlier fault broke the structure that this one changes
            return atheris.Mutate(data, most)

    longest = min(LARGEST_BYTES, 4096 + 2 * max(map(len, sound.values())))
    options = {
        "seed": seed,
        "max_total_time": seconds,
        "timeout": int(CASE_S),
        "max_len": longest,
        "rss_limit_mb": 0,  # the limit of `confine` holds
        "artifact_prefix": f"{findings}/",
    }
    atheris.Setup(
        ["coverage", *(f"-{key}={value}" for key, value in options.items()), str(begin)],
        test,
        custom_mutator=change,
    )
    atheris.Fuzz()


def _outcome(door: Door, place: Path, file: str, content: bytes) -> tuple[str, str]:
    """Open a case's file in a folder of its own, which is then removed."""
    place.mkdir()
    try:
        lay_out(door, place / file, content)
        return outcome_of(door, place / file)
    finally:
        shutil.rmtree(place, ignore_errors=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
