"""The processes of a run, on one machine or on many: how they meet, and what they agree on.

`jax.distributed` connects their devices, but it aborts a process, stack trace and all, when another
one is missing, and lets it wait for minutes when another one dies. So every process first opens a
socket to the first one. Over it they compare what they were started with, agree on what only one
of them can know, and learn at once of one that is gone.
"""

import atexit
import contextlib
import dataclasses
import json
import os
import queue
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar, cast

import jax

from mjx_balance.errors import FAILED, INTERRUPTED, InputError

T = TypeVar("T")

PATIENCE_S = 300.0
"""Time in which all processes must have come: as long as `jax.distributed` gives them."""
SILENCE_S = 30
"""Time after which a machine that answers nothing counts as gone."""


class ProcessError(InputError):
    """Processes that cannot work together; the message says why."""


class ProcessLostError(RuntimeError):
    """Another process has ended before its time."""


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a process belongs."""

    address: str
    """HOST:PORT at which the first process listens."""
    index: int
    count: int
    local_devices: Sequence[int] | None = None
    """Numbers of the GPUs that are this process's; all if none."""


def find_place(address: str | None, index: int | None, count: int | None) -> Place:
    """What the flags say or, where they are silent, what JAX finds of Slurm, Open MPI, Kubernetes.

    Raises:
      ProcessError: if neither tells.
    """
    told, devices = (address, index, count), None
    if None in told:
        from jax._src.clusters import ClusterEnv  # no public name leads to it

        try:
            address, count, index, devices = ClusterEnv.auto_detect_unset_distributed_params(
                address, count, index, None, None, int(PATIENCE_S)
            )
        except Exception as error:  # whatever a cluster's own library raises
            said = " ".join(str(error).split())
            raise ProcessError(
                f"the cluster cannot be asked for this process's place: {said}"
            ) from error
    if address is None or count is None or index is None:
        names = ("--coordinator", "--process-id", "--num-processes")
        missing = [name for name, x in zip(names, told, strict=True) if x is None]
        raise ProcessError(
            f"JAX finds no Slurm, Open MPI or Kubernetes here; say {', '.join(missing)} too"
        )
    host, _, port = address.rpartition(":")
    if not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 2**16:
        raise ProcessError(f"coordinator is {address!r}; it must be HOST:PORT of process 0")
    if count < 1:
        raise ProcessError(f"num_processes is {count}; it must be at least 1")
    if not 0 <= index < count:
        raise ProcessError(
            f"process_id is {index}; it must be from 0 to num_processes - 1, {count - 1}"
        )
    return Place(address, index, count, devices)


