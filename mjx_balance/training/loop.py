"""The loop of a run: calls of the compiled program, metrics, checkpoints, interrupts."""

import atexit
import dataclasses
import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from mjx_balance.config import Config, expand_runs
from mjx_balance.dqn import DQN, TrainState
from mjx_balance.envs.balance import BalanceEnv, Metric
from mjx_balance.files.run_folder import RunFolder, keep_metrics_until, keep_validated_until
from mjx_balance.report.progress import Display
from mjx_balance.training import checkpoints
from mjx_balance.training.callbacks import Callbacks
from mjx_balance.training.processes import ALONE, Processes, exit_at_once
from mjx_balance.training.tensorboard import Board

T = TypeVar("T")

LEARNER_METRICS = {
    "reward": Metric(per_seed=True),
    "loss": Metric(per_seed=True),
    "diverged": Metric(per="call"),
}
"""The learner's own metrics; an env's table is added to them."""
ANSWER_S = 0.2  #: longest time that the user waits for an answer to an interrupt, s
AGAIN_S = 1.0  #: signals within this time are one interrupt: schedulers send several at once, s
STOPPING = (
    "stopping after this call and saving; interrupt again to quit at once, without what was "
    "learnt since the last checkpoint"
)

Program = Callable[[TrainState], tuple[TrainState, Mapping[str, jax.Array]]]
"""A compiled call: many decisions of every env, and the means of its metrics."""
Validate = Callable[[TrainState], Mapping[str, np.ndarray]]
"""State -> logged name -> (num_seeds,) results of its greedy policies."""


