"""Processes that meet, agree, and miss each other; whole runs of two of them over gloo."""

import functools
import os
import socket
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from mjx_balance.training import processes
from mjx_balance.training.processes import (
    ALONE,
    Place,
    ProcessError,
    Processes,
    ProcessLostError,
    find_place,
    meet,
)

REPO = Path(__file__).parents[2]
PATIENCE_S = 300.0
CLUSTERS = "SLURM OMPI KUBERNETES JAX_COORDINATOR".split()


def free_port() -> int:
    with socket.create_server(("", 0)) as server:
        return server.getsockname()[1]


@pytest.fixture(autouse=True)
def no_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(os.environ):
        if name.startswith(tuple(CLUSTERS)):
            monkeypatch.delenv(name)


@pytest.fixture(autouse=True)
def ends(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Exit codes of the processes that would have ended; here they are threads."""
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)
    return codes


def at_once(*calls: Callable[[], Any]) -> list[Any]:
    """What each of several calls returns or raises; no test waits for ever."""
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


def together(count: int, work: Callable[[Processes], Any], patience: float = 20.0) -> list[Any]:
    """What each of several processes returns or raises; the first comes last."""
    address = f"localhost:{free_port()}"

    def one(index: int) -> Any:
        time.sleep(0 if index else 0.3)
        us = meet(Place(address, index, count), patience)
        try:
            return work(us)
        finally:
            us.part()

    return at_once(*(functools.partial(one, index) for index in range(count)))


def said(outcome: Any, kind: type[Exception]) -> str:
    assert type(outcome) is kind, outcome
    return str(outcome)


def test_everyone_gets_what_everyone_gives_in_order() -> None:
    def work(us: Processes) -> Any:
        rounds = [us.gather({"i": us.index, "round": k}) for k in range(20)]
        return us.index, us.count, us.first, rounds

    wanted = [[{"i": i, "round": k} for i in range(3)] for k in range(20)]
    assert together(3, work) == [(i, 3, i == 0, wanted) for i in range(3)]


def test_one_flag_is_everyones() -> None:
    def work(us: Processes) -> Any:
        return [us.any(us.index == k) for k in range(4)], us.any(False)

    # Nobody has the number 3.
    assert together(3, work) == [([True, True, True, False], False)] * 3


def test_the_first_one_acts_for_all() -> None:
    calls = []

    def work(us: Processes) -> Any:
        def act() -> list[int]:
            calls.append(us.index)
            return [7]

        def refuse() -> None:
            raise FileNotFoundError("no folder")

        value = us.from_first(act)
        with pytest.raises(FileNotFoundError, match="no folder"):
            us.from_first(refuse, KeyError, FileNotFoundError)
        return value, us.gather(us.index)  # they are in step still

    assert together(2, work) == [([7], [0, 1])] * 2
    assert calls == [0]


def test_what_fails_in_one_process_fails_in_all() -> None:
    def work(us: Processes) -> Any:
        def check() -> int:
            if us.index == 1:
                raise FileNotFoundError("no memory")
            return us.index

        values = [us.everywhere(lambda: us.index)]
        with pytest.raises(FileNotFoundError) as caught:
            us.everywhere(check, KeyError, FileNotFoundError)
        return values, str(caught.value), us.gather(us.index)

    said = ["process 1: no memory", "no memory", "process 1: no memory"]
    assert together(3, work) == [([k], said[k], [0, 1, 2]) for k in range(3)]
    assert ALONE.everywhere(lambda: 3) == 3


def test_what_differs_is_named_by_all() -> None:
    def work(us: Processes) -> None:
        us.check_same({"seed": 0, "versions": {"jax": "1"}})
        us.check_same({"seed": 0, "gamma": 0.1 if us.index < 2 else 0.2})

    wanted = (
        "process 2 has gamma = 0.2, process 0 has 0.1; start all with the same flags and the same "
        "installation"
    )
    assert [said(x, ProcessError) for x in together(3, work)] == [wanted] * 3


def test_who_leaves_is_missed_by_those_who_wait_for_it(ends: list[int]) -> None:
    def work(us: Processes) -> Any:
        us.gather(None)
        if us.index == 1:
            us.part()
            return "left"
        return us.gather(None)

    outcomes = together(2, work)
    assert said(outcomes[0], ProcessLostError) == "process 1 has left before the others"
    assert outcomes[1] == "left"
    assert not ends


@pytest.mark.parametrize("lost", [0, 1])
def test_who_is_lost_ends_all_with_a_sentence(
    lost: int, ends: list[int], capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Also those that have no connection to it, and that wait for nothing."""
    over = threading.Barrier(3)

    def work(us: Processes) -> None:
        us.folder = tmp_path
        us.gather(None)
        if us.index == lost:
            us._parted = True  # who is killed ends nobody
            for connection in us._sockets.values():
                connection.shutdown(socket.SHUT_RDWR)
        until = time.monotonic() + 10
        while len(ends) < 2 and time.monotonic() < until:
            time.sleep(0.01)
        over.wait(20)

    together(3, work)
    assert set(ends) == {1}
    lines = capfd.readouterr().err.splitlines()
    wanted = f"mjx-balance: process {lost} is gone, and the run ends with it; continue with "
    assert lines.count(f"{wanted}--resume {tmp_path}") == 2


def test_nobody_waits_for_ever_for_one_that_does_not_come() -> None:
    address = f"localhost:{free_port()}"
    outcomes = at_once(*(lambda k=k: meet(Place(address, k, 3), 1.0) for k in (0, 2)))
    sentences = [said(x, ProcessError) for x in outcomes]
    assert sentences == [f"process 1 has not come to {address} in 1 s"] * 2
    [outcome] = at_once(lambda: meet(Place(address, 1, 2), 0.5))
    assert f"process 0 does not answer at {address} within 0.5 s" in said(outcome, ProcessError)


@pytest.mark.parametrize(
    ("second", "said_of_it"), [((1, 3), "number 1 of 3"), ((2, 4), "number 2 of 4")]
)
def test_processes_that_count_differently_are_refused(
    second: tuple[int, int], said_of_it: str
) -> None:
    """Two with the same number, and one that knows of another number of them."""
    address = f"localhost:{free_port()}"
    places = [Place(address, 0, 3), Place(address, 1, 3), Place(address, *second)]

    def one(place: Place, wait: float) -> Any:
        time.sleep(wait)
        return meet(place, 20)

    outcomes = at_once(*(lambda k=k: one(places[k], 0.3 * k) for k in range(3)))
    [sentence] = {said(x, ProcessError) for x in outcomes}
    assert sentence == (
        f"a process came to {address} as {said_of_it}, process 0 waits for 3, and has met [1]"
    )


def test_a_stranger_is_let_go() -> None:
    port = free_port()

    def stranger() -> bytes:
        time.sleep(0.2)
        with socket.create_connection(("localhost", port)) as connection:
            connection.sendall(b"GET / HTTP/1.1\n")
            return connection.recv(10)

    def ours(index: int, wait: float) -> str:
        time.sleep(wait)
        us = meet(Place(f"localhost:{port}", index, 2), 20)
        us.part()
        return "met"

    outcomes = at_once(lambda: ours(0, 0), stranger, lambda: ours(1, 1.0))
    assert outcomes == ["met", b"", "met"]


def test_a_port_that_is_taken_is_said() -> None:
    with socket.create_server(("", 0)) as server:
        address = f"localhost:{server.getsockname()[1]}"
        with pytest.raises(ProcessError, match=f"process 0 cannot listen at {address}: Address al"):
            meet(Place(address, 0, 2), 1)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="Linux binds processes to cores")
