"""Cores and memory that a process may use, by control groups as they look on a machine and in a container."""

import math

import pytest

from jaxhf.xla import machine

GB = 10**9


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """Makes files under a root of its own: 8 cores, 64 GB."""
    monkeypatch.setattr(machine, "_ROOT", tmp_path)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)), raising=False)

    def make(**files):
        files = {"proc/meminfo": f"MemTotal: 99999999 kB\nMemAvailable: {64 * GB // 1024} kB\n", **files}
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    return make


V2, V1 = "sys/fs/cgroup", "sys/fs/cgroup/memory"


CPU = f"{V2}/cpu/a/cpu.cfs"


@pytest.mark.parametrize(
    ("files", "cores"),
    [({}, 8),
     ({"proc/self/cgroup": "0::/\n"}, 8),
     ({"proc/self/cgroup": "0::/a/b\n", f"{V2}/a/b/cpu.max": "max 100000\n", f"{V2}/a/cpu.max": "250000 100000\n"}, 3),
     ({"proc/self/cgroup": "0::/not/seen/here\n", f"{V2}/cpu.max": "50000 100000\n"}, 1),
     ({"proc/self/cgroup": "0::/\n", f"{V2}/cpu.max": "1600000 100000\n"}, 8),
     ({"proc/self/cgroup": "3:memory:/a\n2:cpu,cpuacct:/a\n0::/\n",
       f"{CPU}_quota_us": "400000\n", f"{CPU}_period_us": "100000\n"}, 4),
     ({"proc/self/cgroup": "2:cpu:/a\n", f"{CPU}_quota_us": "-1\n", f"{CPU}_period_us": "100000\n"}, 8)],
)  # fmt: skip
def test_usable_cores(tree, files, cores):
    tree(**files)
    assert machine.usable_cores() == cores


@pytest.mark.parametrize(
    ("files", "gigabytes"),
    [({}, 64),
     ({"proc/self/cgroup": "0::/\n"}, 64),
     ({"proc/self/cgroup": "0::/a/b\n", f"{V2}/a/b/memory.max": "max\n", f"{V2}/a/memory.max": f"{8 * GB}\n",
       f"{V2}/a/memory.current": f"{5 * GB}\n",
       f"{V2}/a/memory.stat": f"anon 1\nactive_file {GB}\ninactive_file {2 * GB}\n"}, 5),
     ({"proc/self/cgroup": "4:memory:/docker/abc\n1:cpu:/\n", f"{V1}/memory.limit_in_bytes": f"{4 * GB}\n",
       f"{V1}/memory.usage_in_bytes": f"{3 * GB}\n",
       f"{V1}/memory.stat": f"inactive_file 5\ntotal_inactive_file {GB}\n"}, 2),
     ({"proc/self/cgroup": "4:memory:/\n", f"{V1}/memory.limit_in_bytes": f"{2**63}\n",
       f"{V1}/memory.usage_in_bytes": f"{3 * GB}\n", f"{V1}/memory.stat": "cache 5\n"}, 64)],
)  # fmt: skip
def test_available_bytes(tree, files, gigabytes):
    tree(**files)
    assert machine.available_bytes() == pytest.approx(gigabytes * GB, abs=1024)


def test_a_system_that_does_not_say(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "_ROOT", tmp_path)
    assert machine.available_bytes() == math.inf
    assert machine.usable_cores() >= 1
