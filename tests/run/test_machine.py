"""Processors and memory that a process may use: affinity, and limits of cgroups in trees of files."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from facerf_cli.run import machine
from tests.kinds import Patch

ALL, SOME, FEW = 64 << 30, 16 << 30, 8 << 30
UNLIMITED_V1 = 9223372036854771712


@pytest.fixture(autouse=True)
def _a_large_machine(monkeypatch: Patch, tmp_path: Path) -> None:
    sizes = {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": ALL // 4096}
    monkeypatch.setattr(machine.os, "sysconf", sizes.get)
    monkeypatch.setattr(machine, "_PROC", tmp_path)


def tell(folder: Path, cgroup: str, *mounts: str) -> None:
    """Write what /proc/self says; `mounts` are root, mount point, options, type, source and options."""
    (folder / "cgroup").write_text(cgroup)
    lines = ["22 28 0:20 / /sys rw - sysfs sysfs rw", *(f"31 23 0:28 {mount}" for mount in mounts)]
    (folder / "mountinfo").write_text("\n".join(lines))


def limit(folder: Path, value: object, name: str = "memory.max") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(f"{value}\n")


def test_without_cgroups_all_memory_counts() -> None:
    assert machine.memory_bytes() == ALL


@pytest.mark.parametrize(("of_step", "of_job", "of_slice", "found"), [
    (FEW, "max", SOME, FEW), ("max", FEW, SOME, FEW), ("max", SOME, FEW, FEW), ("max", "max", "max", ALL),
    (2 * ALL, "", "many", ALL), ("0", -1, "9" * 5000, ALL), (FEW, "max", "\0", FEW),
])  # fmt: skip
def test_the_narrowest_group_of_version_2_counts(
    of_step: object, of_job: object, of_slice: object, found: int, tmp_path: Path
) -> None:
    top = tmp_path / "sys"
    tell(tmp_path, "0::/system.slice/job_7/step_0\n", f"/ {top} rw shared:4 - cgroup2 cgroup2 rw")
    limit(top / "system.slice", of_slice)
    limit(top / "system.slice" / "job_7", of_job)
    limit(top / "system.slice" / "job_7" / "step_0", of_step)
    limit(top / "system.slice" / "job_8", 1)  # another's
    assert machine.memory_bytes() == found


def test_version_1_has_a_tree_for_memory_alone(tmp_path: Path) -> None:
    name, processors, top = "memory.limit_in_bytes", tmp_path / "cpu", tmp_path / "memory"
    tell(
        tmp_path,
        "12:cpu,cpuacct:/user\n5:memory:/slurm/uid_1/job_7\n1:name=systemd:/user\n0::/\n",
        f"/ {processors} rw - cgroup cgroup rw,cpu,cpuacct",
        f"/ {top} rw - cgroup cgroup rw,memory",
        f"/ {tmp_path / 'unified'} rw - cgroup2 none rw",
    )
    limit(top, UNLIMITED_V1, name)
    limit(top / "slurm" / "uid_1" / "job_7", SOME, name)
    limit(top / "user", 1, name)  # not where this process is
    assert machine.memory_bytes() == SOME
    limit(top / "slurm", FEW, name)
    assert machine.memory_bytes() == FEW


@pytest.mark.parametrize(("path", "top", "at"), [
    ("/docker/7", "/docker/7", ""), ("/docker/7/job", "/docker/7", "job"), ("/docker/7", "/", ""),
    ("/", "/docker/7", ""), ("/../other", "/", ""), ("/job:1 (deleted)", "/", ""),
])  # fmt: skip
def test_a_container_sees_its_own_group_as_the_top(path: str, top: str, at: str, tmp_path: Path) -> None:
    mount = tmp_path / "mounted"
    tell(tmp_path, f"0::{path}\n", f"{top} {mount} ro - cgroup2 cgroup rw")
    limit(mount / at, FEW)
    assert machine.memory_bytes() == FEW


@pytest.mark.parametrize(("cgroup", "mount"), [
    ("", ""), ("0::/\n", "/"), ("garbage\n::\n0:\n", "- -"), ("0::\0\n", "/ /sys rw - cgroup2 cgroup2 rw"),
    ("0::\n", "/ \0 rw - cgroup2"), ("0::/\n", " - cgroup2 cgroup2 rw"),
])  # fmt: skip
def test_what_makes_no_sense_is_passed_by(cgroup: str, mount: str, tmp_path: Path) -> None:
    tell(tmp_path, cgroup, mount)
    assert machine.memory_bytes() == ALL
    (tmp_path / "mountinfo").write_bytes(b"\xff\xfe\n\xff - \xff\n")
    assert machine.memory_bytes() == ALL


def test_processors_are_those_of_the_affinity() -> None:
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("this system has no affinity")
    code = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from facerf_cli.run.machine import processors; print(processors())"
    )
    command = [sys.executable, "-c", code]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "1\n"


@pytest.mark.parametrize(("newer", "older", "count"), [(3, {1, 2}, 3), (None, {1, 2}, 2), (None, None, 8)])
def test_the_best_answer_that_this_python_has(
    newer: int | None, older: set[int] | None, count: int, monkeypatch: Patch
) -> None:
    answers = {
        "process_cpu_count": newer and (lambda: newer),
        "sched_getaffinity": older and (lambda _: older),
    }
    for name, answer in answers.items():
        monkeypatch.setattr(machine.os, name, answer, raising=False)
    monkeypatch.setattr(machine.os, "cpu_count", lambda: 8)
    assert machine.processors() == count
