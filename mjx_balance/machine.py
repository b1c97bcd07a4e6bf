"""What this process may use of the machine, or of the container that it runs in."""

import contextlib
import ctypes
import math
import os
from collections.abc import Iterator
from pathlib import Path

CONTROL_GROUPS = Path("/sys/fs/cgroup")  #: by which Linux limits containers, version 1 or 2
MEMBERSHIP = Path("/proc/self/cgroup")  #: lines NUMBER:CONTROLLERS:PATH; version 2 names none


def core_ids() -> list[int]:
    """Numbers of the CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def cores() -> int:
    """CPU cores that this process may use: no more than a container's share of their time."""
    count = len(core_ids())
    for group in _control_groups("cpu"):
        version_1 = _words(group / "cpu.cfs_quota_us") + _words(group / "cpu.cfs_period_us")
        quota, period = _words(group / "cpu.max") or version_1 or ["max", "1"]
        if quota.isdecimal():  # neither "max" nor -1
            count = min(count, math.ceil(int(quota) / int(period)))
    return count


def available_memory() -> int:
    """Memory that this process may still take, bytes."""
    import psutil  # not where only cores are asked for

    available = psutil.virtual_memory().available
    for group in _control_groups("memory"):
        limit = _words(group / "memory.max") or _words(group / "memory.limit_in_bytes")
        used = _words(group / "memory.current") or _words(group / "memory.usage_in_bytes")
        if limit and used and limit[0].isdecimal():
            words = _words(group / "memory.stat")
            stat = dict(zip(words[::2], words[1::2], strict=True))
            # Of cached files, which the kernel drops when memory runs short.
            cache = stat.get("total_inactive_file") or stat.get("inactive_file", "0")
            available = min(available, int(limit[0]) - int(used[0]) + int(cache))
    return max(0, available)


def share_heap() -> None:
    """Makes threads that start from now on share one heap, where malloc is glibc's.

    By default it has up to eight heaps per core, each with free memory that the others cannot use:
    a training run's memory grows for many minutes.
    """
    arena_max = -8  # M_ARENA_MAX of malloc.h
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another libc, another system
        ctypes.CDLL(None).mallopt(arena_max, 1)


def _control_groups(controller: str) -> Iterator[Path]:
    """Folders of the control groups that this process is in; a group's limits hold for its own."""
    for line in _lines(MEMBERSHIP):
        _, controllers, path = line.split(":", 2)
        if not controllers or controller in controllers.split(","):
            root = CONTROL_GROUPS / controller if controllers else CONTROL_GROUPS
            own = root / path.lstrip("/")
            yield from (x for x in (own, *own.parents) if x.is_relative_to(root))


def _lines(file: Path) -> list[str]:
    """Of a file of the kernel; none if it is not there."""
    try:
        return file.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def _words(file: Path) -> list[str]:
    return [word for line in _lines(file) for word in line.split()]
