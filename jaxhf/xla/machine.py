"""What this machine has: cores, memory."""

import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path

_ROOT = Path("/")


def usable_cores() -> int:
    """Of the CPU, that this process may use: by its affinity, and by the quotas of its control groups (containers have one)."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for group in _control_groups("cpu"):
        quota, period = _numbers(group / "cpu.max") or (
            _number(group / "cpu.cfs_quota_us"),
            _number(group / "cpu.cfs_period_us"),
        )
        if 0 < quota < math.inf:  # -1: none
            cores = min(cores, math.ceil(quota / period))
    return cores


def default_devices() -> int:
    """How many devices share the work where nobody says: each of a CPU's has a copy of the terrain."""
    return min(usable_cores(), 16)


def available_bytes() -> float:
    """Of memory, caches that the system would give up included; without end where the system does not say (not Linux).

    The least of the machine's and of what the limits of the control groups leave.
    """
    said = _ROOT / "proc/meminfo"
    if not said.exists():
        return math.inf
    least = next(1024.0 * int(line.split()[1]) for line in said.read_text().splitlines() if line.startswith("MemAvailable"))
    for group in _control_groups("memory"):
        for limit, usage, cached in (
            ("memory.max", "memory.current", "inactive_file"),
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        ):
            most = _number(group / limit)
            if most < math.inf:
                lines = (group / "memory.stat").read_text().splitlines()
                given_up = sum(int(line.split()[1]) for line in lines if line.split()[0] == cached)
                least = min(least, max(0.0, most - _number(group / usage) + given_up))
    return least


def _control_groups(controller: str) -> Iterator[Path]:
    """The folders of this process's control group and of those round it, whose limits all count.

    Of version 2, whose line in /proc/self/cgroup names no controller, and of version 1. In a container such a folder may not
    exist, and the container's own group is mounted as the outermost one.
    """
    said, mounted = _ROOT / "proc/self/cgroup", _ROOT / "sys/fs/cgroup"
    for line in said.read_text().splitlines() if said.exists() else ():
        _, controllers, path = line.split(":", 2)
        if not controllers or controller in controllers.split(","):
            base = mounted / controller if controllers else mounted
            group = base / path.lstrip("/")
            yield from (folder for folder in (group, *group.parents) if folder.is_relative_to(base))


def _numbers(path: Path) -> list[float]:
    """Those in a control group's file, infinite for "max"; none where there is no such file."""
    return [math.inf if word == "max" else float(word) for word in path.read_text().split()] if path.exists() else []


def _number(path: Path) -> float:
    return next(iter(_numbers(path)), math.inf)


def peak_mb() -> float:
    """The most memory that this process has held so far, Python and JAX themselves included, MiB."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux hands ru_maxrss down from the process that started this one
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    import resource  # not on Windows

    unit = 2**20 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
