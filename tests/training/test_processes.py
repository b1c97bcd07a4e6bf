"""What processes agree on, where each of them belongs, and what of a machine is its own."""

import os
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from mjx_balance.training import cluster, processes
from mjx_balance.training.cluster import find_cluster, resolve, share_machine
from mjx_balance.training.meeting import ProcessError
from mjx_balance.training.processes import ALONE, Processes

CLUSTERS = "SLURM OMPI KUBERNETES JAX_COORDINATOR".split()
Together = Callable[[int, Callable[[Processes], Any]], list[Any]]


@pytest.fixture
def together(monkeypatch: pytest.MonkeyPatch) -> Together:
    """Number of processes, work of each -> what each returns or raises; they are threads."""

    def together(count: int, work: Callable[[Processes], Any]) -> list[Any]:
        given: list[Any] = [None] * count
        barrier, mine = threading.Barrier(count, timeout=20), threading.local()
        outcomes: list[Any] = [None] * count

        def process_allgather(value: Any) -> np.ndarray:
            given[mine.index] = value
            barrier.wait()
            values = np.stack([np.asarray(x) for x in given])
            barrier.wait()
            return values

        def one(index: int) -> None:
            mine.index = index
            try:
                outcomes[index] = work(Processes(index, count))
            except Exception as error:
                outcomes[index] = error

        monkeypatch.setattr(processes.multihost_utils, "process_allgather", process_allgather)
        threads = [threading.Thread(target=one, args=(k,)) for k in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return outcomes

    return together


def test_all_get_what_all_give_in_order(together: Together) -> None:
    """Short and long values, of other lengths each."""

    def work(us: Processes) -> Any:
        rounds = [us.gather({"i": us.index, "text": "é" * us.index * 20 * k}) for k in range(5)]
        return us.first, rounds

    rounds = [[{"i": i, "text": "é" * i * 20 * k} for i in range(3)] for k in range(5)]
    assert together(3, work) == [(i == 0, rounds) for i in range(3)]


def test_one_flag_is_everyones(together: Together) -> None:
    def work(us: Processes) -> Any:
        return [us.any(us.index == k) for k in range(4)], us.any(False)

    # Nobody has the number 3.
    assert together(3, work) == [([True, True, True, False], False)] * 3


def test_the_first_acts_for_all(together: Together) -> None:
    calls = []

    def work(us: Processes) -> Any:
        def act() -> list[int]:
            calls.append(us.index)
            return [7]

        def refuse() -> None:
            raise FileNotFoundError("no folder")

        value = us.broadcast(act)
        with pytest.raises(OSError, match="no folder"):
            us.broadcast(refuse, KeyError, OSError)
        return value, us.gather(us.index)  # they are in step still

    assert together(2, work) == [([7], [0, 1])] * 2
    assert calls == [0]


def test_what_fails_in_one_process_fails_in_all(together: Together) -> None:
    def work(us: Processes) -> Any:
        def check() -> int:
            if us.index == 1:
                raise FileNotFoundError("no memory")
            return us.index

        values = [us.run_on_all(lambda: us.index)]
        with pytest.raises(FileNotFoundError) as caught:
            us.run_on_all(check, KeyError, FileNotFoundError)
        return values, str(caught.value), us.gather(us.index)

    messages = ["process 1: no memory", "no memory", "process 1: no memory"]
    assert together(3, work) == [([k], messages[k], [0, 1, 2]) for k in range(3)]
    assert ALONE.run_on_all(lambda: work) is work


def test_what_differs_is_named_by_all(together: Together) -> None:
    def work(us: Processes) -> None:
        us.check_same({"seed": 0, "versions": {"jax": "1"}})
        us.check_same({"seed": 0, "gamma": 0.1 if us.index < 2 else 0.2})

    outcomes = together(3, work)
    assert {type(x) for x in outcomes} == {ProcessError}
    assert {str(x) for x in outcomes} == {
        "process 2 has gamma = 0.2, process 0 has 0.1; start all with the same flags and the same "
        "installation"
    }


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="Linux binds processes to cores")
def test_processes_of_one_machine_share_its_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that may use the same ones; whoever was bound already stays where it is."""
    bound: list[Sequence[int]] = []
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cores: bound.append(cores))
    monkeypatch.setattr(cluster, "_let_threads_finish", lambda: None)

    def share(*everyone: tuple[str, list[int]]) -> tuple[list[Sequence[int]], set[int]]:
        bound.clear()
        known = [{"machine": machine, "cores": cores} for machine, cores in everyone]
        known[0]["service"] = "process 0 says more"
        return bound, {share_machine(known, k) for k in range(len(known))}

    shared, fewest = share(*[("a", [2, 3, 4, 5, 6])] * 3)
    assert sorted(core for cores in shared for core in cores) == [2, 3, 4, 5, 6]
    assert fewest == {1}
    assert share(("a", [0, 1]), ("a", [2, 3, 4])) == ([[0, 1], [2, 3, 4]], {2})
    assert share(("a", [0, 1]), ("b", [0, 1])) == ([[0, 1], [0, 1]], {2})
    assert share(("a", [4]), ("a", [4])) == ([[4], [4]], {1}), "too few to share"


@pytest.fixture
def no_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(os.environ):
        if name.startswith(tuple(CLUSTERS)):
            monkeypatch.delenv(name)


@pytest.mark.usefixtures("no_cluster")
@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ((None, None, None), "say --coordinator, --process-id, --num-processes too"),
        (("localhost:1", None, 2), "say --process-id too"),
        (("here", 0, 2), "coordinator is 'here'; it must be HOST:PORT of process 0"),
        (("here:99999", 0, 2), "coordinator is 'here:99999'; it must be HOST:PORT"),
        (("no-such-host.invalid:1", 0, 2), "coordinator is 'no-such-.*'; its host is unknown: "),
        (("localhost:1", 2, 2), "process_id is 2; it must be from 0 to num_processes - 1, 1"),
        (("localhost:1", 0, 0), "num_processes is 0; it must be at least 1"),
    ],
)
def test_a_place_that_is_none_is_refused(flags: tuple[Any, Any, Any], sentence: str) -> None:
    with pytest.raises(ProcessError, match=sentence):
        find_cluster(*flags)


def test_addresses_of_both_kinds_are_read() -> None:
    assert resolve("127.0.0.1:80") == ("127.0.0.1", 80)
    assert resolve("[::1]:5602") == ("::1", 5602)


@pytest.mark.usefixtures("no_cluster")
def test_jax_finds_slurm_and_open_mpi(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "resolve", lambda address: None)
    slurm = {"JOB_ID": 4242, "STEP_NODELIST": "node[07-09]", "NTASKS": 3, "PROCID": 2, "LOCALID": 0}
    for name, value in slurm.items():
        monkeypatch.setenv(f"SLURM_{name}", str(value))
    address, *place = find_cluster(None, None, None)
    assert place == [3, 2, [0]]
    assert str(address).startswith("node07:")
    assert find_cluster("other:5", None, None).coordinator_address == "other:5"
    for name in slurm:
        monkeypatch.delenv(f"SLURM_{name}")
    monkeypatch.setenv("OMPI_MCA_orte_hnp_uri", "1531576320.0;tcp://10.96.0.1,10.148.0.1:34911")
    for name, value in (("SIZE", 4), ("RANK", 3), ("LOCAL_RANK", 1)):
        monkeypatch.setenv(f"OMPI_COMM_WORLD_{name}", str(value))
    address, *place = find_cluster(None, None, None)
    assert place == [4, 3, [1]]
    assert str(address).startswith("10.96.0.1:")
