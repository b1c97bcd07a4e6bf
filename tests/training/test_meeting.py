"""Processes that meet over sockets among strangers, and miss one another: here they are threads."""

import contextlib
import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from mjx_balance.training import meeting
from mjx_balance.training.meeting import Member, ProcessError, Watch, host, visit

Address = tuple[str, int]


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
def come(address: Address, opened: list[socket.socket]) -> Callable[..., Any]:
    """Index, count -> the machines of all, as a process gets to know them."""

    def come(index: int, count: int, patience_s: float = 20, at: Address = address) -> Any:
        own = Member(f"machine {index}", tuple(range(128)), 128)
        if index:
            connections, everyone = visit(at, index, count, own, patience_s)
        else:
            connections, everyone = host(at, count, own, patience_s)
        opened.extend(connections.values())
        assert {x.cores for x in everyone} == {own.cores}
        return [x.machine for x in everyone]

    return come


def message(outcome: Any) -> str:
    assert type(outcome) is ProcessError, outcome
    return str(outcome)


def wait_for(condition: Callable[[], object]) -> None:
    until = time.monotonic() + 10
    while not condition() and time.monotonic() < until:
        time.sleep(0.01)


def test_all_get_to_know_of_all(come: Any) -> None:
    calls = [lambda k=k: come(k, 3) for k in (2, 1, 0)]
    assert at_once(*calls) == [["machine 0", "machine 1", "machine 2"]] * 3


def test_what_many_processes_say_may_be_longer_than_a_hello(
    address: Address, monkeypatch: pytest.MonkeyPatch, come: Any
) -> None:
    """Three members of some 500 bytes each."""
    monkeypatch.setattr(meeting, "LINE_BYTES", 1000)
    assert at_once(*(lambda k=k: come(k, 3) for k in range(3)))[2] == [
        *("machine 0", "machine 1", "machine 2")
    ]


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


def hello(**changes: Any) -> bytes:
    """The line of a process 1 of 2 that has not read its number."""
    member = {"machine": "m", "cores": [0], "num_cores": 1, "service": ""}
    fields = {"mjx_balance": "0" * 64, "index": 1, "count": 2, "member": member}
    return json.dumps(fields | changes).encode() + b"\n"


