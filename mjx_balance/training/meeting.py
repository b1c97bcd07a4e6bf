"""How the processes of a run meet before JAX connects their devices, and notice one that dies.

In both cases JAX aborts with a native stack trace, which Python cannot catch. So every process
first connects to process 0, says who it is, gets one line back, and keeps the connection: it ends
when the process at its other end does.
"""

import contextlib
import dataclasses
import json
import os
import queue
import secrets
import socket
import threading
import time
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

from mjx_balance.errors import FAILED, MESSAGE, InputError, shorten
from mjx_balance.files.validation import STRICT, parse

HELLO_S, LINE_BYTES, CALLERS = 5, 2**16, 100
"""Seconds for a hello; its greatest length; callers that may be about to say one: the oldest go."""
KEEP_ALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 4, "TCP_USER_TIMEOUT": 30_000}
"""A machine that answers nothing counts as gone after 30 s."""


class ProcessError(InputError):
    """Processes that cannot work together; the message says why."""


@dataclasses.dataclass(frozen=True)
class Member:
    """What all processes get to know of one of them."""

    __pydantic_config__: ClassVar[Any] = STRICT
    machine: str  #: host name
    cores: tuple[int, ...]  #: ids of the CPU cores that it may use
    num_cores: int  #: how many at a time; fewer in a container with a quota
    service: str = ""  #: IP:PORT at which process 0 starts JAX's coordination service


@dataclasses.dataclass(frozen=True)
class Hello:
    """What a process says to process 0."""

    __pydantic_config__: ClassVar[Any] = STRICT
    mjx_balance: str  #: number that process 0 has greeted it with, new for every connection
    index: int
    count: int
    member: Member


Meeting = tuple[dict[int, socket.socket], tuple[Member, ...]]
"""The connections to other processes by their index, and what all say about themselves."""


def host(address: tuple[str, int], count: int, own: Member, patience_s: float) -> Meeting:
    """Waits, as process 0 of `count`, for all others; listens at this IP and port alone.

    Drops connections that say no hello. A process that leaves before all have come may come again.

    Args:
      address: IP and port.
      count: number of processes.
      own: this process.
      patience_s: longest time to wait, s.

    Raises:
      ProcessError: in every process that has come, if another does not, or counts differently.
    """
    where, until = f"{address[0]} port {address[1]}", time.monotonic() + patience_s
    connections: dict[int, socket.socket] = {}
    members, refusal = {0: own}, ""
    callers: dict[socket.socket, threading.Thread] = {}  # the oldest first
    hellos: queue.SimpleQueue[tuple[socket.socket, Hello]] = queue.SimpleQueue()
    try:
        server = listen(address)
    except OSError as error:
        reason = os.strerror(error.errno or 0)
        raise ProcessError(f"process 0 cannot listen at {where}: {reason}") from error
    with server:
        server.settimeout(0.1)
        while len(members) < count and not refusal:
            with contextlib.suppress(OSError):
                caller = server.accept()[0]
                asks = threading.Thread(target=_ask, args=(caller, hellos), daemon=True)
                asks.start()
                callers = {x: y for x, y in callers.items() if x.fileno() >= 0} | {caller: asks}
                if len(callers) > CALLERS:
                    oldest = next(iter(callers))
                    del callers[oldest]
                    _shut_down(oldest)
            for index in [k for k, x in connections.items() if _has_left(x)]:
                connections.pop(index).close()
                del members[index]
            if time.monotonic() > until:
                missing = ", ".join(str(k) for k in range(count) if k not in members)
                refusal = f"process {missing} has not come to {where} in {patience_s:g} s"
            with contextlib.suppress(queue.Empty):
                caller, hello = hellos.get_nowait()
                if caller not in callers:  # it has been shut down
                    caller.close()
                    continue
                del callers[caller]
                index, others = hello.index, hello.count
                if others != count or index not in range(1, count) or index in members:
                    refusal = (
                        f"a process came to {where} as number {index} of {others}; process 0 waits "
                        f"for {count}, and has met {sorted(connections)}"
                    )
                    index = -1
                connections[index], members[index] = caller, hello.member
    for caller in callers:
        _shut_down(caller)
    for asks in callers.values():
        asks.join()
    while not hellos.empty():
        hellos.get()[0].close()
    if refusal:
        _send(connections.values(), {"refusal": refusal})
        for connection in connections.values():
            connection.close()
        raise ProcessError(refusal)
    everyone = tuple(members[k] for k in range(count))
    _send(connections.values(), {"everyone": [dataclasses.asdict(x) for x in everyone]})
    return connections, everyone


def listen(address: tuple[str, int]) -> socket.socket:
    """Listens at an IP and a port, 0 for any."""
    family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
    return socket.create_server(address, family=family)


