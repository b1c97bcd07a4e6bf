"""Hellos and answers of strangers who know the protocol of a meeting, and break it at random."""

import contextlib
import dataclasses
import json
import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from mjx_balance.training.meeting import Hello, Member, ProcessError, host, visit

pytestmark = pytest.mark.slow

Address = tuple[str, int]
OWN = Member("machine", (0, 1), 2)
PATIENCE_S = 20.0
JUNK: tuple[Callable[[random.Random], Any], ...] = (
    lambda rng: None,
    lambda rng: rng.choice((True, False, 0, 1, -1, 2**31, 2**63, 10**400, 0.5, -0.0, 1e308)),
    lambda rng: rng.choice((float("nan"), float("inf"))),
    lambda rng: "".join(chr(rng.choice((0, 10, 27, 34, 92, 127, 0xD800, 0x202E))) for _ in "12345"),
    lambda rng: "x" * rng.choice((0, 1, 300, 10_000, 100_000)),
    lambda rng: [[]] * rng.choice((0, 1, 1000)),
    lambda rng: {"": {}},
    lambda rng: json.loads("[" * 500 + "]" * 500),
)


def mutate(value: Any, rng: random.Random) -> Any:
    """The same with a place or two that are wrong: a value, a name, an entry more or less."""
    if isinstance(value, dict) and value and rng.random() < 0.8:
        name = rng.choice(list(value))
        changed = dict(value)
        kind = rng.randrange(4)
        if kind < 2:
            changed[name] = mutate(value[name], rng)
        else:
            del changed[name]
        if kind == 3:
            changed[rng.choice((name + "s", "", "__class__", "lost"))] = value[name]
        return changed
    if isinstance(value, list) and value and rng.random() < 0.5:
        k = rng.randrange(len(value))
        return [*value[:k], mutate(value[k], rng), *value[k + rng.randrange(2) :]]
    return rng.choice(JUNK)(rng)


def to_bytes(message: Any, rng: random.Random) -> bytes:
    """A line of JSON, sometimes cut, doubled, without its end, or with bytes that are no text."""
    line = json.dumps(message).encode() + b"\n"
    k = rng.randrange(len(line))
    return rng.choice(
        (
            *(line, line, line, line + line, line[:-1], line[:k], line[:k] + b"\n" + line[k:]),
            line[:k] + bytes([rng.randrange(256)]) + line[k + 1 :],
            rng.randbytes(k + 1) + b"\n",
            b"\xff\xfe" + line,
            b"[" * 70_000 + b"\n",
        )
    )


def send(connection: socket.socket, data: bytes, rng: random.Random) -> None:
    """Sends in one piece or some; then waits, hangs up, or resets the connection."""
    with contextlib.suppress(OSError):
        cut = rng.randrange(len(data) + 1)
        for part in (data[:cut], data[cut:]):
            connection.sendall(part)
            time.sleep(rng.choice((0, 0, 0.05)))
        end = rng.randrange(4)
        if end == 1:
            connection.shutdown(socket.SHUT_WR)
        if end == 2:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        if end > 1:
            connection.close()


def start(call: Callable[[], Any], outcomes: dict[str, Any], name: str) -> threading.Thread:
    """Runs a call in a thread; its outcome is what it returns or raises."""

    def work() -> None:
        try:
            outcomes[name] = call()
        except BaseException as error:
            outcomes[name] = error

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


def assert_sentence(error: Any) -> None:
    assert type(error) is ProcessError, repr(error)
    assert str(error).isprintable()
    assert len(str(error)) <= 300


def stranger(address: Address, rng: random.Random, opened: list[socket.socket]) -> bool:
    """Calls once; whether it could be taken for a process, which may end the meeting."""
    with contextlib.suppress(OSError, ValueError):
        connection = socket.create_connection(address, timeout=5)
        opened.append(connection)
        nonce = json.loads(connection.makefile("rb").readline())["mjx_balance"]
        is_known = rng.random() < 0.7
        if not is_known:
            nonce = rng.choice(("", nonce[:-1], nonce.upper() + " ", "0" * 64))
        hello = Hello(nonce, 1, rng.choice((2, 3)), OWN)
        message = dataclasses.asdict(hello)
        if is_known or rng.random() < 0.5:
            message = mutate(message, rng)
        send(connection, to_bytes(message, rng), rng)
        return is_known
    return False


def test_strangers_never_harm_a_meeting(
    rounds: Iterator[random.Random], address: Address, opened: list[socket.socket]
) -> None:
    """It comes together, or a stranger who knew its number was taken for a process: a sentence."""
    met = count = 0
    for rng in rounds:
        outcomes: dict[str, Any] = {}
        first = start(lambda: host(address, 2, OWN, PATIENCE_S), outcomes, "host")
        time.sleep(0.05)
        known = [stranger(address, rng, opened) for _ in range(rng.randrange(12))]
        second = start(lambda: visit(address, 1, 2, OWN, 3), outcomes, "visitor")
        known += [stranger(address, rng, opened) for _ in range(rng.randrange(4))]
        second.join(15)
        first.join(15)
        assert set(outcomes) == {"host", "visitor"}, "nobody hangs"
        count += 1
        for outcome in outcomes.values():
            if isinstance(outcome, tuple):
                process_0, other = outcome[1]
                assert process_0 == OWN
                assert other == OWN or any(known)
                opened += outcome[0].values()
            else:
                assert any(known)
                assert_sentence(outcome)
        met += all(isinstance(x, tuple) for x in outcomes.values())
        while opened:
            opened.pop().close()
    assert met > 0.8 * count


def test_whatever_answers_a_visitor_is_refused(
    rounds: Iterator[random.Random], opened: list[socket.socket]
) -> None:
    """In place of process 0: a greeting, then what all say, then a refusal, all of them wrong."""
    member = dataclasses.asdict(OWN)
    answers = ({"mjx_balance": "7"}, {"everyone": [member, member]}, {"refusal": "no \x1b[2J"})
    for rng in rounds:
        with socket.create_server(("127.0.0.1", 0)) as server:
            outcomes: dict[str, Any] = {}
            where = server.getsockname()
            visitor = start(lambda at=where: visit(at, 1, 2, OWN, 0.3), outcomes, "visitor")
            server.settimeout(0.1)
            until = time.monotonic() + 0.4
            while time.monotonic() < until and not outcomes:
                with contextlib.suppress(OSError):
                    opened.append(server.accept()[0])
                    greeting, *later = answers
                    if rng.random() < 0.3:
                        greeting = mutate(greeting, rng)
                    opened[-1].sendall(json.dumps(greeting).encode() + b"\n")
                    message = rng.choice(later)
                    if rng.random() < 0.8:
                        message = mutate(message, rng)
                    send(opened[-1], to_bytes(message, rng), rng)
        while opened:
            opened.pop().close()
        visitor.join(10)
        outcome = outcomes["visitor"]
        if isinstance(outcome, tuple):
            assert all(isinstance(x, Member) for x in outcome[1])
            opened += outcome[0].values()
        else:
            assert_sentence(outcome)
