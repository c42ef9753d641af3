"""Faults that the tests must notice: each mutant of `mutants.txt` changes one line, and a test fails.

    python -m tests.mutants [PART OF A NAME OR FILE]    # copies the package, changes it, runs the tests

Every line that is printed is a mutant, killed or SURVIVED; the exit status counts the survivors.
"""

import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

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
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in ("pyproject.toml", "README.md", "MODEL_CARD.md"):
            shutil.copy(ROOT / name, copy / name)
        path = copy / "facerf_cli" / mutant.file
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-x",
            "-p",
            "no:cacheprovider",
            *mutant.tests.split(),
        ]
        try:
            done = subprocess.run(command, cwd=copy, capture_output=True, timeout=_SECONDS, check=False)
        except subprocess.TimeoutExpired:
            return True
        if done.returncode not in (0, 1):
            raise RuntimeError(f"{mutant.name}: {done.stdout.decode()[-800:]}{done.stderr.decode()[-800:]}")
        return done.returncode == 1


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
