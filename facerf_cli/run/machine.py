"""Processors and memory that this process may use, as limited by affinity, Slurm or a container."""

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_PROC = Path("/proc/self")
_LIMITS = {"cgroup": ("memory", "memory.limit_in_bytes"), "cgroup2": ("", "memory.max")}  # versions 1 and 2


def processors() -> int:
    """Count the processors that this process may run on."""
    if count := getattr(os, "process_cpu_count", None):  # since Python 3.13
        return int(count() or 1)
    if affinity := getattr(os, "sched_getaffinity", None):  # Linux
        return len(affinity(0))
    return os.cpu_count() or 1


def memory_bytes() -> int:
    """Return the memory of the machine, or of the narrowest cgroup around this process."""
    return min([os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *_cgroup_limits()])


def _cgroup_limits() -> Iterator[int]:
    """Yield the limits in bytes of the cgroup of this process and of its ancestors; see cgroups(7)."""
    with suppress(OSError, ValueError):  # not Linux
        groups, mounts = ((_PROC / name).read_text(errors="replace") for name in ("cgroup", "mountinfo"))
        rows = [line.split(":", 2) for line in groups.splitlines()]
        paths = {name: path for _, names, path in rows for name in names.split(",")}  # '' is version 2
        for line in mounts.splitlines():
            mount, _, kind = line.partition(" - ")
            name, file = _LIMITS.get(kind.split(" ")[0], ("", ""))
            if file and name in paths:
                top, point = mount.split(" ")[3:5]
                # In a container the path may lie outside the mount; then the mount's own limit applies.
                folder = Path(point, os.path.relpath(paths[name], top))
                for cgroup in (folder, *folder.parents):
                    with suppress(OSError, ValueError):  # none there, or "max"
                        if (limit := int((cgroup / file).read_text())) > 0:
                            yield limit
