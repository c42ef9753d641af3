"""Processors' seconds of one photo's first image, over those of `import torch`, and the steps that take them.

    python benchmarks/first_image.py [--against REV] [--cases "360 px, a light"] [--rounds 3]

Each line is a new process with one thread for each of torch's pools; the lines, and those of the commit REV
in a worktree, take turns, and the least of the rounds counts. Bytecode is cached, as in an installation.
Steps are those that `facerf -v --log-json` prints; `look`, a part of reflectance that runs beside the rest of
it, stands alone as well. What is in no step is the command line and imports. `help`, `facerf --help`, is over
`import typer, rich`. The bound of 12 megapixels is what files alone take: a photo is read, multiplied once
and written as EXR and PNG.
"""

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from _common import ASTRONAUT, ROOT, arguments, print_header, print_row
from large_photos import enlarged
from PIL import Image

_LIGHT, _MAP = ("--light", "60,30"), ("--envmap", str(ROOT / "examples" / "maps" / "studio.exr"))
_CASES = {
    "360 px, a light": (360, _LIGHT),
    "1024 px, a light": (1024, _LIGHT),
    "1024 px, a map": (1024, _MAP),
    "12 megapixels, a map": (0, _MAP),
}
_HELP, _BOUND = "help", "12 megapixels, the bound"
_FILES_ALONE = """
import sys, pathlib
from facerf_cli.files import read, write
pixels, path = read.read_image(pathlib.Path(sys.argv[1])).pixels, pathlib.Path(sys.argv[2])
write.write_exr(path.with_suffix(".exr"), pixels * 0.5)
write.write_display(path.with_suffix(".png"), pixels)
"""
_ALL = (*_CASES, _BOUND, _HELP)
_STEPS = ("load", "read", "find", "fit", "look", "reflectance", "light", "render", "write")


class Cost(NamedTuple):
    """Processors' seconds of a process, its peak in MB, and the seconds of its steps."""

    seconds: float
    peak_mb: float
    steps: Counter[str]


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--against", metavar="REV", help="a commit to compare with")
    parser.add_argument("--cases", nargs="+", default=_ALL, choices=_ALL)
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    with TemporaryDirectory() as temporary, worktree(given.against, Path(temporary)) as other:
        folder = Path(temporary)
        trees = [ROOT] if other is None else [ROOT, other]
        lines = {name: line_of(name, folder) for name in given.cases}
        bare = {name: ["-c", f"import {name}"] for name in ("torch", "typer, rich")}
        runs = [(tree, name, lines[name]) for tree in trees for name in lines]
        runs += [(ROOT, name, line) for name, line in bare.items()]
        best: dict[tuple[Path, str], Cost] = {}
        for _ in range(given.rounds):
            for tree, name, line in runs:
                cost = cost_of(tree, line, folder)
                best[tree, name] = min(best.get((tree, name), cost), cost, key=lambda one: one.seconds)
    print_header("", "÷ import", f"÷ {given.against}", "MB")
    for name in given.cases:
        now = best[ROOT, name]
        unit = best[ROOT, "typer, rich" if name == _HELP else "torch"].seconds
        before = "" if other is None else f"{now.seconds / best[other, name].seconds:.2f}"
        peak = (
            "" if name == _HELP else f"{now.peak_mb:.0f}"
        )  # below the peak of this process, which starts it
        print_row(name, f"{now.seconds / unit:.2f}", before, peak)
    print()
    print_header("", "in no step", *_STEPS)
    torch_s = best[ROOT, "torch"].seconds
    for tree in trees:
        for name in given.cases:
            cost = best[tree, name]
            rest = cost.seconds - cost.steps.total() + cost.steps["look"]
            cells = (rest, *(cost.steps[step] for step in _STEPS))
            if cost.steps:
                print_row(
                    name if tree == ROOT else f"{name}, {given.against}",
                    *(f"{one / torch_s:.2f}" for one in cells),
                )
    print(f"\n`import torch` took {torch_s:.2f} s")


def line_of(name: str, folder: Path) -> list[str]:
    """The arguments of python for a case."""
    if name == _HELP:
        return ["-m", "facerf_cli", "--help"]
    if name == _BOUND:
        return ["-c", _FILES_ALONE, str(enlarged(folder, 12)), str(folder / "copy")]
    side, lights = _CASES[name]
    photo = folder / f"{side}.png"
    if side:
        Image.open(ASTRONAUT).resize((side, side), Image.Resampling.BICUBIC).save(photo)
    else:
        photo = enlarged(folder, 12)
    output = ["-o", str(folder / "lit"), "--overwrite", "always"]
    return ["-m", "facerf_cli", "-v", "--log-json", "relight", str(photo), *lights, *output]


def cost_of(tree: Path, line: list[str], folder: Path) -> Cost:
    """Run python in a source tree."""
    own = {"PYTHONPATH": str(tree), "PYTHONPYCACHEPREFIX": str(folder / "bytecode"), "OMP_NUM_THREADS": "1"}
    environment = {**os.environ, **own}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, *line]
    with subprocess.Popen(
        command, cwd=tree, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        said = process.stderr.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}\n{said}")
    steps: Counter[str] = Counter()
    for row in (json.loads(text) for text in said.splitlines() if text.startswith("{")):
        if "step" in row:
            steps[row["step"]] += row["processor_seconds"]
    return Cost(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, steps)


@contextmanager
def worktree(revision: str | None, folder: Path) -> Iterator[Path | None]:
    """A checkout of a commit, while it is needed."""
    if revision is None:
        yield None
        return
    git, tree = ["git", "-C", str(ROOT), "worktree"], str(folder / "against")
    subprocess.run([*git, "add", "--quiet", "--detach", tree, revision], check=True)
    try:
        yield Path(tree)
    finally:
        subprocess.run([*git, "remove", "--force", tree], check=True)


if __name__ == "__main__":
    main()
