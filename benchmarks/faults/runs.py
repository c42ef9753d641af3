"""Runs of a verb in forks of this process, and what they left: nothing half, one row an item."""

import json
import os
import shutil
import signal
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Literal

from benchmarks._common import ASTRONAUT
from benchmarks.faults import samples
from facerf_cli.batch.run import REPORT_NAME
from facerf_cli.files import atomic

PART = ".*part-*"  # name of a temporary folder
_OWN = (REPORT_NAME, ".facerf-index.jsonl")


@dataclass(frozen=True)
class Verb:
    """A verb on a folder of inputs: its arguments without inputs and output.

    One that writes into the folder of its inputs is given a copy of it as the output folder.
    """

    name: str
    arguments: tuple[str, ...]
    fill: Callable[..., None]  # writes so many inputs into a folder, photos of a side in pixels
    reads: Literal["inputs", "output", "nothing"] = "inputs"
    grows: tuple[str, ...] = ()  # files that it writes again as it goes on
    reports: bool = True  # in a row an item

    def line(self, inputs: Path, output: Path) -> list[str]:
        """The command line."""
        if self.reads == "output":
            return [self.name, str(output), *self.arguments]
        given = [str(inputs)] if self.reads == "inputs" else []
        return [self.name, *given, *self.arguments, "-o", str(output)]

    def begin(self, inputs: Path, output: Path) -> None:
        """Leave the output folder as it is before the first run."""
        shutil.rmtree(output, ignore_errors=True)
        if self.reads == "output":
            shutil.copytree(inputs, output)


def _fill_with_lights(folder: Path, count: int, _: int = 0) -> None:
    light = json.loads(samples.lights()["both.json"])
    for number in range(count):
        light["weights"][0] = [number, 0.5, 0.25]
        (folder / f"light_{number:03d}.json").write_text(json.dumps(light))


def _fill_with_photos(folder: Path, count: int, side_px: int = 128) -> None:
    import numpy as np
    from PIL import Image

    photo = Image.open(ASTRONAUT).convert("RGB").resize((side_px, side_px))
    for number in range(count):
        pixels = np.asarray(photo).copy()
        pixels[0, 0] = number % 256, number // 256, 0
        Image.fromarray(pixels).save(folder / f"photo_{number:05d}.png", compress_level=1)


def _nothing(*_: object) -> None:
    """For a verb that reads nothing."""


def _fill_with_captures(folder: Path, count: int, _: int = 0) -> None:
    _run_here("synth-stage", "--subjects", str(count), "--lights", "12", "--size", "64", "-o", str(folder))


def _fill_with_dataset(folder: Path, count: int, _: int = 0) -> None:
    with tempfile.TemporaryDirectory() as stage:
        _fill_with_captures(Path(stage), count)
        _run_here("prepare-dataset", stage, "-o", str(folder))


_ON_PHOTOS = {
    "segment": (),
    "fit-geometry": (),
    "estimate-light": ("--lights", "20", "--width", "32"),
    "predict-olat": ("--lights", "4", "--frame", "uv"),
    "relight": ("--light", "75,20", "--exposure", "0"),
}
_STAGE = ("--subjects", "1", "--lights", "4", "--size", "64")
_MAPS = ("--count", "4", "--size", "64")
_PAIRS = ("--envmaps", "procedural:2", "--per-subject", "4")
_OTHERS = (
    Verb("envmap", _MAPS, _nothing, reads="nothing", grows=("envmaps.png",), reports=False),
    Verb("convert-light", ("--to", "sh"), _fill_with_lights),
    Verb("prepare-dataset", (), _fill_with_captures),
    Verb("relight-dataset", _PAIRS, _fill_with_dataset, reads="output"),
    Verb("synth-stage", _STAGE, _nothing, reads="nothing", grows=("stage.json",)),
    Verb("view", ("--size", "256"), _fill_with_photos, grows=("index.html",)),
)
VERBS = {verb.name: verb for verb in _OTHERS} | {
    name: Verb(name, given, _fill_with_photos) for name, given in _ON_PHOTOS.items()
}


