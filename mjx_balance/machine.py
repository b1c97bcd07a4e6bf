"""What this process may use of the machine."""

import os


def core_ids() -> list[int]:
    """Numbers of the CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def cores() -> int:
    """CPU cores that this process may use."""
    return len(core_ids())