class Processes:
    """All processes of a run, as one of them sees them; of a run of its own, only itself."""

    def __init__(
        self, index: int = 0, count: int = 1, sockets: Mapping[int, socket.socket] | None = None
    ):
        """Talks to the others.

        Args:
          index: of this process.
          count: of all.
          sockets: to all others from the first, by their index; from any other to the first.
        """
        self.index, self.count = index, count
        self.folder: Path | None = None
        """Of the run, to be named when another process is lost."""
        self._parted = False
        self._sockets = dict(sockets or {})
        self._inbox: dict[int, queue.SimpleQueue[Any]] = {}
        for other, connection in self._sockets.items():
            self._inbox[other] = queue.SimpleQueue()
            threading.Thread(target=self._listen, args=(other, connection), daemon=True).start()

    @property
    def first(self) -> bool:
        """Whether this process writes the run's files and shows it."""
        return self.index == 0

    def gather(self, value: Any) -> list[Any]:
        """The JSON values that all processes give, in their order; waits for all.

        Raises:
          ProcessLostError: if another one has left.
        """
        if not self._sockets:
            return [value]
        if not self.first:
            self._send(0, ["value", value])
            return self._receive(0)
        values = [value, *(self._receive(other) for other in sorted(self._sockets))]
        for other in self._sockets:
            self._send(other, ["value", values])
        return values

    def any(self, flag: bool) -> bool:
        """Whether any process has raised its flag."""
        return any(self.gather(flag))

    def from_first(self, function: Callable[[], T], *errors: type[Exception]) -> T:
        """What a function gives in the first process, a JSON value, in all of them.

        Args:
          function: called there alone.
          errors: what it may raise; all processes raise it then, with the same message.
        """
        if not self._sockets:
            return function()
        if not self.first:
            value, name, message = self.gather(None)[0]
            if name is not None:
                raise next(kind for kind in errors if kind.__name__ == name)(message)
            return value
        try:
            value = function()
        except errors as error:
            self.gather([None, type(error).__name__, str(error)])
            raise
        self.gather([value, None, None])
        return value

    def everywhere(self, function: Callable[[], T], *errors: type[Exception]) -> T:
        """What a function gives in this process, once it has given something in all of them.

        Args:
          function: called in every process.
          errors: what it may raise; all processes raise it then, with the message of the first.
        """
        value, raised = None, None
        try:
            value = function()
        except errors as error:
            raised = error
        said = None if raised is None else [type(raised).__name__, str(raised)]
        for other, theirs in enumerate(self.gather(said)):
            if theirs is not None and raised is None:
                kind = next(kind for kind in errors if kind.__name__ == theirs[0])
                raised = kind(f"process {other}: {theirs[1]}")
        if raised is not None:
            raise raised
        return cast(T, value)

    def check_same(self, values: Mapping[str, Any]) -> None:
        """Compares what the processes were started with.

        Raises:
          ProcessError: in all of them, naming the first value that differs.
        """
        everyone = self.gather(dict(values))
        for other, theirs in enumerate(everyone):
            for name, value in everyone[0].items():
                if theirs.get(name) != value:
                    raise ProcessError(
                        f"process {other} has {name} = {theirs.get(name)}, process 0 has {value}; "
                        "start all with the same flags and the same installation"
                    )

    def part(self) -> None:
        """Disconnects the devices and says good-bye: whoever goes without it is missed.

        All processes part at once. Without effect on who has parted already.
        """
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            jax.distributed.shutdown()
        self._parted = True
        for other in self._sockets:
            self._send(other, ["bye"])
        self._sockets.clear()

    def _send(self, other: int, message: list[Any]) -> None:
        # Whoever cannot be reached is missed by the thread that listens to it.
        with contextlib.suppress(OSError):
            self._sockets[other].sendall(json.dumps(message).encode() + b"\n")

    def _receive(self, other: int) -> Any:
        kind, *rest = self._inbox[other].get()
        if kind == "refused":
            raise ProcessError(*rest)
        if kind == "bye":
            raise ProcessLostError(f"process {other} has left before the others")
        return rest[0]

    def _listen(self, other: int, connection: socket.socket) -> None:
        """Takes another process's messages, in a thread, until it leaves or is lost."""
        with connection, contextlib.suppress(OSError, ValueError):
            lines = connection.makefile("rb")
            while line := lines.readline():
                message = json.loads(line)
                if message[0] == "lost":
                    self._end(message[1])
                self._inbox[other].put(message)
                if message[0] != "value":
                    return
        if not self._parted:
            self._end(other)

    def _end(self, lost: int) -> None:
        """Ends this process: its program would wait for the lost one's devices for ever."""
        for other in list(self._sockets) if self.first else ():
            self._send(other, ["lost", lost])
        resume = "" if self.folder is None else f"; continue with --resume {self.folder}"
        sys.stderr.write(f"mjx-balance: process {lost} is gone, and the run ends with it{resume}\n")
        _exit_at_once(FAILED)


ALONE = Processes()
"""A run of one process."""


@contextlib.contextmanager
def joined(place: Place | None, orderly: tuple[type[Exception], ...]) -> Iterator[Processes]:
    """This process among all others of the run, their devices connected; alone if it has no place.

    Before JAX is used. Processes that share a machine's cores get an equal part of them each.

    Args:
      place: from `find_place`.
      orderly: errors that all processes raise together: nobody is missed then.

    Raises:
      ProcessError: if not all come in time, or they do not fit together.
    """
    if place is None:
        yield ALONE
        return
    processes = meet(place)
    try:
        if place.count > 1:
            _share_cores(processes)
            _let_threads_finish()
            _connect_devices(processes, place)
        yield processes
    except (ProcessError, *orderly):
        processes.part()
        raise
    except BaseException as error:
        # At its exit JAX would wait for the others, who may wait for this process.
        code = INTERRUPTED if isinstance(error, KeyboardInterrupt) else FAILED
        atexit.register(_exit_at_once, code)
        if isinstance(error, jax.errors.JaxRuntimeError) and place.count > 1:
            time.sleep(2)  # if that was because of a process that is gone, it is said meanwhile
        raise
    processes.part()


def _exit_at_once(code: int) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def meet(place: Place, patience: float = PATIENCE_S) -> Processes:
    """Brings all processes together.

    Args:
      place: of this process.
      patience: time to wait for the others, s.

    Raises:
      ProcessError: in every process that has come, if another does not, or has a wrong place.
    """
    until = time.monotonic() + patience
    if place.index:
        processes = Processes(place.index, place.count, {0: _reach(place, until, patience)})
    else:
        processes = Processes(0, place.count, _await_all(place, until, patience))
    processes.gather(None)
    return processes