def knock(address: Address, seconds: float = 10) -> socket.socket:
    """Connects as soon as somebody listens."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        with contextlib.suppress(OSError):
            return socket.create_connection(address)
    raise ConnectionRefusedError


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
        [hello()],
        [hello(count=3)],
        [hello(), b'{"lost": "\\u001b[2J"}\n'],
        [hello(index=[1], count={}, member="x")],
        [hello(index=True), b"\0" * 1000],
    ],
    ids="idle http list count text number nested endless slow recorded miscounts talks types "
    "bool".split(),
)
def test_strangers_neither_end_nor_block_the_meeting(
    lines: list[bytes], address: Address, opened: Any, come: Any
) -> None:
    def stranger() -> None:
        opened.append(knock(address))
        with contextlib.suppress(OSError):  # it has been dropped
            for line in lines:
                opened[-1].sendall(line)
                time.sleep(0.02)

    def second() -> Any:
        wait_for(lambda: len(opened) == 4)
        time.sleep(0.1)
        return come(1, 2)

    began = time.monotonic()
    met, *_ = outcomes = at_once(lambda: come(0, 2), second, *[stranger] * 4)
    assert outcomes == [met, met, *[None] * 4]
    assert met == ["machine 0", "machine 1"]
    assert time.monotonic() - began < 15


def say_little(callers: list[socket.socket]) -> None:
    for caller in callers[-10:]:
        with contextlib.suppress(OSError):  # it has been dropped
            caller.sendall(b"[")


def scan(callers: list[socket.socket]) -> None:
    """As a port scanner does: away at once, without a goodbye."""
    callers[-1].setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    callers.pop().close()


@pytest.mark.parametrize("behave", [len, say_little, scan], ids=["idle", "slow", "reset"])
def test_no_number_of_strangers_keeps_a_process_out(
    behave: Callable[[list[socket.socket]], Any],
    address: Address,
    monkeypatch: pytest.MonkeyPatch,
    come: Any,
) -> None:
    """Three times as many as may wait, and more of them until the end."""
    monkeypatch.setattr(meeting, "CALLERS", 30)
    full, over = threading.Event(), threading.Event()

    def flood() -> None:
        callers, came = [knock(address)], 0
        with contextlib.suppress(OSError):  # the meeting is over
            while not over.is_set():
                callers.append(knock(address, 0.1))
                came += 1
                behave(callers)
                if came > 3 * meeting.CALLERS:
                    full.set()
                    time.sleep(0.01)
                if len(callers) > 3 * meeting.CALLERS:
                    callers.pop(0).close()
        for caller in callers:
            caller.close()

    def second() -> Any:
        full.wait(10)
        try:
            return come(1, 2)
        finally:
            over.set()

    outcomes = at_once(lambda: come(0, 2), second, flood)
    assert outcomes == [["machine 0", "machine 1"]] * 2 + [None]


def test_a_byte_a_second_is_no_hello(
    address: Address, monkeypatch: pytest.MonkeyPatch, opened: Any, come: Any
) -> None:
    """However many come: the time for a hello is counted from its first byte."""
    monkeypatch.setattr(meeting, "HELLO_S", 0.2)

    def drip() -> float:
        opened.append(knock(address))
        began = time.monotonic()
        with contextlib.suppress(OSError):
            while time.monotonic() - began < 5:
                opened[0].sendall(b"[")
                time.sleep(0.1)
        return time.monotonic() - began

    _, seconds = at_once(lambda: come(0, 2, 1.5), drip)
    assert seconds < 1.2


def test_the_oldest_strangers_make_room(
    address: Address, opened: list[socket.socket], monkeypatch: pytest.MonkeyPatch, come: Any
) -> None:
    """Of seven idle ones only the newest three stay, long before their time is over."""
    monkeypatch.setattr(meeting, "CALLERS", 3)
    monkeypatch.setattr(meeting, "HELLO_S", 60)

    def dropped(caller: socket.socket) -> bool:
        caller.settimeout(0.2)
        with contextlib.suppress(TimeoutError):
            while caller.recv(1000):
                pass
            return True
        return False

    def second() -> Any:
        strangers = [knock(address) for _ in range(7)]
        opened.extend(strangers)
        wait_for(lambda: dropped(strangers[3]))
        states = [dropped(stranger) for stranger in strangers]
        come(1, 2)
        return states

    assert at_once(lambda: come(0, 2), second)[1] == [True] * 4 + [False] * 3


def test_a_process_that_was_killed_may_come_again(address: Address, come: Any) -> None:
    """As long as another one is awaited; nobody waits for the one that is gone."""

    def killed() -> None:
        connection = knock(address)
        greeting = json.loads(connection.makefile("rb").readline())
        connection.sendall(hello(mjx_balance=greeting["mjx_balance"], count=3))
        time.sleep(0.3)
        connection.close()

    def late(index: int) -> Any:
        time.sleep(0.8)
        return come(index, 3)

    first, _, *others = at_once(lambda: come(0, 3), killed, lambda: late(1), lambda: late(2))
    assert first == ["machine 0", "machine 1", "machine 2"]
    assert others == [first, first]


def play_first(address: Address, answer: bytes = b"") -> None:
    """A process 0 that greets one process, answers its hello, and goes."""
    with socket.create_server(address) as server:
        connection, _ = server.accept()
    with connection:
        connection.sendall(b'{"mjx_balance": "1"}\n')
        connection.recv(10_000)
        connection.sendall(answer)


def test_whoever_comes_after_the_meeting_is_told(address: Address, come: Any) -> None:
    """Process 0 has gone while process 1 waits for process 2."""
    _, outcome = at_once(lambda: play_first(address), lambda: come(1, 3))
    assert message(outcome) == f"process 0 has left the meeting at 127.0.0.1 port {address[1]}"


def test_one_of_several_with_the_same_number_is_let_in(address: Address, come: Any) -> None:
    """The others are told, and their connections are closed: pytest counts open ones as errors."""
    _, *outcomes = at_once(lambda: come(0, 2), *[lambda: come(1, 2, 3)] * 6)
    refused = [message(x) for x in outcomes if isinstance(x, Exception)]
    assert len(refused) == 5


@pytest.mark.parametrize("banner", [b"", b"SSH-2.0-x\r\n", b'{"mjx_balance": 5}\n', b"[" * 10**5])
def test_another_service_at_the_address_is_not_joined(
    banner: bytes, address: Address, opened: Any, come: Any
) -> None:
    over = threading.Event()

    def service() -> None:
        with socket.create_server(address) as server:
            server.settimeout(0.05)
            while not over.is_set():
                with contextlib.suppress(OSError):
                    opened.append(server.accept()[0])
                    opened[-1].sendall(banner)

    def visitor() -> Any:
        try:
            return come(1, 2, 0.6)
        finally:
            over.set()

    [outcome, _] = at_once(visitor, service)
    assert "within 0.6 s (what answers is no process 0); is it started" in message(outcome)


@pytest.mark.parametrize(
    "everyone", [5, [], [{"machine": "m"}], [{"machine": 1, "cores": [], "num_cores": 1}] * 2]
)
def test_what_process_0_says_is_checked(everyone: Any, address: Address, come: Any) -> None:
    answer = json.dumps({"everyone": everyone}).encode() + b"\n"
    _, outcome = at_once(lambda: play_first(address, answer), lambda: come(1, 2))
    assert len(message(outcome)) < 300


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


@pytest.mark.parametrize("lost", ["\x1b[2J", "\ud800", [[1]] * 500, 10**400, None])
def test_what_a_peer_says_reaches_the_terminal_short_and_safe(
    lost: Any, pairs: Any, exits: list[int], capfd: pytest.CaptureFixture[str]
) -> None:
    (to_1, at_1), _ = pairs
    Watch({1: to_1})
    at_1.sendall(json.dumps({"lost": lost}).encode() + b"\n")
    wait_for(lambda: exits)
    assert exits == [1]
    line = capfd.readouterr().err.removesuffix("\n")
    assert line.isprintable()
    assert len(line) < 200


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
