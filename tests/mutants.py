"""Faults that the tests must notice: each mutant of `mutants.txt` changes one line, and a test fails.

    python -m tests.mutants [PART OF A NAME OR FILE]    # copies the package, changes it, runs the tests

Every line that is printed is a mutant, killed or SURVIVED; the exit status counts the survivors.
"""

import os
import shutil
import signal
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import OpenImageIO  # noqa: F401  (for the forks, as the others)
import pytest
import scipy.spatial  # noqa: F401
import torch  # noqa: F401
import trimesh  # noqa: F401

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "facerf_cli"
LIST = Path(__file__).with_suffix(".txt")
_SECONDS = 900  # that a mutant's tests may take; a mutant that hangs is noticed, too


@dataclass(frozen=True)
class Mutant:
    """In `file`, `old` becomes `new`; `tests` (pytest's arguments) must fail."""

    name: str
    file: str
    old: str
    new: str
    tests: str


def read_mutants() -> list[Mutant]:
    """Read the list; its form is explained at its top."""
    found: list[Mutant] = []
    file = tests = name = old = ""
    for line in LIST.read_text(encoding="utf-8").splitlines():
        kind, _, rest = line.partition(" ")
        match kind:
            case "FILE":
                file = rest
            case "TESTS":
                tests = rest
            case "#":
                name = rest
            case "-":
                old = rest
            case "+":
                found.append(Mutant(name, file, old, rest, tests))
    return found


def killed(mutant: Mutant) -> bool:
    """Tell whether the mutant's tests fail on a changed copy of the package."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in ("facerf_cli", "tests", "examples"):
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, copy / name, ignore=ignored, copy_function=linked)
        for name in ("pyproject.toml", "README.md", "MODEL_CARD.md"):
            shutil.copy(ROOT / name, copy / name)
        path = copy / "facerf_cli" / mutant.file
        text = path.read_text(encoding="utf-8")
        path.unlink()
        path.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
        code, said = tested(copy, mutant.tests.split())
        if code not in (0, 1, -signal.SIGALRM):
            raise RuntimeError(f"{mutant.name}: {said[-1600:]}")
        return code != 0


def linked(source: str, target: str) -> None:
    """Name a file twice where the disk can, otherwise copy it: its assets are large."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy(source, target)


def tested(copy: Path, tests: list[str]) -> tuple[int, str]:
    """Run tests of a copy in a fork of this process, which has what is slow to import: exit code and output.

    A fork that hangs ends by SIGALRM.
    """
    with tempfile.TemporaryFile("w+", errors="replace") as output:
        child = os.fork()
        if not child:
            signal.alarm(_SECONDS)
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
            os.chdir(copy)
            sys.path[0] = str(copy)
            for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
                del sys.modules[name]
            os._exit(pytest.main(["-q", "-x", "-p", "no:cacheprovider", *tests]))
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        output.seek(0)
        return code, output.read()


def main(part: str = "") -> int:
    """Run the mutants whose name or file holds `part`; return how many survive."""
    chosen = [m for m in read_mutants() if part in m.name or part in m.file]
    survivors = 0
    for mutant in chosen:
        dead = killed(mutant)
        survivors += not dead
        print(f"{'killed  ' if dead else 'SURVIVED'}  {mutant.file}: {mutant.name}", flush=True)
    print(f"{len(chosen)} mutants, {survivors} survived")
    return survivors


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:2]))
