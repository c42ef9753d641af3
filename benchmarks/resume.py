"""Kills a folder verb with SIGKILL at random moments, runs it again, and compares the trees byte by byte.

    python benchmarks/resume.py -- facerf relight examples -o {out} --envmap examples/maps/low_sun.exr

`{out}` is replaced by a fresh folder; `{copy:PATH}` by a fresh copy of PATH, which then is what is compared
(for verbs that write into their input). Reports are left out, for they hold timings.
"""

import argparse
import hashlib
import os
import random
import re
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path


def run(command: list[str], folder: Path, kill_after_s: float | None = None) -> float:
    """Run the command over `folder`; give how long it took. Killed with all its children where asked."""
    filled = [_fill(word, folder) for word in command]
    begin = time.monotonic()
    process = subprocess.Popen(
        filled, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        code = process.wait(kill_after_s)
        assert code == 0, f"exit {code}: {' '.join(filled)}"
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return time.monotonic() - begin


def _fill(word: str, folder: Path) -> str:
    copied = re.fullmatch(r"\{copy:(.*)\}", word)
    if copied and not folder.exists():
        shutil.copytree(copied[1], folder)
    return str(folder) if copied else word.replace("{out}", str(folder))


def tree(folder: Path) -> dict[str, str]:
    """Every file's digest by its path."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "report.jsonl"]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--times", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("command", nargs="+")
    options = parser.parse_args()
    draw = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as scratch:
        whole = Path(scratch) / "whole"
        seconds = run(options.command, whole)
        truth = tree(whole)
        print(f"whole run: {seconds:.1f} s, {len(truth)} files")
        for _ in range(options.times):
            folder = Path(scratch) / "killed"
            killed_at = draw.uniform(0.05, 1.0) * seconds
            run(options.command, folder, killed_at)
            left = len(tree(folder)) if folder.exists() else 0
            run(options.command, folder)
            resumed = tree(folder)
            wrong = sorted(name for name in truth | resumed if truth.get(name) != resumed.get(name))
            print(f"killed at {killed_at:6.1f} s with {left} files; resumed: {len(wrong)} differ {wrong[:3]}")
            assert not wrong
            shutil.rmtree(folder)


if __name__ == "__main__":
    main()
