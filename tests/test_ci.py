"""`.ci/run` runs all checks, and fails if there is no browser for the tests of the viewer."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run_ci(folder: Path, **programs: str) -> subprocess.CompletedProcess[str]:
    """Run `.ci/run` with these programs only, each a line of sh."""
    for name, body in programs.items():
        (folder / name).write_text(f"#!/bin/sh\n{body}\n")
        (folder / name).chmod(0o755)
    for name in ("bash", "dirname", "ln"):
        (folder / name).symlink_to(str(shutil.which(name)))
    return subprocess.run([ROOT / ".ci/run"], env={"PATH": str(folder)}, capture_output=True, text=True)


@pytest.mark.parametrize("fails", ["nothing", "test-slow"])
@pytest.mark.parametrize("browser", ["chromium", "google-chrome"])
def test_a_check_that_fails_ends_the_run(tmp_path: Path, browser: str, fails: str) -> None:
    done = run_ci(tmp_path, make=f'echo "make $1"; [ "$1" != {fails} ]', **{browser: "true"})
    assert (done.returncode == 0) == (fails == "nothing"), done.stderr
    made = ["make check", "make test-slow", "make docs"]
    assert done.stdout.splitlines() == made[: 3 if fails == "nothing" else 2]


def test_a_missing_browser_is_installed_or_the_run_fails(tmp_path: Path) -> None:
    for name, install, code in (("a", "true", 1), ("b", f'ln -sf bash "{tmp_path}/b/chromium"', 0)):
        (tmp_path / name).mkdir()
        done = run_ci(tmp_path / name, make="true", **{"apt-get": install})
        assert done.returncode == code and ("install chromium" in done.stderr) == bool(code), done.stderr