def warm_up(verb: Verb) -> None:
    """Run the verb once here, so that forks have its imports and networks."""
    import importlib

    import OpenImageIO as oiio

    importlib.import_module("zoneinfo")  # late imports fail for a user who cannot read this Python
    oiio.attribute("threads", 1)  # a fork has one thread, and would wait for the others
    oiio.attribute("exr_threads", -1)
    with tempfile.TemporaryDirectory() as name:
        inputs, output = Path(name) / "in", Path(name) / "out"
        verb.fill(fresh(inputs), 1)
        verb.begin(inputs, output)
        _run_here(*verb.line(inputs, output))


def _run_here(*line: str) -> None:
    from facerf_cli.main import main

    with redirect_stdout(StringIO()):
        code = main([*line, "-q"])
    assert code == 0, f"{line[0]} ends with {code}"


@dataclass(frozen=True)
class Ended:
    """The exit code of a run (negative: its signal), and what it said on stderr."""

    code: int
    said: str


def run(line: Sequence[str], before: Callable[[], None] = lambda: None, notes: Path | None = None) -> Ended:
    """Run a command line in a fork, after `before`, and wait for it."""
    return wait(start(line, before, notes), notes)


def start(line: Sequence[str], before: Callable[[], None], notes: Path | None) -> int:
    """Begin a run in a fork that leads a group of processes; return its id."""
    process = os.fork()
    if process:
        return process
    code = 70
    try:
        os.setsid()
        descriptor = os.open(notes or os.devnull, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        null = os.open(os.devnull, os.O_RDWR)
        os.dup2(null, 0)
        os.dup2(null, 1)
        os.dup2(descriptor, 2)
        from facerf_cli.main import main
        from facerf_cli.run.stopping import end_on_signals

        end_on_signals(2.0)
        before()
        code = main(line)
    except KeyboardInterrupt:  # before or after the program itself
        code = 128 + signal.SIGINT
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        atomic._remove_own()  # as at the exit of a process that is no fork
        os._exit(code)


def wait(process: int, notes: Path | None) -> Ended:
    """Wait for a run, and end what it has left running."""
    _, status = os.waitpid(process, 0)
    with suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)
    said = notes.read_text(errors="replace") if notes and notes.exists() else ""
    code = os.WEXITSTATUS(status) if os.WIFEXITED(status) else -os.WTERMSIG(status)
    return Ended(code, said)


def outputs(folder: Path) -> dict[str, bytes]:
    """The outputs by name, without reports and hidden files."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in files
        if not any(part.startswith(".") for part in path.relative_to(folder).parts) and path.name not in _OWN
    }


def faults_of(
    folder: Path,
    whole: dict[str, bytes],
    finished: bool,
    grows: tuple[str, ...] = (),
    reported: bool = True,
) -> list[str]:
    """What is wrong in an output folder, compared with the outputs of an undisturbed run.

    Files that the verb writes again as it goes on are compared when it has finished.
    """
    found = []
    there = outputs(folder) if folder.exists() else {}
    there = {name: content for name, content in there.items() if finished or name not in grows}
    found += [f"half or foreign: {name}" for name, content in there.items() if whole.get(name) != content]
    if not finished:
        return found
    found += [f"missing: {name}" for name in whole if name not in there]
    found += [f"left: {path.name}" for path in folder.rglob(PART)]
    found += [f"left: {path.name}" for path in folder.rglob(".facerf-lock*")]
    reports = list(folder.rglob(REPORT_NAME))
    for report in reports:
        rows = [json.loads(line) for line in report.read_text().split("\n") if line]
        twice = [item for item, count in Counter(row["item"] for row in rows).items() if count > 1]
        found += [f"two rows: {item}" for item in twice]
        found += [f"row of {row['item']}: {row['status']}" for row in rows if row["status"] == "failed"]
    return found if reports or not reported else [*found, "no report"]


def fresh(folder: Path) -> Path:
    """The folder, empty."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder
