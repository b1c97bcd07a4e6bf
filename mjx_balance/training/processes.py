"""The processes of a run, on one machine or many, over `jax.distributed`."""

import atexit
import contextlib
import dataclasses
import json
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn, TypeVar, cast

import jax
import numpy as np
from jax.experimental import multihost_utils

from mjx_balance.errors import FAILED, INTERRUPTED, MESSAGE, quote, shorten
from mjx_balance.machine import core_ids, cores
from mjx_balance.training.meeting import Member, ProcessError, Watch, host, listen, visit

T = TypeVar("T")

PATIENCE_S = 300  #: time limit for all processes to connect, s, as in `jax.distributed`


class Interrupted(Exception):
    """The user stopped the run; the message says what is saved and how to go on."""


class Cluster(NamedTuple):
    """A process among all of its run, in the words of `jax.distributed.initialize`."""

    coordinator_address: str  #: HOST:PORT or [IPv6]:PORT at which process 0 listens
    num_processes: int
    process_id: int
    local_device_ids: Sequence[int] | None = None  #: ids of this process's GPUs; all if None


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
                address, count, process_id, None, None, PATIENCE_S
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


@dataclasses.dataclass(frozen=True)
class Processes:
    """All processes of a run, as one of them sees them; all of them call the same methods."""

    index: int = 0  #: of this process
    count: int = 1
    watch: Watch | None = None  #: notices those that die
    cores: int | None = None  #: CPU cores that every process has; None: all of this one

    @property
    def first(self) -> bool:
        """Whether this process writes the run's files and shows it."""
        return self.index == 0

    def gather(self, value: Any) -> list[Any]:
        """Returns the JSON values of all processes, in their order."""
        if self.count == 1:
            return [value]
        text = np.frombuffer(json.dumps(value).encode(), np.uint8)
        sizes = multihost_utils.process_allgather(np.int32(text.size))
        longest = max(64, 1 << int(sizes.max() - 1).bit_length())  # few shapes to compile
        texts = multihost_utils.process_allgather(np.pad(text, (0, longest - text.size)))
        return [json.loads(x[:size].tobytes()) for x, size in zip(texts, sizes, strict=True)]

    def any(self, flag: bool) -> bool:
        """Returns whether any process has raised its flag."""
        return any(self.gather(flag))

    def run_on_all(self, function: Callable[[], T], *errors: type[Exception]) -> T:
        """Calls a function in all processes; if it raises one of `errors` in one, all raise it."""
        value, failure, own = None, None, None
        try:
            value = function()
        except errors as error:
            kind = next(k for k, kind in enumerate(errors) if isinstance(error, kind))
            failure, own = error, (kind, str(error))
        failures = self.gather(own)
        if failure is not None:
            raise failure
        for k, (kind, message) in ((k, x) for k, x in enumerate(failures) if x):
            raise errors[kind](f"process {k}: {message}" if k else message)
        return cast(T, value)

    def broadcast(self, function: Callable[[], T], *errors: type[Exception]) -> T:
        """Returns in all processes what a function returns in the first; all raise its `errors`."""
        value = self.run_on_all(lambda: function() if self.first else None, *errors)
        return cast(T, self.gather(value)[0])

    def check_same(self, values: Mapping[str, Any]) -> None:
        """Compares the JSON values that the processes were started with.

        Raises:
          ProcessError: in all of them, naming the first value that differs.
        """
        own, *others = self.gather(dict(values))
        for k, theirs in enumerate(others, 1):
            for name, value in own.items():
                if theirs.get(name) != value:
                    raise ProcessError(
                        f"process {k} has {name} = {theirs.get(name)}, process 0 has {value}; "
                        "start all with the same flags and the same installation"
                    )

    def advise(self, advice: str) -> None:
        """Sets the end of the sentence that the user reads if another process is gone."""
        if self.watch is not None:
            self.watch.advice = advice

    def leave(self) -> None:
        """Disconnects the devices; a process that exits without it is reported lost."""
        if self.watch is not None:
            self.watch.end()
            with contextlib.suppress(jax.errors.JaxRuntimeError):
                jax.distributed.shutdown()