def test_processes_of_one_machine_share_its_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that may use the same ones; whoever was bound already stays where it is."""
    mine = threading.local()
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: mine.cores)
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cores: setattr(mine, "cores", cores))

    def bound(all_cores: Sequence[set[int]]) -> list[list[int]]:
        def work(us: Processes) -> Any:
            mine.cores = all_cores[us.index]
            processes._share_cores(us)
            return sorted(mine.cores)

        return together(len(all_cores), work)

    shared = bound([set(range(2, 7))] * 3)
    assert sorted(core for cores in shared for core in cores) == [2, 3, 4, 5, 6]
    assert {len(cores) for cores in shared} == {1, 2}
    assert bound([{0, 1}, {2, 3}]) == [[0, 1], [2, 3]]
    assert bound([{4}, {4}]) == [[4], [4]], "too few to share"


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ((None, None, None), "say --coordinator, --process-id, --num-processes too"),
        (("a:1", None, 2), "say --process-id too"),
        (("here", 0, 2), "coordinator is 'here'; it must be HOST:PORT of process 0"),
        (("here:99999", 0, 2), "coordinator is 'here:99999'; it must be HOST:PORT"),
        (("a:1", 2, 2), "process_id is 2; it must be from 0 to num_processes - 1, 1"),
        (("a:1", 0, 0), "num_processes is 0; it must be at least 1"),
    ],
)
def test_a_place_that_is_none_is_refused(flags: tuple[Any, Any, Any], sentence: str) -> None:
    with pytest.raises(ProcessError, match=sentence):
        find_place(*flags)


def test_jax_finds_slurm_and_open_mpi(monkeypatch: pytest.MonkeyPatch) -> None:
    slurm = {"JOB_ID": 4242, "STEP_NODELIST": "node[07-09]", "NTASKS": 3, "PROCID": 2, "LOCALID": 0}
    for name, value in slurm.items():
        monkeypatch.setenv(f"SLURM_{name}", str(value))
    place = find_place(None, None, None)
    assert (place.index, place.count, place.local_devices) == (2, 3, [0])
    assert place.address.startswith("node07:")
    assert find_place("other:5", None, None).address == "other:5"
    for name in slurm:
        monkeypatch.delenv(f"SLURM_{name}")
    monkeypatch.setenv("OMPI_MCA_orte_hnp_uri", "1531576320.0;tcp://10.96.0.1,10.148.0.1:34911")
    for name, value in (("SIZE", 4), ("RANK", 3), ("LOCAL_RANK", 1)):
        monkeypatch.setenv(f"OMPI_COMM_WORLD_{name}", str(value))
    place = find_place(None, None, None)
    assert (place.index, place.count, place.local_devices) == (3, 4, [1])
    assert place.address.startswith("10.96.0.1:")
