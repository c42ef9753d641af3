"""Items a second of a folder verb by its workers: --jobs 1, --jobs 2, two shards at once, and --ray local.

    python benchmarks/workers.py [--verb fit-geometry] [--items 12] [--rounds 2] [--ways jobs-1 ray-2 ...]
    python benchmarks/workers.py --verb prepare-dataset --input CAPTURE [--options "--layout extended-yale-b"]

`facerf fit-geometry`, or `facerf relight` under one lamp, of copies of examples/astronaut.jpg;
`synth-stage` of small people; `prepare-dataset` of a capture. A command a way, one thread a worker.
Two rates: of the whole command, start and end of its workers included; and between its workers' first
items and the last one, which is what a long run comes to. The best of the rounds, which take turns, is
shown; so is the machine's load before, for other programs' work makes every figure here smaller. All ways
must leave the same bytes, reports aside.
"""

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

PHOTO = Path(__file__).parents[1] / "examples" / "astronaut.jpg"
# A verb's options, and the last file of an item.
VERBS = {
    "fit-geometry": ((), "*_fit.npz"),
    "relight": (("--light", "30,20", "--exposure", "0"), "*.png"),
    "synth-stage": (("--size", "96"), "subject.json"),
    "prepare-dataset": ((), "fits/*.json"),
}
WAYS: dict[str, tuple[int, tuple[tuple[str, ...], ...]]] = {  # workers, and the options of each command
    "jobs-1": (1, (("--jobs", "1"),)),
    "jobs-2": (2, (("--jobs", "2"),)),
    "shards": (2, (("--shard", "1/2"), ("--shard", "2/2"))),
    "ray-1": (1, (("--ray", "local", "--jobs", "1"),)),
    "ray-2": (2, (("--ray", "local", "--jobs", "2"),)),
}


@dataclass(frozen=True)
class Run:
    """A way's times and what it left."""

    whole_s: float
    items: int
    steady: float  # items a second
    digest: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--verb", choices=list(VERBS), default="fit-geometry")
    parser.add_argument("--items", type=int, default=12, help="without --input")
    parser.add_argument("--input", type=Path, help="a folder for the verb in the place of the copies")
    parser.add_argument("--options", default="", help="further options of the verb")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    given = parser.parse_args()
    print(f"{given.verb}: {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f} before", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        arguments = [*inputs_of(given, Path(folder, "photos")), *VERBS[given.verb][0], *given.options.split()]
        runs: dict[str, list[Run]] = {way: [] for way in given.ways}
        for _ in range(given.rounds):
            for way in given.ways:
                run = measure(given.verb, arguments, Path(folder, "out"), way)
                runs[way].append(run)
                print(
                    f"  {way}: {run.items} items, {run.whole_s:.1f} s, {run.steady:.3f} a second", flush=True
                )
    show(runs, given.rounds)


def inputs_of(given: argparse.Namespace, photos: Path) -> list[str]:
    """What the verb works on: its arguments."""
    if given.verb == "synth-stage":
        return ["--subjects", str(given.items)]
    if given.input is not None:
        return [str(given.input.resolve())]
    photos.mkdir()
    for number in range(given.items):
        shutil.copy(PHOTO, photos / f"{number:03d}.jpg")
    return [str(photos)]


def show(runs: dict[str, list[Run]], rounds: int) -> None:
    """Print a line a way, and whether all left the same bytes."""
    print(f"best of {rounds}:")
    print(f"{'way':8s} {'workers':>7s} {'whole s':>8s} {'items/s':>11s} {'once started':>13s}")
    for way, found in runs.items():
        whole_s, steady = min(run.whole_s for run in found), max(run.steady for run in found)
        print(f"{way:8s} {WAYS[way][0]:7d} {whole_s:8.1f} {found[0].items / whole_s:11.3f} {steady:13.3f}")
    digests = {run.digest for found in runs.values() for run in found}
    print(
        "all left the same bytes" if len(digests) == 1 else f"DIFFERENT BYTES: {len(digests)} kinds of trees"
    )


def measure(verb: str, arguments: Sequence[str], out: Path, way: str) -> Run:
    """Run a way's commands at once."""
    workers, commands = WAYS[way]
    shutil.rmtree(out, ignore_errors=True)
    start_s = time.perf_counter()
    base = [sys.executable, "-m", "facerf_cli", verb, *arguments, "-o", str(out), "-q"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    running = [
        subprocess.Popen([*base, *options], stdout=subprocess.DEVNULL, env=environment, cwd=PHOTO.parents[1])
        for options in commands
    ]
    if any([process.wait() for process in running]):  # all of them: none is left behind
        sys.exit(f"{way}: failed")
    whole_s = time.perf_counter() - start_s
    done_s = sorted(path.stat().st_mtime for path in out.rglob(VERBS[verb][1]))
    return Run(whole_s, len(done_s), rate_of(done_s, workers), digest_of(out))


def rate_of(done_s: Sequence[float], workers: int) -> float:
    """Items a second after each worker's first, by when items were done, ascending."""
    later = len(done_s) - workers
    return later / (done_s[-1] - done_s[workers - 1]) if later > 0 else float("nan")


def digest_of(out: Path) -> str:
    """Of every file's place and bytes but the reports', which hold times."""
    files = sorted(path for path in out.rglob("*") if path.is_file() and not path.match("report*.jsonl"))
    parts = [f"{path.relative_to(out)} {hashlib.sha256(path.read_bytes()).hexdigest()}" for path in files]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


if __name__ == "__main__":
    main()
