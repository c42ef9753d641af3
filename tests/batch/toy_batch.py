"""A verb that copies bytes, for other processes to import; what a file holds is what happens to it."""

import fcntl
import logging
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from facerf_cli.batch.inputs import Item, collect_items
from facerf_cli.batch.recipe import DigestOf, Recipe
from facerf_cli.batch.run import Job, Outcome, run_items
from facerf_cli.batch.settings import BatchOptions, Settings, Shard
from facerf_cli.errors import FacerfError, InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.run.logs import LOGGER_NAME, configure_logging


def outputs_of(item: Item) -> list[Path]:
    return [item.output("_copy.bin")]


@dataclass(frozen=True)
class Copy(Job):
    """Copies; each write of an output leaves a line in NOTES/written."""

    notes: Path
    recipe: Recipe = field(default_factory=dict)
    verb = "copy"

    def outputs_of(self, item: Item) -> list[Path]:
        return outputs_of(item)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        return [self.recipe]

    def __call__(self, item: Item) -> Outcome:
        data = item.input_path.read_bytes()
        logging.getLogger(LOGGER_NAME).warning("at %s", item.name)
        if data == b"bad":
            raise InputError(f"{item.input_path}: is bad;\n try another")
        if data == b"bug":
            raise RuntimeError("a bug")
        if data == b"stop":
            raise FacerfError("the checkpoint is broken")
        if data == b"die":
            self.note("died", item.name)
            os.kill(os.getpid(), signal.SIGKILL)
        (path,) = outputs_of(item)
        with atomic_path(path) as temporary:
            temporary.write_bytes(b"half")
            if data == b"wait" and not (self.notes / "victim").exists():
                self.note("victim", str(os.getpid()))
                self.sleep()
            if data == b"fall":
                os.kill(os.getpid(), signal.SIGKILL)
            temporary.write_bytes(data)
        self.note("written", item.name)
        if data == b"late" and not (self.notes / "late").exists():
            self.note("late", item.name)
            os.kill(os.getpid(), signal.SIGKILL)
        return Outcome([path], {"bytes": len(data), "ratio": float("nan")})

    def note(self, name: str, line: str) -> None:
        with (self.notes / name).open("a", errors="surrogateescape") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX)
            stream.write(line + "\n")

    def sleep(self) -> None:
        for _ in range(600):
            time.sleep(0.1)


def run(
    inputs: Path | list[Path],
    output: Path,
    shard: Shard | None = None,
    ray: str | None = None,
    recipe: Recipe | None = None,
    **options: object,
) -> int:
    """Copy photos to OUTPUT; notes go to the folder above."""
    job = Copy(output.parent, recipe or {})
    return run_job(job, inputs, output, shard=shard or Shard(), ray=ray, **options)


def run_job(job: Job, inputs: Path | list[Path], output: Path, **options: object) -> int:
    """Run a job on photos."""
    configure_logging()
    items = collect_items([str(path) for path in ([inputs] if isinstance(inputs, Path) else inputs)], output)
    return run_items(job, items, BatchOptions(output, **options), Settings())  # type: ignore[arg-type]


def started(
    inputs: Path, output: Path, jobs: int = 1, ray: str = "", **popen: object
) -> "subprocess.Popen[str]":
    """Start `run` in another process, whose standard error is a pipe."""
    line = [sys.executable, "-m", "tests.batch.toy_batch", str(inputs), str(output), str(jobs), ray]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    return subprocess.Popen(line, env=environment, stderr=subprocess.PIPE, text=True, **popen)


if __name__ == "__main__":
    from tests.batch.toy_batch import run as run_importable

    inputs, output, jobs, ray = sys.argv[1:]
    sys.exit(run_importable(Path(inputs), Path(output), ray=ray or None, jobs=int(jobs)))
