"""Modules that lie in the working directory, perhaps somebody else's, are never imported."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.files.sandbox import read_in_subprocess
from tests.kinds import Folders, Patch

STRANGERS = ("json", "numpy", "torch", "multiprocessing", "signal")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: Patch) -> Path:
    """A working directory with modules that leave a mark when they are imported."""
    for name in STRANGERS:
        mark = f"open({str(tmp_path / f'{name}.imported')!r}, 'w')\nraise SystemExit('a stranger')\n"
        (tmp_path / f"{name}.py").write_text(mark)
    for name in ("a", "b"):
        (tmp_path / f"{name}.png").write_bytes(b"no image")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(script: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command line by a script, as pip installs it: its own folder is first on the path."""
    script.write_text('from facerf_cli.main import run\nif __name__ == "__main__":\n    run()\n')
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    return subprocess.run(
        [sys.executable, str(script), *arguments], env=environment, capture_output=True, text=True
    )


def imported(folder: Path) -> list[str]:
    return [path.name for path in folder.glob("*.imported")]


def send_pi(path: Path) -> dict[str, np.ndarray]:
    return {"pi": np.array(3.14)}


def test_a_reader_in_its_own_process_imports_none(folder: Path) -> None:
    assert read_in_subprocess(send_pi, folder / "a.png")["pi"] == 3.14
    assert not imported(folder)


def test_workers_import_none(folder: Path, tmp_path_factory: Folders) -> None:
    script = tmp_path_factory.mktemp("bin") / "facerf"
    ended = run(script, "segment", "a.png", "b.png", "-o", "out", "--jobs", "2")
    assert ended.returncode == 1 and ended.stderr.count("a.png") and ended.stderr.count("b.png"), ended.stderr
    assert not imported(folder)


def test_processes_start_in_known_files() -> None:
    """`run` sets PYTHONSAFEPATH for all that multiprocessing starts; another way needs its test here."""
    package = Path(__file__).parents[1] / "facerf_cli"
    starts = re.compile(r"\bsubprocess\.|get_context|Popen|num_workers=|os\.(system|fork|exec)")
    files = {file for file in package.rglob("*.py") if starts.search(file.read_text())}
    known = {"files/sandbox.py", "run/workers.py", "training/loop.py"}
    assert {file.relative_to(package).as_posix() for file in files} == known