def _ask(caller: socket.socket, hellos: "queue.SimpleQueue[tuple[socket.socket, Hello]]") -> None:
    """Asks who has connected: a process of ours goes into `hellos`, a stranger is dropped."""
    nonce = secrets.token_hex()  # so that a hello that somebody has recorded is none
    _send([caller], {"mjx_balance": nonce})
    with contextlib.suppress(InputError):
        hello = parse(Hello, _receive(caller, time.monotonic() + HELLO_S))
        if hello.mjx_balance == nonce:
            caller.settimeout(HELLO_S)
            hellos.put((caller, hello))
            return
    caller.close()


def _shut_down(caller: socket.socket) -> None:
    """Ends a connection; the thread that reads from it closes it."""
    with contextlib.suppress(OSError):
        caller.shutdown(socket.SHUT_RDWR)


def _has_left(connection: socket.socket) -> bool:
    """Whether a process that should be waiting has closed its connection, or talks."""
    connection.setblocking(False)
    try:
        connection.recv(1)
    except BlockingIOError:
        return False
    except OSError:
        pass
    finally:
        connection.settimeout(HELLO_S)
    return True


def visit(
    address: tuple[str, int], index: int, count: int, own: Member, patience_s: float
) -> Meeting:
    """Comes to process 0, as process `index`, and waits for all others; otherwise as `host`."""
    where, until = f"{address[0]} port {address[1]}", time.monotonic() + patience_s
    # Process 0 loses patience at about the same time, and knows who is missing.
    last, reason, hello = until + 5, "", None
    while True:  # process 0 may be started later, and drops the slow if many strangers call
        try:
            connection = socket.create_connection(address, timeout=5)
        except OSError as error:
            reason = error.strerror or str(error)
            if hello is not None and isinstance(error, ConnectionRefusedError):
                raise ProcessError(f"process 0 has left the meeting at {where}") from error
        else:
            reason = "what answers is no process 0"
            with contextlib.ExitStack() as stack:
                stack.enter_context(connection)
                nonce = _receive(connection, until).get("mjx_balance")
                if isinstance(nonce, str):
                    reason, hello = "it drops the connection", Hello(nonce, index, count, own)
                    _send([connection], dataclasses.asdict(hello))
                    answer = _receive(connection, last, count * LINE_BYTES)
                    if "refusal" in answer:
                        raise ProcessError(shorten(answer["refusal"], MESSAGE))
                    if "everyone" in answer:
                        members = _members(answer["everyone"], count)
                        stack.pop_all()  # the connection stays open
                        return {0: connection}, members
        if time.monotonic() > until:
            raise ProcessError(
                f"process 0 does not answer at {where} within {patience_s:g} s ({reason}); is it "
                "started, and is that its address?"
            )
        time.sleep(0.2)


def _members(values: Any, count: int) -> tuple[Member, ...]:
    """What process 0 says about everyone."""
    members = parse(tuple[Member, ...], values, ProcessError, name="what process 0 says")
    if len(members) != count:
        raise ProcessError(f"process 0 says that {len(members)} have come; {count} were awaited")
    return members


def _send(connections: Iterable[socket.socket], message: dict[str, Any]) -> None:
    """Sends a line to all who are still there."""
    for connection in connections:
        with contextlib.suppress(OSError):
            connection.sendall(json.dumps(message).encode() + b"\n")


def _receive(
    connection: socket.socket, until: float | None, limit: int = LINE_BYTES
) -> dict[str, Any]:
    """The next line, a JSON object; empty if none comes until `time.monotonic()` is `until`."""
    line, message = b"", None
    with contextlib.suppress(OSError, ValueError, RecursionError):
        while b"\n" not in line and len(line) < limit:
            left = None if until is None else until - time.monotonic()
            if left is not None and left <= 0:
                return {}
            connection.settimeout(left)
            line += connection.recv(LINE_BYTES) or b"\n"
        message = json.loads(line.partition(b"\n")[0])
    return message if isinstance(message, dict) else {}


class Watch:
    """Ends this process with a sentence when another one of the run is gone."""

    def __init__(self, connections: Mapping[int, socket.socket]):
        """Listens to the connections of a meeting, each in a thread, until `end`."""
        self.advice = ""  #: what the sentence ends with
        self._connections, self._ended = connections, threading.Lock()
        for other, connection in connections.items():
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for name in KEEP_ALIVE.keys() & set(dir(socket)):  # not everywhere
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), KEEP_ALIVE[name])
            threading.Thread(target=self._listen, args=(other, connection), daemon=True).start()

    def end(self) -> None:
        """Lets the others leave from now on."""
        self._ended.acquire(blocking=False)

    def _listen(self, other: int, connection: socket.socket) -> None:
        """Waits until a connection ends, or until process 0 says which other one has."""
        with connection:
            lost = shorten(_receive(connection, None).get("lost", other))
            if self._ended.acquire(blocking=False):
                end = f"process {lost} is gone, and the run ends with it{self.advice}"
                os.write(2, f"mjx-balance: {end}\n".encode())  # before JAX aborts
                _send(self._connections.values(), {"lost": lost})
                os._exit(FAILED)