def _reach(place: Place, until: float, patience: float) -> socket.socket:
    """A connection to the first process, which has been told who this is."""
    while True:
        try:
            connection = socket.create_connection(_host_and_port(place), timeout=5)
            break
        except OSError as error:
            if time.monotonic() > until:
                raise ProcessError(
                    f"process 0 does not answer at {place.address} within {patience:g} s "
                    f"({error.strerror or error}); is it started, and is that its address?"
                ) from error
            time.sleep(0.2)
    _keep_watch(connection)
    connection.sendall(json.dumps([place.index, place.count]).encode() + b"\n")
    return connection


def _await_all(place: Place, until: float, patience: float) -> dict[int, socket.socket]:
    """Connections to all others, which have come and said who they are."""
    _, port = _host_and_port(place)
    found: dict[int, socket.socket] = {}
    try:
        server = _listening(port)
    except OSError as error:
        raise ProcessError(
            f"process 0 cannot listen at {place.address}: {error.strerror}"
        ) from error
    with server:
        while len(found) < place.count - 1:
            server.settimeout(max(0.01, until - time.monotonic()))
            try:
                connection, _ = server.accept()
            except TimeoutError:
                missing = sorted(set(range(1, place.count)) - set(found))
                names = ", ".join(map(str, missing))
                _refuse(found, f"process {names} has not come to {place.address} in {patience:g} s")
            try:
                connection.settimeout(5)
                index, count = json.loads(_line(connection))
            except (OSError, ValueError, TypeError):  # no process of ours
                connection.close()
                continue
            _keep_watch(connection)
            if count != place.count or index in found or index not in range(1, place.count):
                said = f"a process came to {place.address} as number {index} of {count}, "
                known = f"process 0 waits for {place.count}, and has met {sorted(found)}"
                _refuse(found | {-1: connection}, said + known)
            found[index] = connection
    return found


def _listening(port: int) -> socket.socket:
    """A server on all of this machine's addresses; port 0: any that is free."""
    if socket.has_dualstack_ipv6():
        return socket.create_server(("", port), family=socket.AF_INET6, dualstack_ipv6=True)
    return socket.create_server(("", port))


def _line(connection: socket.socket) -> bytes:
    """The first line that comes, byte by byte: what follows is another's to read."""
    line = b""
    while not line.endswith(b"\n") and len(line) < 100:
        byte = connection.recv(1)
        if not byte:
            break
        line += byte
    return line


def _refuse(connections: Mapping[int, socket.socket], said: str) -> NoReturn:
    for connection in connections.values():
        with connection, contextlib.suppress(OSError):
            connection.sendall(json.dumps(["refused", said]).encode() + b"\n")
    raise ProcessError(said)


def _keep_watch(connection: socket.socket) -> None:
    """Also a machine that is gone without a word ends the connection, after `SILENCE_S`."""
    connection.settimeout(None)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    limits = {"TCP_KEEPIDLE": SILENCE_S - 20, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 4}
    limits["TCP_USER_TIMEOUT"] = 1000 * SILENCE_S  # ms; of what was sent and not received
    for name, value in limits.items():
        if hasattr(socket, name):  # not everywhere
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def _host_and_port(place: Place) -> tuple[str, int]:
    host, _, port = place.address.rpartition(":")
    return host.strip("[]"), int(port)


def _share_cores(processes: Processes) -> None:
    """Binds processes of one machine to cores of their own, where nobody has done so yet."""
    if not hasattr(os, "sched_setaffinity"):
        return
    cores = sorted(os.sched_getaffinity(0))
    everyone = processes.gather([socket.gethostname(), cores])
    beside = [k for k, those in enumerate(everyone) if those == everyone[processes.index]]
    if len(beside) <= len(cores):
        os.sched_setaffinity(0, cores[beside.index(processes.index) :: len(beside)])


def _let_threads_finish() -> None:
    """Makes this a batch job for the scheduler, with all threads that it starts from now on.

    A message wakes gloo's thread, which asks again and again for its connection if another thread
    has it, and on a single core that one cannot give it back before the time slice is over: 4 ms
    for an exchange of 27 kB instead of 0.1. Who wakes up in a batch job interrupts nobody.
    """
    if hasattr(os, "SCHED_BATCH"):
        with contextlib.suppress(OSError):  # not everybody may
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def _connect_devices(processes: Processes, place: Place) -> None:
    host, _ = _host_and_port(place)
    jax.distributed.initialize(
        f"{host}:{processes.from_first(_free_port)}",
        place.count,
        place.index,
        local_device_ids=place.local_devices,
        cluster_detection_method="deactivate",
        initialization_timeout=60,
        shutdown_timeout_seconds=60,
    )


def _free_port() -> int:
    with _listening(0) as server:
        return server.getsockname()[1]
