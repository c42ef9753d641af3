"""Items a second of a verb that walks folders: --jobs 1, --jobs 2, two shards at once, and --ray local.

    python benchmarks/workers.py [--verb fit-geometry] [--items 12] [--rounds 2] [--ways jobs-1 ray-2 ...]
    python benchmarks/workers.py --verb prepare-dataset --input CAPTURE [--options "--layout extended-yale-b"]

The input is copies of examples/astronaut.jpg, or the number of people of `synth-stage`; `prepare-dataset`
needs a capture. Workers have one thread each. There are two rates: of the whole command with the start of its
workers, and between the first items of the workers and the last item, as in a long run. The ways take turns,
and the best round of each is shown, and its ratio to the first way. All ways must write the same bytes,
except in reports.
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

from _common import ASTRONAUT, ROOT, arguments, required

# The options of a verb, and the last file of an item.
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
    """The times of a way, and a digest of its files."""

    whole_s: float
    items: int
    steady: float  # items a second
    digest: str


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--verb", choices=list(VERBS), default="fit-geometry")
    parser.add_argument("--items", type=int, default=4, help="photos, or people of synth-stage")
    parser.add_argument("--input", type=Path, help="a folder, in place of the copied photos")
    parser.add_argument("--options", default="", help="further options of the verb")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=["jobs-1", "jobs-2", "shards"])
    given = parser.parse_args()
    if given.verb == "prepare-dataset":
        required(given.input, "a capture", "--input")
    print(f"{given.verb}: {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f} before", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        words = [*inputs_of(given, Path(folder, "photos")), *VERBS[given.verb][0], *given.options.split()]
        runs: dict[str, list[Run]] = {way: [] for way in given.ways}
        for _ in range(given.rounds):
            for way in given.ways:
                run = measure(given.verb, words, Path(folder, "out"), way)
                runs[way].append(run)
                print(
                    f"  {way}: {run.items} items, {run.whole_s:.1f} s, {run.steady:.3f} a second", flush=True
                )
    show(runs, given.rounds)


def inputs_of(given: argparse.Namespace, photos: Path) -> list[str]:
    """The arguments that name the verb's input."""
    if given.verb == "synth-stage":
        return ["--subjects", str(given.items)]
    if given.input is not None:
        return [str(given.input.resolve())]
    photos.mkdir()
    for number in range(given.items):
        shutil.copy(ASTRONAUT, photos / f"{number:03d}.jpg")
    return [str(photos)]


def show(runs: dict[str, list[Run]], rounds: int) -> None:
    """Print a line for each way, and whether all wrote the same bytes."""
    print(f"best of {rounds}:")
    print(f"{'way':8s} {'workers':>7s} {'whole s':>8s} {'items/s':>11s} {'once started':>13s} {'ratio':>13s}")
    first = max(run.steady for run in next(iter(runs.values())))
    for way, found in runs.items():
        whole_s, steady = min(run.whole_s for run in found), max(run.steady for run in found)
        rates = f"{found[0].items / whole_s:11.3f} {steady:13.3f} {steady / first:12.2f}x"
        print(f"{way:8s} {WAYS[way][0]:7d} {whole_s:8.1f} {rates}")
    digests = {run.digest for found in runs.values() for run in found}
    print(
        "all wrote the same bytes" if len(digests) == 1 else f"DIFFERENT BYTES: {len(digests)} kinds of trees"
    )


def measure(verb: str, words: Sequence[str], out: Path, way: str) -> Run:
    """Run the commands of a way at once."""
    workers, commands = WAYS[way]
    shutil.rmtree(out, ignore_errors=True)
    start_s = time.perf_counter()
    base = [sys.executable, "-m", "facerf_cli", verb, *words, "-o", str(out), "-q"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    running = [
        subprocess.Popen([*base, *options], stdout=subprocess.DEVNULL, env=environment, cwd=ROOT)
        for options in commands
    ]
    if any([process.wait() for process in running]):  # waits for all of them
        sys.exit(f"{way}: failed")
    whole_s = time.perf_counter() - start_s
    done_s = sorted(path.stat().st_mtime for path in out.rglob(VERBS[verb][1]))
    return Run(whole_s, len(done_s), rate_of(done_s, workers), digest_of(out))


def rate_of(done_s: Sequence[float], workers: int) -> float:
    """Items a second after the first item of each worker, from sorted times of completion."""
    later = len(done_s) - workers
    return later / (done_s[-1] - done_s[workers - 1]) if later > 0 else float("nan")


def digest_of(out: Path) -> str:
    """Digest the path and bytes of every file except journals, which hold times."""
    files = sorted(path for path in out.rglob("*") if path.is_file() and path.suffix != ".jsonl")
    parts = [f"{path.relative_to(out)} {hashlib.sha256(path.read_bytes()).hexdigest()}" for path in files]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


if __name__ == "__main__":
    main()