ALONE = Processes()  #: a run of one process


@contextlib.contextmanager
def joined(
    cluster: Cluster | None, shared: tuple[type[Exception], ...] = ()
) -> Iterator[Processes]:
    """This process among all others of the run; alone without a cluster. Before JAX is used.

    All processes raise a `ProcessError`, `Interrupted` or one of `shared` together, and all leave.
    With any other error this process exits at once, and the others report it lost.

    Raises:
      ProcessError: if not all come in time, or they do not fit together.
    """
    if cluster is None or cluster.num_processes == 1:
        yield ALONE
        return
    processes = _connect(cluster)
    try:
        yield processes
    except (ProcessError, Interrupted, *shared):
        processes.leave()
        raise
    except BaseException as error:
        time.sleep(2)  # if a process is gone, `Watch` says so meanwhile
        # At its exit JAX would wait for the others, who may wait for this process.
        interrupted = isinstance(error, KeyboardInterrupt)
        atexit.register(exit_at_once, INTERRUPTED if interrupted else FAILED)
        raise
    processes.leave()


def exit_at_once(code: int) -> NoReturn:
    """Ends the process without waiting for its threads."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _connect(cluster: Cluster) -> Processes:
    """Meets the others, shares the machine with them and connects the devices of all."""
    index, count = cluster.process_id, cluster.num_processes
    address = resolve(cluster.coordinator_address)
    service = "" if index else _free_address(address[0])
    own = Member(socket.gethostname(), tuple(core_ids()), cores(), service)
    if index:
        connections, everyone = visit(address, index, count, own, PATIENCE_S)
    else:
        connections, everyone = host(address, count, own, PATIENCE_S)
    watch = Watch(connections)
    _check_own_name()
    num_cores = share_machine(everyone, index)
    os.environ["no_grpc_proxy"] = address[0]  # noqa: SIM112
    jax.config.update("jax_check_proxy_envs", False)
    service = everyone[0].service
    jax.distributed.initialize(
        service,
        count,
        index,
        local_device_ids=cluster.local_device_ids,
        cluster_detection_method="deactivate",
        coordinator_bind_address=service,
    )
    return Processes(index, count, watch, num_cores)


def _check_own_name() -> None:
    """Raises `ProcessError` if this machine's name has no address: gloo listens at it."""
    name = socket.gethostname()
    try:
        socket.getaddrinfo(name, None)
    except (OSError, UnicodeError) as error:
        raise ProcessError(
            f"this machine is called {quote(name)}, and no address is known for that name; add it "
            "to /etc/hosts"
        ) from error


def _free_address(ip: str) -> str:
    """IP:PORT of this machine, at which nobody listens."""
    with listen((ip, 0)) as server:
        return f"{f'[{ip}]' if ':' in ip else ip}:{server.getsockname()[1]}"


def share_machine(everyone: Sequence[Member], index: int) -> int:
    """Binds processes that may use the same cores of one machine to cores of their own each.

    Args:
      everyone: what is known of every process.
      index: of this process.

    Returns:
      Least number of cores of a process.
    """
    places = [(own.machine, own.cores) for own in everyone]
    shares = []
    for k, (_, ids) in enumerate(places):
        beside, before = places.count(places[k]), places[:k].count(places[k])
        shares.append(ids[before::beside] if beside <= len(ids) else ids)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, shares[index])
    # A message wakes gloo's thread, which spins if another thread has its connection; on one core
    # that thread then waits for its next time slice: 4 ms for an exchange of 27 kB instead of 0.1.
    # A thread of a batch job that wakes up interrupts nobody.
    if hasattr(os, "SCHED_BATCH"):
        with contextlib.suppress(OSError):  # not everybody may
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    return min(min(len(share), own.num_cores) for share, own in zip(shares, everyone, strict=True))
