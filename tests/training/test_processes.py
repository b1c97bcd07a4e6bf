"""What processes agree on, where each of them belongs, and what of a machine is its own."""

import os
import socket
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from unittest import mock

import numpy as np
import pytest

from mjx_balance.config import ConfigError
from mjx_balance.evaluation.rollout import EvaluationError
from mjx_balance.machine import core_ids, cores
from mjx_balance.training import processes
from mjx_balance.training.meeting import Member, ProcessError
from mjx_balance.training.processes import ALONE, Processes, find_cluster, resolve, share_machine

CLUSTERS = "SLURM OMPI KUBERNETES JAX_COORDINATOR".split()
Together = Callable[[int, Callable[[Processes], Any]], list[Any]]


@pytest.fixture
def together(monkeypatch: pytest.MonkeyPatch) -> Together:
    """Number of processes, work of each -> what each returns or raises; they are threads."""

    def together(count: int, work: Callable[[Processes], Any]) -> list[Any]:
        given: list[Any] = [None] * count
        barrier, mine = threading.Barrier(count, timeout=20), threading.local()

        def process_allgather(value: Any) -> np.ndarray:
            given[mine.index] = value
            barrier.wait()
            values = np.stack([np.asarray(x) for x in given])
            barrier.wait()
            return values

        def one(index: int) -> Any:
            mine.index = index
            try:
                return work(Processes(index, count))
            except Exception as error:
                return error

        monkeypatch.setattr(processes.multihost_utils, "process_allgather", process_allgather)
        with ThreadPoolExecutor(count) as pool:
            return list(pool.map(one, range(count)))

    return together


def test_all_get_what_all_give_in_order(together: Together) -> None:
    """Short and long values, of other lengths each; a flag of one is everyone's."""

    def work(us: Processes) -> Any:
        rounds = [us.gather({"i": us.index, "text": "é" * us.index * 20 * k}) for k in range(5)]
        return us.first, rounds, [us.any(us.index == k) for k in range(4)]

    rounds = [[{"i": i, "text": "é" * i * 20 * k} for i in range(3)] for k in range(5)]
    flags = [True, True, True, False]  # nobody has the number 3
    assert together(3, work) == [(i == 0, rounds, flags) for i in range(3)]


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


@pytest.mark.parametrize("error", [ProcessError("x"), ConfigError("x"), EvaluationError("x")])
def test_only_what_all_raise_lets_all_leave(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What one process alone raises ends it: the others wait for it, and see it gone."""
    joined, at_exit = mock.Mock(), mock.Mock()
    monkeypatch.setattr(processes, "_connect", lambda cluster: joined)
    monkeypatch.setattr(processes, "time", mock.Mock())
    monkeypatch.setattr(processes, "atexit", at_exit)
    cluster = processes.Cluster("localhost:1", 2, 0)
    with pytest.raises(type(error)), processes.joined(cluster, (ConfigError,)):
        raise error
    alone = isinstance(error, EvaluationError)
    assert joined.leave.call_count == (not alone)
    assert [call.args[0] for call in at_exit.register.mock_calls] == (
        [processes.exit_at_once] if alone else []
    )


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="Linux binds processes to cores")
def test_processes_of_one_machine_share_its_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that may use the same ones; whoever was bound already stays where it is."""
    bound: list[Sequence[int]] = []
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cores: bound.append(cores))
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: None)

    def share(
        *everyone: tuple[str, list[int]], quota: int = 99
    ) -> tuple[list[Sequence[int]], set[int]]:
        bound.clear()
        known = [Member(machine, tuple(cores), quota) for machine, cores in everyone]
        return bound, {share_machine(known, k) for k in range(len(known))}

    shared, fewest = share(*[("a", [2, 3, 4, 5, 6])] * 3)
    assert sorted(core for cores in shared for core in cores) == [2, 3, 4, 5, 6]
    assert fewest == {1}
    assert share(("a", [0, 1]), ("a", [2, 3, 4])) == ([(0, 1), (2, 3, 4)], {2})
    assert share(("a", [0, 1]), ("b", [0, 1])) == ([(0, 1), (0, 1)], {2})
    assert share(*[("a", [4, 5])] * 3) == ([(4, 5)] * 3, {2}), "too few to share"
    assert share(("a", [0, 1, 2, 3]), ("b", [0, 1]), quota=1)[1] == {1}


def test_cores_are_those_that_a_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a machine of 8; all of them where no system call tells."""
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {5, 2, 3}, raising=False)
    assert (core_ids(), cores()) == ([2, 3, 5], 3)
    monkeypatch.delattr(os, "sched_getaffinity")
    assert (core_ids(), cores()) == (list(range(8)), 8)


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
        (("here:65536", 0, 2), "coordinator is 'here:65536'; it must be HOST:PORT"),
        (("here:0", 0, 2), "coordinator is 'here:0'; it must be HOST:PORT"),
        (("no-such-host.invalid:1", 0, 2), "coordinator is 'no-such-.*'; its host is unknown: "),
        (("localhost:1", -1, 2), "process_id is -1; it must be from 0 to num_processes - 1, 1"),
        (("localhost:1", 2, 2), "process_id is 2; it must be from 0 to num_processes - 1, 1"),
        (("localhost:1", 0, 0), "num_processes is 0; it must be at least 1"),
    ],
)
def test_an_impossible_place_is_refused(flags: tuple[Any, Any, Any], sentence: str) -> None:
    with pytest.raises(ProcessError, match=sentence):
        find_cluster(*flags)


def test_addresses_of_both_kinds_are_read() -> None:
    assert resolve("127.0.0.1:80") == ("127.0.0.1", 80)
    assert resolve("[::1]:5602") == ("::1", 5602)


SLURM = (
    "SLURM_JOB_ID=4242 SLURM_STEP_NODELIST=node[07-09] SLURM_NTASKS=3 SLURM_PROCID=2 "
    "SLURM_LOCALID=0"
)
OPEN_MPI = (
    "OMPI_MCA_orte_hnp_uri=1531576320.0;tcp://10.96.0.1,10.148.0.1:34911 OMPI_COMM_WORLD_SIZE=4 "
    "OMPI_COMM_WORLD_RANK=3 OMPI_COMM_WORLD_LOCAL_RANK=1"
)


@pytest.mark.usefixtures("no_cluster")
@pytest.mark.parametrize(
    ("variables", "host", "place"),
    [(SLURM, "node07:", [3, 2, [0]]), (OPEN_MPI, "10.96.0.1:", [4, 3, [1]])],
)
def test_jax_finds_slurm_and_open_mpi(
    variables: str, host: str, place: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "resolve", lambda address: None)
    for variable in variables.split():
        monkeypatch.setenv(*variable.split("=", 1))
    address, *found = find_cluster(None, None, None)
    assert found == place
    assert address.startswith(host)
    assert find_cluster("other:5", None, None).coordinator_address == "other:5"


@pytest.mark.parametrize("error", [socket.gaierror(-2, "unknown"), UnicodeError("too long")])
def test_a_machine_whose_own_name_is_unknown_is_told(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "node-7\x1b")
    monkeypatch.setattr(socket, "getaddrinfo", mock.Mock(side_effect=error))
    with pytest.raises(ProcessError) as refused:
        processes._check_own_name()
    assert str(refused.value) == (
        r"this machine is called 'node-7\x1b', and no address is known for that name; add it to "
        "/etc/hosts"
    )
