"""Files that `pip install` lays down: both distributions hold what is promised, and no more."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest

from facerf_cli import __version__

ROOT = Path(__file__).parents[1]
NOT_SOURCE = shutil.ignore_patterns(
    ".git", ".venv", "__pycache__", ".*_cache", "build", "dist", "out", "runs", "*.egg-info"
)
LIMIT_MIB = 60
DATA = f"facerf-{__version__}.data/data"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the source distribution, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("built")
    shutil.copytree(ROOT, folder / "source", ignore=NOT_SOURCE)
    build(folder)
    return folder


def build(folder: Path, *only: str) -> None:
    """Build the distributions of folder/source into a folder."""
    command = [sys.executable, "-m", "build", "--no-isolation", *only, "--outdir", str(folder), "."]
    done = subprocess.run(command, cwd=folder / "source", capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


@pytest.fixture(scope="module")
def wheel(built: Path) -> zipfile.ZipFile:
    return zipfile.ZipFile(built / f"facerf-{__version__}-py3-none-any.whl")


@pytest.fixture(scope="module")
def metadata(wheel: zipfile.ZipFile) -> Message:
    return Parser().parsestr(wheel.read(f"facerf-{__version__}.dist-info/METADATA").decode())


def tracked(pattern: str) -> set[str]:
    """Files of the source tree, as paths from its root."""
    return {path.relative_to(ROOT).as_posix() for path in ROOT.glob(pattern) if path.is_file()}


def test_the_wheel_has_all_of_the_package_and_its_documents(wheel: zipfile.ZipFile) -> None:
    package = {name for name in tracked("facerf_cli/**/*") if "__pycache__" not in name}
    information = f"facerf-{__version__}.dist-info/"
    rest = {name for name in wheel.namelist() if not name.startswith((information, DATA))}
    assert rest == package and "facerf_cli/py.typed" in rest and "facerf_cli/assets/NOTICE" in rest
    assert Path(str(wheel.filename)).stat().st_size < LIMIT_MIB * 2**20
    shared = {name.removeprefix(f"{DATA}/share/") for name in wheel.namelist() if name.startswith(DATA)}
    assert shared == (
        {f"man/man1/{Path(name).name}" for name in tracked("man/*.1")}
        | {f"doc/facerf/{name}" for name in tracked("docs/**/*") | tracked("examples/**/*")}
        | {f"doc/facerf/{name}" for name in ("README.md", "MODEL_CARD.md", "CHANGELOG.md")}
    )
    assert "man/man1/facerf-relight.1" in shared


def test_the_metadata_describe_it(metadata: Message, wheel: zipfile.ZipFile) -> None:
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert str(metadata.get_payload()).strip() == (ROOT / "README.md").read_text().strip()
    assert metadata["License-Expression"] == "MIT AND CC0-1.0 AND Apache-2.0"
    for name in ("LICENSE", "facerf_cli/assets/NOTICE"):
        held = wheel.read(f"facerf-{__version__}.dist-info/licenses/{name}")
        assert name in metadata.get_all("License-File", []) and held == (ROOT / name).read_bytes()
    needed = [line for line in metadata.get_all("Requires-Dist", []) if "extra ==" not in line]
    assert any(line.startswith("torch") for line in needed)
    assert not re.search(r"pytest|mypy|ruff|nbclient|mitsuba|ray", " ".join(needed))


def test_the_source_distribution_has_what_the_tests_read_and_no_cache(built: Path) -> None:
    with tarfile.open(built / f"facerf-{__version__}.tar.gz") as archive:
        names = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
    for folder in ("tests/**", "docs", "examples/**", "man", "benchmarks", "tools"):
        assert {name for name in tracked(f"{folder}/*") if "__pycache__" not in name} <= names
    assert {
        "Makefile",
        "constraints.txt",
        "CHANGELOG.md",
        "MODEL_CARD.md",
        ".ci/run",
        "Dockerfile",
        ".dockerignore",
    } <= names
    assert not [name for name in names if name.endswith((".pyc", ".pyo")) or "_cache" in name]


def test_the_dockerfile_copies_all_that_the_wheel_holds(wheel: zipfile.ZipFile) -> None:
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    copies = [line.split()[1:] for line in text.splitlines() if line.startswith(("COPY", "ADD"))]
    copied = {source for *sources, _ in copies for source in sources}
    for *sources, target in copies:
        assert target == "/src/" or [target] == [f"/src/{source}" for source in sources]
    held = {
        name.removeprefix(f"{DATA}/share/doc/facerf/")
        for name in wheel.namelist()
        if ".dist-info/" not in name
    }
    held = {name.replace(f"{DATA}/share/man/man1", "man") for name in held} | {
        "pyproject.toml",
        "MANIFEST.in",
    }
    assert not {name for name in held if not copied & {name, name.partition("/")[0]}}
    assert not copied & set((ROOT / ".dockerignore").read_text().split())


def test_the_installed_wheel_runs_away_from_its_source(built: Path, wheel: zipfile.ZipFile) -> None:
    prefix = built / "installed"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-compile"]
    command += ["--ignore-installed", "--prefix", str(prefix), str(wheel.filename)]
    subprocess.run(command, check=True, capture_output=True)
    packages = next(prefix.glob("**/facerf_cli/py.typed")).parents[1]
    environment = os.environ | {"PYTHONPATH": str(packages)}
    script = next(prefix.glob("**/bin/facerf"))
    done = subprocess.run(
        [str(script), "doctor"], cwd=built / "installed", env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr  # a missing asset fails
    assert f"{__version__}" in done.stdout
    assert next(prefix.glob("**/share/man/man1/facerf.1")).is_file()
