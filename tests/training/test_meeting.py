"""Processes that meet over sockets among strangers, and miss one another: here they are threads."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from mjx_balance.training import meeting
from mjx_balance.training.meeting import ProcessError, Watch, host, visit

Address = tuple[str, int]


@pytest.fixture
def address() -> Address:
    """An address at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()


def at_once(*calls: Callable[[], Any]) -> list[Any]:
    """What each of the calls, in a thread of its own, returns or raises within 40 s."""
    outcomes: list[Any] = [TimeoutError("it hangs")] * len(calls)

    def work(k: int) -> None:
        try:
            outcomes[k] = calls[k]()
        except Exception as error:
            outcomes[k] = error

    threads = [threading.Thread(target=work, args=(k,), daemon=True) for k in range(len(calls))]
    until = time.monotonic() + 40
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, until - time.monotonic()))
    return outcomes


@pytest.fixture
def opened() -> Iterator[list[socket.socket]]:
    """Connections to close at the end."""
    with contextlib.ExitStack() as stack:
        connections: list[socket.socket] = []
        yield connections
        for connection in connections:
            stack.enter_context(connection)


@pytest.fixture
def come(address: Address, opened: list[socket.socket]) -> Callable[..., Any]:
    """Index, count -> what a process gets to know of all."""

    def come(index: int, count: int, patience_s: float = 20, at: Address = address) -> Any:
        if index:
            connections, everyone = visit(at, index, count, f"about {index}", patience_s)
        else:
            connections, everyone = host(at, count, "about 0", patience_s)
        opened.extend(connections.values())
        return everyone

    return come


def message(outcome: Any) -> str:
    assert type(outcome) is ProcessError, outcome
    return str(outcome)


def test_all_get_to_know_of_all(come: Any) -> None:
    calls = [lambda k=k: come(k, 3) for k in (2, 1, 0)]
    assert at_once(*calls) == [["about 0", "about 1", "about 2"]] * 3


def test_nobody_waits_for_ever(address: Address, come: Any) -> None:
    where = f"127.0.0.1 port {address[1]}"
    outcomes = at_once(*(lambda k=k: come(k, 3, 1) for k in (0, 2)))
    assert [message(x) for x in outcomes] == [f"process 1 has not come to {where} in 1 s"] * 2
    [outcome] = at_once(lambda: come(1, 2, 0.5))
    assert f"process 0 does not answer at {where} within 0.5 s" in message(outcome)


@pytest.mark.parametrize(("index", "count"), [(1, 3), (2, 4), (3, 3)])
def test_processes_that_count_differently_are_refused(
    index: int, count: int, address: Address, come: Any
) -> None:
    """Two with the same number, one that knows of another number of them, one beyond it."""

    def late() -> Any:
        time.sleep(0.6)
        return come(index, count)

    outcomes = at_once(*(lambda k=k: come(k, 3) for k in (0, 1)), late)
    [sentence] = {message(x) for x in outcomes}
    assert sentence == (
        f"a process came to 127.0.0.1 port {address[1]} as number {index} of {count}; process 0 "
        "waits for 3, and has met [1]"
    )


GREETING = b'{"program": "mjx_balance", '


@pytest.mark.parametrize(
    "lines",
    [
        [],
        [b"GET / HTTP/1.1\r\n"],
        [b"[[1], 2]\n"],
        [b"[1, 3]\n"],
        [b'"ab"\n'],
        [b"5\n"],
        [b"[" * 60_000 + b"\n"],
        [b"x" * 2**18],
        [b"["] * 4,
        [GREETING + b'"index": "1", "count": 2, "about": 0}\n'],
        [GREETING + b'"index": [1], "count": {}}\n'],
        [GREETING + b"}\n"],
    ],
    ids="idle http list count text number nested endless slow words lists empty".split(),
)
def test_strangers_neither_end_nor_block_the_meeting(
    lines: list[bytes], address: Address, opened: Any, come: Any
) -> None:
    def stranger() -> None:
        connection = None
        while connection is None:  # until the first listens
            with contextlib.suppress(OSError):
                connection = socket.create_connection(address)
        opened.append(connection)
        with contextlib.suppress(OSError):  # it has been dropped
            for line in lines:
                connection.sendall(line)
                time.sleep(0.1)

    def second() -> Any:
        time.sleep(0.5)
        return come(1, 2)

    began = time.monotonic()
    met, *_ = outcomes = at_once(lambda: come(0, 2), second, *[stranger] * 4)
    assert outcomes == [met, met, *[None] * 4]
    assert met == ["about 0", "about 1"]
    assert time.monotonic() - began < 15


def test_only_the_coordinators_address_is_listened_at(address: Address, come: Any) -> None:
    def elsewhere() -> str:
        time.sleep(0.5)
        with socket.create_connection(("127.0.0.2", address[1])):
            return "heard"

    outcomes = at_once(lambda: come(0, 2, 1), elsewhere)
    assert type(outcomes[1]) is ConnectionRefusedError


def test_a_port_that_is_taken_is_named(address: Address, come: Any) -> None:
    with socket.create_server(address):
        [outcome] = at_once(lambda: come(0, 2))
    where = f"127.0.0.1 port {address[1]}"
    assert message(outcome) == f"process 0 cannot listen at {where}: Address already in use"


@pytest.fixture
def exits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Exit codes of the processes that would have ended."""
    codes: list[int] = []
    monkeypatch.setattr(meeting.os, "_exit", codes.append)
    monkeypatch.setattr(meeting, "KEEP_ALIVE", {})  # pairs of sockets are no TCP
    return codes


@pytest.fixture
def pairs() -> Iterator[list[tuple[socket.socket, socket.socket]]]:
    """Process 0's connections to processes 1 and 2, with those at the other ends."""
    connections = [socket.socketpair(socket.AF_UNIX) for _ in range(2)]
    yield connections
    for pair in connections:
        for end in pair:
            end.close()


def wait_for(condition: Callable[[], object]) -> None:
    until = time.monotonic() + 10
    while not condition() and time.monotonic() < until:
        time.sleep(0.01)


def test_a_lost_process_ends_all_with_a_sentence(
    pairs: Any, exits: list[int], capfd: pytest.CaptureFixture[str]
) -> None:
    """Also those that have no connection to it."""
    (to_1, at_1), (to_2, at_2) = pairs
    watches = [Watch({1: to_1, 2: to_2}), Watch({0: at_2})]
    for watch in watches:
        watch.advice = "; continue with --resume x"
    at_1.close()
    wait_for(lambda: len(exits) == 2)
    assert exits == [1, 1]
    sentence = "mjx-balance: process 1 is gone, and the run ends with it; continue with --resume x"
    assert capfd.readouterr().err.splitlines() == [sentence] * 2


def test_a_silent_machine_counts_as_gone_after_half_a_minute() -> None:
    """Probes after 10 s, four of them 5 s apart; what is sent meanwhile, by milliseconds."""
    idle, interval, count, timeout_ms = (
        meeting.KEEP_ALIVE[f"TCP_{name}"]
        for name in ("KEEPIDLE", "KEEPINTVL", "KEEPCNT", "USER_TIMEOUT")
    )
    assert idle + interval * count == timeout_ms / 1000 == 30


def test_processes_may_leave_once_the_run_has_ended(pairs: Any, exits: list[int]) -> None:
    (to_1, at_1), _ = pairs
    watch = Watch({1: to_1})
    watch.end()
    at_1.close()
    wait_for(lambda: to_1.fileno() == -1)
    assert exits == []
