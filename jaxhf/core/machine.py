"""What this machine has: cores, memory."""

import math
import os
import sys
from pathlib import Path


def usable_cores() -> int:
    """Of the CPU, that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_devices() -> int:
    """How many devices share the work where nobody says: each of a CPU's has a copy of the terrain."""
    return min(usable_cores(), 16)


def available_bytes() -> float:
    """Of memory, caches that the system would give up included; without end where the system does not say (not Linux)."""
    said = Path("/proc/meminfo")
    if not said.exists():
        return math.inf
    return next(1024.0 * int(line.split()[1]) for line in said.read_text().splitlines() if line.startswith("MemAvailable"))


def peak_mb() -> float:
    """The most memory that this process has held so far, Python and JAX themselves included, MiB."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux hands ru_maxrss down from the process that started this one
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    import resource  # not on Windows

    unit = 2**20 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
