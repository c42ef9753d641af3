"""What `.ci/run` prints at its end."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("browser", [None, "chromium", "google-chrome"])
@pytest.mark.parametrize("fails", ["nothing", "test-slow"])
def test_the_last_line_says_that_no_browser_ran_the_viewer(
    tmp_path: Path, browser: str | None, fails: str
) -> None:
    programs = {"make": f'echo "make $1"; [ "$1" != {fails} ]'} | ({browser: "true"} if browser else {})
    for name, body in programs.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{body}\n")
        (tmp_path / name).chmod(0o755)
    for name in ("bash", "dirname"):  # and no apt-get
        (tmp_path / name).symlink_to(str(shutil.which(name)))
    done = subprocess.run([ROOT / ".ci/run"], env={"PATH": str(tmp_path)}, capture_output=True, text=True)
    assert (done.returncode == 0) == (fails == "nothing"), done.stderr
    made, said = ["make test", "make test-slow", "make docs"], done.stdout.splitlines()
    count = 3 if fails == "nothing" else 2
    assert said[:count] == made[:count] and len(said) == count + (browser is None)
    assert ("skipped" in said[-1]) == (browser is None)