@dataclasses.dataclass(frozen=True)
class Run:
    """A run: what learns, where it is shown and saved."""

    config: Config  #: sized to the devices
    env: BalanceEnv
    learner: DQN
    folder: RunFolder
    display: Display
    processes: Processes = ALONE
    callbacks: Callbacks = dataclasses.field(default_factory=Callbacks)
    own: Mapping[str, str | None] = dataclasses.field(default_factory=dict)
    """Names of the user's own `network` and `loss`; None or missing: ours."""
    keep: bool = True  #: whether the folder stays after the run, so that files in it have readers
    still: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Suite -> mean tilt of a robot that stands still, deg, to compare with."""

    @property
    def exportable(self) -> bool:
        """Whether the network is ours, which a policy file describes and NumPy runs."""
        return self.own.get("network") is None

    @property
    def num_seeds(self) -> int:
        """Runs in one program, the combinations of a sweep included."""
        return len(expand_runs(self.config))

    @property
    def iterations(self) -> int:
        """Decisions of every env per call of the program."""
        return max(1, self.config.log_every // self.learner.spec.num_envs)

    @property
    def per_call(self) -> int:
        """Decisions of one seed's envs per call."""
        return self.iterations * self.learner.spec.num_envs

    @property
    def total(self) -> int:
        """Decisions of one seed's envs at the end of the run, in whole calls."""
        return -(-self.config.num_env_steps // self.per_call) * self.per_call


class Interrupts:
    """Reasons to stop: an interrupt of the user, a write that failed, or a callback's wish.

    A second interrupt raises at once. A terminal that closes interrupts too (SIGHUP), unless the
    user has said `nohup`.
    """

    failure: str | None = None  #: what could not be written
    by_callback = False  #: whether a callback wants the run to end here

    def __init__(self, log_fn: Callable[[str], None]):
        """Answers by `log_fn`; use as a context."""
        self._log_fn, self._first, self._answered = log_fn, None, False

    def __bool__(self) -> bool:
        """Whether there is one."""
        return self.interrupted or self.by_callback

    @property
    def interrupted(self) -> bool:
        """Whether the run is not to go on to its evaluation."""
        return self._first is not None or self.failure is not None

    @contextmanager
    def saving(self, path: Path) -> Iterator[None]:
        """Notes what cannot be written of the run in `path`, so that the loop stops."""
        try:
            yield
        except checkpoints.SaveError as error:
            self.failure = self.failure or str(error)
        except OSError as error:
            self.failure = f"cannot write {error.filename or path}: {error.strerror}"

    def __enter__(self) -> "Interrupts":
        numbers = [signal.SIGINT, signal.SIGTERM]
        if threading.current_thread() is not threading.main_thread():
            numbers = []  # an app's: signals are its own
        elif hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
            numbers.append(signal.SIGHUP)
        self._previous = {number: signal.signal(number, self._receive) for number in numbers}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def run(self, call: Callable[..., T], *arguments: Any) -> T:
        """Runs a call in a thread, to answer interrupts while it is in compiled code."""
        future: Future[T] = Future()

        def work() -> None:
            try:
                with jax.enable_x64(False):  # as in `run.train`; it counts per thread
                    future.set_result(call(*arguments))
            except BaseException as error:
                future.set_exception(error)

        threading.Thread(target=work, daemon=True).start()
        while True:
            try:
                return future.result(ANSWER_S)
            except TimeoutError:
                if future.done():
                    raise  # the call's own
            except KeyboardInterrupt:
                atexit.register(_leave, future)
                raise
            # Not in the handler, which may interrupt a print.
            if self._first is not None and not self._answered:
                self._answered = True
                self._log_fn(STOPPING)

    def _receive(self, number: int, frame: object) -> None:
        now = time.monotonic()
        if self._first is None:
            self._first = now
        elif now - self._first >= AGAIN_S:
            raise KeyboardInterrupt


def _leave(call: Future[Any]) -> None:
    """Ends the process at its exit if a call still runs, with which Python would abort."""
    if not call.done():
        exit_at_once(128 + signal.SIGINT)


def learn(
    run: Run, program: Program, state: TrainState, stop: Interrupts, validate: Validate
) -> tuple[TrainState, float]:
    """Calls the program until the last decision, or until user, callback or full disk stop it.

    The state is saved either way; what cannot be written is noted in `stop`.

    A validation comes before the line of metrics and the checkpoint of its call, so that a resumed
    run neither misses it nor logs it twice, unless the disk was too full for the line alone. Of
    several processes all call the program and save; the first one logs, shows and validates. An
    interrupt of one stops all.

    Returns:
      The last state, and the seconds spent learning by this call, validations apart.
    """
    any_process, done = run.processes.any, number(state.env_steps)
    seconds = validating = 0.0
    saved_at = time.monotonic()
    with _journal(run, done) if run.processes.first else nullcontext() as write:
        while done < run.total and not stop.run(any_process, bool(stop)):
            before, began = done, time.perf_counter()
            state, raw = stop.run(_call, program, state)
            elapsed = time.perf_counter() - began
            seconds += elapsed
            done = number(state.env_steps)
            if write is not None:
                metrics, seeds = measured(run, raw, elapsed)
                validated = validation_due(run, before, done)
                with stop.saving(run.folder.path):
                    if validated:
                        began = time.perf_counter()
                        held_out = stop.run(validate, state)
                        validating += time.perf_counter() - began
                        metrics |= means(held_out)
                        metrics["perf/validation_share"] = validating / (seconds + validating)
                        seeds |= listed(held_out)
                    write(state, metrics, seeds)
                stop.by_callback |= _tell(run, state, metrics, validated)
            due = time.monotonic() - saved_at >= run.config.checkpoint_seconds
            if stop.run(any_process, due):
                with stop.saving(run.folder.path):
                    checkpoints.save(run.folder.checkpoints, done, state, run.processes)
                saved_at = time.monotonic()
    with stop.saving(run.folder.path):
        checkpoints.save(run.folder.checkpoints, done, state, run.processes)
    return state, seconds


def _tell(run: Run, state: TrainState, metrics: dict[str, float], validated: bool) -> bool:
    """Tells the callbacks of a line of metrics; whether one wants to stop."""
    line = _steps(state) | metrics
    stop = validated and run.callbacks.on_validation(line)
    return run.callbacks.on_log(line) or stop


def _steps(state: TrainState) -> dict[str, int]:
    return {name: number(getattr(state, name)) for name in ("env_steps", "gradient_steps")}


@contextmanager
def _journal(run: Run, done: int) -> Iterator[Callable[..., None]]:
    """Logs and shows the calls after `done` decisions; drops newer lines and policies first."""
    folder = run.folder
    keep_metrics_until(folder.metrics, done)
    keep_validated_until(folder.validated, done)
    folder.metrics.touch()
    # Whatever other files of TensorBoard have after `done` no longer counts.
    board = Board(folder.tensorboard, purge_step=done + 1, suffix=f".from-{done}")
    with run.display.training(done, run.total, run.still):

        def write(state: TrainState, metrics: dict[str, float], seeds: dict[str, Any]) -> None:
            steps = _steps(state)
            by_seed = {"seeds": seeds} if run.num_seeds > 1 else {}
            with folder.metrics.open("a") as log:
                log.write(json.dumps(steps | metrics | by_seed) + "\n")
            board.write(steps["env_steps"], metrics)
            run.display.update(steps["env_steps"], metrics)

        yield write


def validation_due(run: Run, before: int, done: int) -> bool:
    """Whether a call from `before` to `done` decisions passes a validation, or ends the run."""
    every = run.config.eval_every
    return every > 0 and (done // every > before // every or done >= run.total)


def _call(program: Program, state: TrainState) -> tuple[TrainState, Mapping[str, np.ndarray]]:
    """Calls the program and waits for its results; the metrics come to the host."""
    state, raw = jax.block_until_ready(program(state))
    return state, jax.device_get(raw)


def number(count: jax.Array) -> int:
    """A counter of the state, the same for every seed."""
    return int(np.ravel(count)[0])


def measured(
    run: Run, raw: Mapping[str, np.ndarray], seconds: float
) -> tuple[dict[str, float], dict[str, list[float | None]]]:
    """The metrics of a call under their logged names: the `means` of all, and some `listed`.

    Args:
      run: whose env and learner say how their metrics are logged.
      raw: means over the call's decisions, () or (num_seeds,); NaN without a value, as the loss
        before the first update.
      seconds: duration of the call.
    """
    rows = LEARNER_METRICS | dict(run.env.metrics)
    scale = {"decision": 1.0, "minute": 60 / run.config.task.ctrl_dt, "call": run.per_call}
    values, per_seed = {}, {}
    for name, value in raw.items():
        metric = rows.get(name, Metric())
        logged = metric.name or name
        values[logged] = scale[metric.per] * np.atleast_1d(np.asarray(value, float))
        if metric.per_seed:
            per_seed[logged] = values[logged]
    metrics = {f"train/{name}": value for name, value in means(values).items()}
    rate = run.num_seeds * run.per_call / seconds
    metrics["perf/env_steps_per_second"] = rate
    metrics["perf/physics_steps_per_second"] = rate * run.config.task.sim_steps
    return metrics, listed(per_seed)


def means(values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Means over the seeds that have a value; metrics missing for every seed are dropped."""
    known = {name: value[np.isfinite(value)] for name, value in values.items()}
    return {name: float(value.mean()) for name, value in known.items() if value.size}


def listed(values: Mapping[str, np.ndarray]) -> dict[str, list[float | None]]:
    """Per-seed values, None where missing; metrics missing for every seed are dropped."""
    return {
        name: [x if math.isfinite(x) else None for x in value.tolist()]
        for name, value in values.items()
        if np.isfinite(value).any()
    }
