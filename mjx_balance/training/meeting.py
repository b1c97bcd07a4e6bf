"""How the processes of a run meet before JAX connects their devices, and notice one that dies.

In both cases JAX aborts with a native stack trace, which Python cannot catch. So every process
first connects to process 0, says who it is, gets one line back, and keeps the connection: it ends
when the process at its other end does.
"""

import contextlib
import json
import os
import queue
import socket
import threading
import time
from collections.abc import Iterable, Mapping
from typing import Any

from mjx_balance.errors import FAILED, InputError
from mjx_balance.files.text import MESSAGE, shorten

PROGRAM = "mjx_balance"  #: what a process of ours says first, within `HELLO_S`
HELLO_S, LINE_BYTES, THREADS = 5, 2**16, 100
"""Seconds for a hello; longest line that is read; threads at which more connections wait."""
KEEP_ALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 4, "TCP_USER_TIMEOUT": 30_000}
"""A machine that answers nothing counts as gone after 30 s."""
Meeting = tuple[dict[int, socket.socket], list[Any]]
"""The connections to other processes by their index, and what all say about themselves."""


class ProcessError(InputError):
    """Processes that cannot work together; the message says why."""


def host(address: tuple[str, int], count: int, about: Any, patience_s: float) -> Meeting:
    """Waits, as process 0 of `count`, for all others; listens at this IP and port alone.

    Args:
      address: IP and port.
      count: number of processes.
      about: JSON value that all get to know of this one.
      patience_s: longest time to wait, s.

    Raises:
      ProcessError: in every process that has come, if another does not, or counts differently.
    """
    where, until = f"{address[0]} port {address[1]}", time.monotonic() + patience_s
    connections: dict[int, socket.socket] = {}
    abouts, refusal = {0: about}, ""
    hellos: queue.SimpleQueue[tuple[socket.socket, int, int, Any]] = queue.SimpleQueue()
    try:
        server = listen(address)
    except OSError as error:
        reason = os.strerror(error.errno or 0)
        raise ProcessError(f"process 0 cannot listen at {where}: {reason}") from error
    with server:
        server.settimeout(0.1)
        while len(abouts) < count and not refusal:
            with contextlib.suppress(OSError):
                if threading.active_count() < THREADS:
                    caller = server.accept()[0], hellos
                    threading.Thread(target=_ask, args=caller, daemon=True).start()
            if time.monotonic() > until:
                missing = ", ".join(str(k) for k in range(count) if k not in abouts)
                refusal = f"process {missing} has not come to {where} in {patience_s:g} s"
            with contextlib.suppress(queue.Empty):
                connection, index, others, value = hellos.get_nowait()
                if others != count or index not in range(1, count) or index in abouts:
                    refusal = (
                        f"a process came to {where} as number {index} of {others}; process 0 waits "
                        f"for {count}, and has met {sorted(connections)}"
                    )
                    index = -1
                connections[index], abouts[index] = connection, value
    if refusal:
        _send(connections.values(), {"refusal": refusal})
        for connection in connections.values():
            connection.close()
        raise ProcessError(refusal)
    everyone = [abouts[k] for k in range(count)]
    _send(connections.values(), {"everyone": everyone})
    return connections, everyone


def listen(address: tuple[str, int]) -> socket.socket:
    """Listens at an IP and a port, 0 for any."""
    family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
    return socket.create_server(address, family=family)


def _ask(connection: socket.socket, hellos: Any) -> None:
    """Asks who has connected: a process of ours goes into `hellos`, a stranger is dropped."""
    hello = _receive(connection, HELLO_S)
    numbers = hello.get("index"), hello.get("count")
    if hello.get("program") == PROGRAM and all(isinstance(x, int) for x in numbers):
        hellos.put((connection, *numbers, hello.get("about")))
    else:
        connection.close()


def visit(
    address: tuple[str, int], index: int, count: int, about: Any, patience_s: float
) -> Meeting:
    """Comes to process 0, as process `index`, and waits for all others; otherwise as `host`."""
    where, until = f"{address[0]} port {address[1]}", time.monotonic() + patience_s
    while True:  # process 0 may be started later
        try:
            connection = socket.create_connection(address, timeout=5)
            break
        except OSError as error:
            if time.monotonic() > until:
                raise ProcessError(
                    f"process 0 does not answer at {where} within {patience_s:g} s "
                    f"({error.strerror or error}); is it started, and is that its address?"
                ) from error
            time.sleep(0.2)
    _send([connection], {"program": PROGRAM, "index": index, "count": count, "about": about})
    # Process 0 loses patience at about the same time, and knows who is missing.
    answer = _receive(connection, until + 5 - time.monotonic())
    if "everyone" not in answer:
        connection.close()
        left = f"process 0 has left the meeting at {where}"
        raise ProcessError(shorten(answer.get("refusal", left), MESSAGE))
    return {0: connection}, answer["everyone"]


def _send(connections: Iterable[socket.socket], message: dict[str, Any]) -> None:
    """Sends a line to all who are still there."""
    for connection in connections:
        with contextlib.suppress(OSError):
            connection.sendall(json.dumps(message).encode() + b"\n")


def _receive(connection: socket.socket, timeout_s: float | None) -> dict[str, Any]:
    """The next line, a JSON object; empty if none comes."""
    message = None
    with contextlib.suppress(OSError, ValueError, RecursionError):
        connection.settimeout(timeout_s)
        message = json.loads(connection.makefile("rb").readline(LINE_BYTES))
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
            lost = _receive(connection, None).get("lost", other)
            if self._ended.acquire(blocking=False):
                end = f"process {lost} is gone, and the run ends with it{self.advice}"
                os.write(2, f"mjx-balance: {end}\n".encode())  # before JAX aborts
                _send(self._connections.values(), {"lost": lost})
                os._exit(FAILED)
