"""CPU and wall seconds of a photo's first image, of 150 OLATs and of folders, and the steps that take them.

    python benchmarks/first_image.py [--against REV] [--cases "360 px, a light"] [--rounds 3]

Each line is a new process with one thread for each of torch's pools; the lines, and those of the commit REV
in a worktree, take turns, and the least of the rounds counts. Bytecode is cached, as in an installation.
`÷ import` is CPU time over that of `import torch`, for `facerf --help` over that of `import typer, rich`.
Steps are those that `facerf -v --log-json` prints; `look`, a part of reflectance that runs beside the rest of
it, stands alone as well. What is in no step is the command line and imports. The bound of 12 megapixels is
what files alone take: a photo is read, multiplied once and written as EXR and PNG. A folder has 12 photos of
360 pixels; for "one more photo", their results exist and a 13th photo is added.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from _common import ASTRONAUT, ROOT, arguments, enlarged, print_header, print_row
from PIL import Image

_LIGHT, _MAP = ("--light", "60,30"), ("--envmap", str(ROOT / "examples" / "maps" / "studio.exr"))
_CASES = {
    "360 px, a light": (360, ("relight", *_LIGHT)),
    "1024 px, a light": (1024, ("relight", *_LIGHT)),
    "1024 px, a map": (1024, ("relight", *_MAP)),
    "12 megapixels, a map": (0, ("relight", *_MAP)),
    "512 px, 150 OLATs": (512, ("predict-olat", "--lights", "150")),
}
_PHOTOS, _SIDE_PX = 12, 360
_FOLDER, _ONE_MORE = "a folder of 12 photos", "one more photo in a folder"
_HELP, _BOUND = "help", "12 megapixels, the bound"
_FILES_ALONE = """
import sys, pathlib
from facerf_cli.files import read, write
pixels, path = read.read_image(pathlib.Path(sys.argv[1])).pixels, pathlib.Path(sys.argv[2])
write.write_exr(path.with_suffix(".exr"), pixels * 0.5)
write.write_display(path.with_suffix(".png"), pixels)
"""
_ALL = (*_CASES, _FOLDER, _ONE_MORE, _BOUND, _HELP)
_STEPS = ("load", "read", "find", "fit", "look", "reflectance", "light", "render", "write")


class Cost(NamedTuple):
    """CPU and wall seconds of a process, its peak in MB, and the CPU seconds of its steps."""

    seconds: float
    wall_s: float
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
        if _ONE_MORE in given.cases:
            make_results(trees, folder)
        bare = {name: ["-c", f"import {name}"] for name in ("torch", "typer, rich")}
        runs = [(tree, name, lines[name]) for tree in trees for name in lines]
        runs += [(ROOT, name, line) for name, line in bare.items()]
        best: dict[tuple[Path, str], Cost] = {}
        for _ in range(given.rounds):
            for tree, name, line in runs:
                if name == _ONE_MORE:
                    shutil.rmtree(folder / "more", ignore_errors=True)
                    shutil.copytree(results_of(tree, folder), folder / "more")
                cost = cost_of(tree, line, folder)
                before = best.get((tree, name), cost)
                least = min(before, cost, key=lambda one: one.seconds)
                best[tree, name] = least._replace(wall_s=min(before.wall_s, cost.wall_s))
    against = [] if other is None else [f"{one} ÷ {given.against}" for one in ("CPU", "wall", "MB")]
    print_header("", "CPU s", "wall s", "÷ import", *against, "MB")
    for name in given.cases:
        now = best[ROOT, name]
        unit = best[ROOT, "typer, rich" if name == _HELP else "torch"].seconds
        ratios = []
        if other is not None:
            then = best[other, name]
            pairs = zip(now[:3], then[:3], strict=True)
            ratios = [f"{one / another:.2f}" for one, another in pairs]
        peak = "" if name == _HELP else f"{now.peak_mb:.0f}"  # help: below the peak of this process
        print_row(name, f"{now.seconds:.2f}", f"{now.wall_s:.2f}", f"{now.seconds / unit:.2f}", *ratios, peak)
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
    facerf = ["-m", "facerf_cli", "-v", "--log-json"]
    if name == _ONE_MORE:
        return [*facerf, "relight", str(folder / "photos"), *_LIGHT, "-o", str(folder / "more")]
    output = ["-o", str(folder / "lit"), "--overwrite", "always"]
    if name == _FOLDER:
        twelve = folder / "twelve"
        write_photos(twelve, range(_PHOTOS))
        return [*facerf, "relight", str(twelve), *_LIGHT, *output]
    side, (verb, *options) = _CASES[name]
    photo = folder / f"{side}.png"
    if side:
        Image.open(ASTRONAUT).resize((side, side), Image.Resampling.BICUBIC).save(photo)
    else:
        photo = enlarged(folder, 12)
    return [*facerf, verb, str(photo), *options, *output]


def write_photos(folder: Path, numbers: range) -> None:
    """Write copies of the astronaut's photo that differ in a pixel."""
    folder.mkdir(exist_ok=True)
    photo = Image.open(ASTRONAUT).convert("RGB").resize((_SIDE_PX, _SIDE_PX), Image.Resampling.BICUBIC)
    for number in numbers:
        photo.putpixel((0, 0), (number, number, number))
        photo.save(folder / f"photo_{number:02d}.png")


def make_results(trees: list[Path], folder: Path) -> None:
    """Relight 12 photos with each source tree, then add one photo to their folder."""
    photos = folder / "photos"
    write_photos(photos, range(_PHOTOS))
    for tree in trees:
        line = ["-m", "facerf_cli", "relight", str(photos), *_LIGHT, "-o", str(results_of(tree, folder))]
        cost_of(tree, line, folder)
    write_photos(photos, range(_PHOTOS, _PHOTOS + 1))


def results_of(tree: Path, folder: Path) -> Path:
    """The folder of the results of a source tree."""
    return folder / ("now" if tree == ROOT else "then")


def cost_of(tree: Path, line: list[str], folder: Path) -> Cost:
    """Run python in a source tree."""
    own = {"PYTHONPATH": str(tree), "PYTHONPYCACHEPREFIX": str(folder / "bytecode"), "OMP_NUM_THREADS": "1"}
    environment = {**os.environ, **own}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, *line]
    start_s = time.perf_counter()
    with subprocess.Popen(
        command, cwd=tree, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        said = process.stderr.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    wall_s = time.perf_counter() - start_s
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}\n{said}")
    steps: Counter[str] = Counter()
    for row in (json.loads(text) for text in said.splitlines() if text.startswith("{")):
        if "step" in row:
            steps[row["step"]] += row["processor_seconds"]
    return Cost(usage.ru_utime + usage.ru_stime, wall_s, usage.ru_maxrss / 1024, steps)


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
