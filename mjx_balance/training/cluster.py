"""Where this process belongs among all of a run, and what of its machine is its own."""

import contextlib
import os
import socket
from collections.abc import Sequence
from typing import Any, NamedTuple

from mjx_balance.files.text import MESSAGE, shorten
from mjx_balance.training.meeting import ProcessError

PATIENCE_S = 300.0
"""Time in which all processes must have come: as long as `jax.distributed` gives them."""


class Cluster(NamedTuple):
    """A process among all of its run, in the words of `jax.distributed.initialize`."""

    coordinator_address: str
    """HOST:PORT or [IPv6]:PORT at which process 0 listens."""
    num_processes: int
    process_id: int
    local_device_ids: Sequence[int] | None = None
    """Ids of the GPUs that are this process's; all if None."""


def find_cluster(address: str | None, process_id: int | None, count: int | None) -> Cluster:
    """The place of this process by flags and, for those that are None, by what JAX detects.

    Raises:
      ProcessError: for an impossible flag, or if Slurm, Open MPI and Kubernetes do not fill it in.
    """
    flags = {"--coordinator": address, "--process-id": process_id, "--num-processes": count}
    missing, devices = [name for name, value in flags.items() if value is None], None
    if missing:
        from jax._src.clusters import ClusterEnv  # no public name leads to it

        try:
            address, count, process_id, devices = ClusterEnv.auto_detect_unset_distributed_params(
                address, count, process_id, None, None, int(PATIENCE_S)
            )
        except Exception as error:  # whatever a cluster's own library raises
            reason = shorten(error, MESSAGE)
            raise ProcessError(f"the cluster does not place this process: {reason}") from error
    if address is None or count is None or process_id is None:
        raise ProcessError(
            f"JAX finds no Slurm, Open MPI or Kubernetes here; say {', '.join(missing)} too"
        )
    if count < 1:
        raise ProcessError(f"num_processes is {count}; it must be at least 1")
    if not 0 <= process_id < count:
        raise ProcessError(
            f"process_id is {process_id}; it must be from 0 to num_processes - 1, {count - 1}"
        )
    resolve(address)
    return Cluster(address, count, process_id, devices)


def resolve(address: str) -> tuple[str, int]:
    """IP and port of HOST:PORT or [IPv6]:PORT.

    Raises:
      ProcessError: if it is neither, or the host is unknown.
    """
    name, _, port = address.rpartition(":")
    if not name or not port.isascii() or not port.isdigit() or not 0 < int(port) < 2**16:
        raise ProcessError(f"coordinator is {address!r}; it must be HOST:PORT of process 0")
    try:
        return str(socket.getaddrinfo(name.strip("[]"), None)[0][4][0]), int(port)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ProcessError(f"coordinator is {address!r}; its host is unknown: {reason}") from error


def free_address(ip: str) -> str:
    """IP:PORT of this machine, at which nobody listens."""
    family, at = (socket.AF_INET6, f"[{ip}]") if ":" in ip else (socket.AF_INET, ip)
    with socket.create_server((ip, 0), family=family) as server:
        return f"{at}:{server.getsockname()[1]}"


def describe_machine() -> dict[str, Any]:
    """Name of this machine, and the numbers of the cores that this process may use."""
    cores = range(os.cpu_count() or 1)
    if hasattr(os, "sched_getaffinity"):
        cores = os.sched_getaffinity(0)
    return {"machine": socket.gethostname(), "cores": sorted(cores)}


def share_machine(everyone: Sequence[dict[str, Any]], index: int) -> int:
    """Binds processes that may use the same cores of one machine to cores of their own each.

    Args:
      everyone: `describe_machine` of every process.
      index: of this process.

    Returns:
      The number of cores that every process has at least.
    """
    shares = []
    for k, own in enumerate(everyone):
        beside = [
            j
            for j, other in enumerate(everyone)
            if (other["machine"], other["cores"]) == (own["machine"], own["cores"])
        ]
        several = 1 < len(beside) <= len(own["cores"])
        shares.append(own["cores"][beside.index(k) :: len(beside)] if several else own["cores"])
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, shares[index])
    _let_threads_finish()
    return min(len(share) for share in shares)


def _let_threads_finish() -> None:
    """Makes this a batch job for the scheduler, with all threads that it starts from now on.

    A message wakes gloo's thread, which asks again and again for its connection if another thread
    has it, and on a single core that one cannot give it back before the time slice is over: 4 ms
    for an exchange of 27 kB instead of 0.1. Who wakes up in a batch job interrupts nobody.
    """
    if hasattr(os, "SCHED_BATCH"):
        with contextlib.suppress(OSError):  # not everybody may
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
