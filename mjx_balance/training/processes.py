"""What the processes of a run, on one machine or many, do together: over `jax.distributed`."""

import atexit
import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar, cast

import jax
import numpy as np
from jax.experimental import multihost_utils

from mjx_balance.errors import FAILED, INTERRUPTED
from mjx_balance.training.cluster import (
    PATIENCE_S,
    Cluster,
    describe_machine,
    free_address,
    resolve,
    share_machine,
)
from mjx_balance.training.meeting import ProcessError, Watch, host, visit

T = TypeVar("T")


class Processes:
    """All processes of a run, as one of them sees them; all of them call the same methods."""

    def __init__(
        self, index: int = 0, count: int = 1, watch: Watch | None = None, cores: int | None = None
    ):
        """Of process `index` of `count`, whose devices JAX has connected.

        Args:
          index: of this process.
          count: of all.
          watch: notices those that die.
          cores: that every process has; as many as there are if None.
        """
        self.index, self.count, self.cores, self._watch = index, count, cores, watch

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
        """Returns what a function returns in this process, once it has returned in all of them.

        Args:
          function: called in every process.
          errors: what it may raise; all processes raise it then, with the message of the first.
        """
        value, failure = None, None
        try:
            value = function()
        except errors as error:
            failure = error
        kinds = [kind.__name__ for kind in errors if isinstance(failure, kind)]
        failures = self.gather([kinds[0], str(failure)] if kinds else None)
        if failure is None and any(failures):
            k, (name, message) = next((k, x) for k, x in enumerate(failures) if x)
            kind = next(kind for kind in errors if kind.__name__ == name)
            failure = kind(f"process {k}: {message}" if k else message)
        if failure is not None:
            raise failure
        return cast(T, value)

    def broadcast(self, function: Callable[[], T], *errors: type[Exception]) -> T:
        """Returns in all processes the JSON value that a function returns in the first.

        Args:
          function: called in the first process alone.
          errors: what it may raise; all processes raise it then.
        """
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
        """Sets what the user reads besides if another process is gone."""
        if self._watch is not None:
            self._watch.advice = advice

    def leave(self) -> None:
        """Disconnects the devices, all processes at once; a process that ends before is missed."""
        if self._watch is not None:
            self._watch.end()
            with contextlib.suppress(jax.errors.JaxRuntimeError):
                jax.distributed.shutdown()


ALONE = Processes()
"""A run of one process."""


@contextlib.contextmanager
def joined(cluster: Cluster | None, orderly: tuple[type[Exception], ...]) -> Iterator[Processes]:
    """This process among all others of the run; alone without a cluster. Before JAX is used.

    Args:
      cluster: from `find_cluster`.
      orderly: errors that all processes raise together: nobody is missed then.

    Raises:
      ProcessError: if not all come in time, or they do not fit together.
    """
    if cluster is None or cluster.num_processes == 1:
        yield ALONE
        return
    processes = _connect(cluster)
    try:
        yield processes
    except (ProcessError, *orderly):
        processes.leave()
        raise
    except BaseException as error:
        time.sleep(2)  # if that is because of a process that is gone, it is said meanwhile
        # At its exit JAX would wait for the others, who may wait for this process.
        atexit.register(_exit, INTERRUPTED if isinstance(error, KeyboardInterrupt) else FAILED)
        raise
    processes.leave()


def _exit(code: int) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _connect(cluster: Cluster) -> Processes:
    """Meets the others, shares the machine with them and connects the devices of all."""
    index, count = cluster.process_id, cluster.num_processes
    ip, port = resolve(cluster.coordinator_address)
    if index:
        connections, everyone = visit((ip, port), index, count, describe_machine(), PATIENCE_S)
    else:
        about = describe_machine() | {"service": free_address(ip)}
        connections, everyone = host((ip, port), count, about, PATIENCE_S)
    watch = Watch(connections)
    num_cores = share_machine(everyone, index)
    os.environ["no_grpc_proxy"] = ip  # noqa: SIM112
    jax.config.update("jax_check_proxy_envs", False)
    jax.distributed.initialize(
        everyone[0]["service"],
        count,
        index,
        local_device_ids=cluster.local_device_ids,
        cluster_detection_method="deactivate",
        coordinator_bind_address=everyone[0]["service"],
        initialization_timeout=300,
        shutdown_timeout_seconds=300,
    )
    return Processes(index, count, watch, num_cores)
