"""What a container's limits leave of a machine with 8 cores and 16 GiB."""

import os
import platform
import subprocess
import sys
import types
from collections.abc import Callable, Mapping
from pathlib import Path

import psutil
import pytest

from mjx_balance import machine
from mjx_balance.machine import available_memory, cores

GIB = 2**30
V2 = "0::/box\n"
V1 = "5:memory:/box\n4:cpu,cpuacct:/box\n1:name=systemd:/box\n0::/\n"
Limit = Callable[[str, Mapping[str, object]], tuple[int, float]]


@pytest.fixture
def limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Limit:
    """Membership, files below the mount of the control groups -> cores, and GiB that are left."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    memory = types.SimpleNamespace(available=16 * GIB)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)
    monkeypatch.setattr(machine, "CONTROL_GROUPS", tmp_path / "mount")
    monkeypatch.setattr(machine, "MEMBERSHIP", tmp_path / "membership")

    def limit(membership: str, files: Mapping[str, object]) -> tuple[int, float]:
        (tmp_path / "membership").write_text(membership, "utf-8")
        for name, content in files.items():
            path = tmp_path / "mount" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{content}\n", "utf-8")
        return cores(), available_memory() / GIB

    return limit


def test_without_limits_the_machine_counts(limit: Limit) -> None:
    files = {"box/cpu.max": "max 100000", "box/memory.max": "max", "box/memory.current": 5}
    assert limit(V2, files) == (8, 16)
    files = {
        "cpu/box/cpu.cfs_quota_us": -1,
        "cpu/box/cpu.cfs_period_us": 100000,
        "memory/box/memory.limit_in_bytes": 9223372036854771712,
        "memory/box/memory.usage_in_bytes": 5,
    }
    assert limit(V1, files) == (8, 16)
    assert limit("", {}) == (8, 16), "macOS and Windows"


def test_a_container_of_version_2_is_seen(limit: Limit) -> None:
    """1.5 cores need two threads; 3 of 4 GiB are used, but for 1 GiB of cached files."""
    files = {
        "box/cpu.max": "150000 100000",
        "box/memory.max": 4 * GIB,
        "box/memory.current": 3 * GIB,
        "box/memory.stat": f"anon {2 * GIB}\ninactive_file {GIB}\nactive_file 7",
    }
    assert limit(V2, files) == (2, 2)


def test_a_container_of_version_1_is_seen(limit: Limit) -> None:
    files = {
        "cpu/box/cpu.cfs_quota_us": 300000,
        "cpu/box/cpu.cfs_period_us": 100000,
        "memory/box/memory.limit_in_bytes": 900 * 2**20,
        "memory/box/memory.usage_in_bytes": 100 * 2**20,
        "memory/box/memory.stat": f"inactive_file 0\ntotal_inactive_file {28 * 2**20}",
    }
    assert limit(V1, files) == (3, 828 / 1024)


def test_the_narrowest_of_nested_groups_counts(limit: Limit) -> None:
    """A pod that holds a container, and a container that sees its own group as the root."""
    files = {
        "pod/box/cpu.max": "600000 100000",
        "pod/cpu.max": "400000 100000",
        "pod/memory.max": 2 * GIB,
        "pod/memory.current": 0,
        "pod/box/memory.max": 3 * GIB,
        "pod/box/memory.current": 0,
    }
    assert limit("0::/pod/box\n", files) == (4, 2)
    assert limit("0::/docker/0123abcd\n", {"cpu.max": "50000 100000"}) == (1, 16)


def test_more_used_than_allowed_leaves_nothing(limit: Limit) -> None:
    """As after a limit was lowered."""
    assert limit(V2, {"box/memory.max": GIB, "box/memory.current": 2 * GIB}) == (8, 0)


COUNT_HEAPS = """
import ctypes, sys, threading
from mjx_balance.machine import share_heap

share_heap()
libc = ctypes.CDLL(None)
libc.fopen.restype = ctypes.c_void_p
barrier = threading.Barrier(9)

def allocate():
    libc.malloc(10_000)
    barrier.wait()

for _ in range(8):
    threading.Thread(target=allocate, daemon=True).start()
barrier.wait()
file = ctypes.c_void_p(libc.fopen(sys.argv[1].encode(), b"w"))
libc.malloc_info(0, file)
libc.fclose(file)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="malloc_info is glibc's")
def test_threads_share_one_heap(tmp_path: Path) -> None:
    file = tmp_path / "heaps.xml"
    subprocess.run([sys.executable, "-c", COUNT_HEAPS, file], check=True)
    assert file.read_text().count("<heap ") == 1
