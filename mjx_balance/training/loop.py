"""The loop of a run: calls of the compiled program, what they log, when they are saved."""

import atexit
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from tensorboardX import SummaryWriter

from mjx_balance.config import Config, expand_runs
from mjx_balance.dqn import TrainState
from mjx_balance.envs.metrics import Metric
from mjx_balance.files.run_folder import RunFolder, keep_metrics_until, keep_validated_until
from mjx_balance.report.progress import Display
from mjx_balance.training import checkpoints
from mjx_balance.training.processes import ALONE, Processes

T = TypeVar("T")

LEARNER_METRICS = {
    "reward": Metric(per_seed=True),
    "loss": Metric(per_seed=True),
    "diverged": Metric(per="call"),
}
"""The learner's own metrics; an env's table is added to them."""
ANSWER_S = 0.2
"""Longest time that the user waits for an answer to an interrupt, s."""

Program = Callable[[TrainState], tuple[TrainState, Mapping[str, jax.Array]]]
"""A compiled call: many decisions of every env, and the means of what was measured."""
Write = Callable[[TrainState, dict[str, float], dict[str, Any]], None]
"""Takes what a call measured: over all seeds, and of each."""
Validate = Callable[[TrainState], Mapping[str, np.ndarray]]
"""Tries the greedy policies of a state; what came of it by logged names, one value per seed."""


class Plan(NamedTuple):
    """A run as its loop sees it: plain numbers."""

    num_envs: int
    num_seeds: int
    iterations: int
    """Decisions of every env per call of the program."""
    total: int
    """Decisions at which the run ends, all envs of one seed, in whole calls."""
    decision_s: float
    """Length of a decision, s."""
    sim_steps: int
    """Physics steps per decision."""
    eval_every: int
    """Decisions of one seed's envs between two validations; 0: never."""
    checkpoint_seconds: float
    """Time between two checkpoints, s."""
    metrics: Mapping[str, Metric]
    """Metrics that are logged otherwise than as a mean under their own name."""

    @property
    def per_call(self) -> int:
        """Decisions of one seed's envs in one call."""
        return self.iterations * self.num_envs


def make_plan(config: Config, metrics: Mapping[str, Metric]) -> Plan:
    """The plan of a run whose config is sized to its devices, and whose env has these metrics."""
    assert config.num_envs is not None
    iterations = max(1, config.log_every // config.num_envs)
    per_call = iterations * config.num_envs
    return Plan(
        num_envs=config.num_envs,
        num_seeds=len(expand_runs(config)),
        iterations=iterations,
        total=-(-config.num_env_steps // per_call) * per_call,
        decision_s=config.task.ctrl_dt,
        sim_steps=config.task.sim_steps,
        eval_every=config.eval_every,
        checkpoint_seconds=config.checkpoint_seconds,
        metrics=LEARNER_METRICS | dict(metrics),
    )


class Interrupts:
    """Interrupts of the user, collected so that the loop can stop between two calls.

    The first is answered at once and asks the loop to stop; a second one raises
    KeyboardInterrupt, which loses what was learnt since the last checkpoint.
    """

    def __init__(self, log_fn: Callable[[str], None]):
        """Answers by `log_fn`; use as a context."""
        self._log_fn = log_fn
        self._received = 0
        self._answered = False

    def __bool__(self) -> bool:
        """Whether there was one."""
        return self._received > 0

    def __enter__(self) -> "Interrupts":
        numbers = (signal.SIGINT, signal.SIGTERM)
        self._previous = {number: signal.signal(number, self._receive) for number in numbers}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def run(self, call: Callable[..., T], *arguments: Any) -> T:
        """Runs a call that may take a minute, and answers an interrupt meanwhile.

        It runs in a thread of its own: Python handles no signal while the main thread is in
        a compiled program.
        """
        future: Future[T] = Future()

        def work() -> None:
            try:
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
            self._answer()

    def _receive(self, number: int, frame: object) -> None:
        self._received += 1
        if self._received > 1:
            raise KeyboardInterrupt

    def _answer(self) -> None:
        if self._received and not self._answered:
            self._answered = True
            self._log_fn(
                "stopping after this call and saving; interrupt again to quit at once, without "
                "what was learnt since the last checkpoint"
            )


def _leave(call: Future[Any]) -> None:
    """Ends the process at its exit if a call still runs: with it, Python would abort."""
    if not call.done():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(128 + signal.SIGINT)


def learn(
    plan: Plan,
    program: Program,
    state: TrainState,
    folder: RunFolder,
    display: Display,
    stop: Interrupts,
    validate: Validate,
    processes: Processes = ALONE,
) -> tuple[TrainState, float]:
    """Calls the program until the last decision or until the user stops; saves either way.

    Every call is logged, with the validation that is due after it: it is made before its line
    and before a checkpoint, so that a run that is resumed has neither missed it nor logs it
    twice. What the folder has logged or validated after the state's decisions is dropped first.

    Of several processes all call the program and save; the first one logs, shows and validates.
    They stop together, whichever of them is interrupted.

    Args:
      plan: of the run.
      program: compiled.
      state: to go on from.
      folder: to log and save into.
      display: shows what is logged.
      stop: whether the user interrupts.
      validate: tries the greedy policies, when the plan says so.
      processes: that share the state.

    Returns:
      The last state, and the seconds spent learning by this call, validations apart.
    """
    done = number(state.env_steps)
    seconds = validating = 0.0
    saved_at = time.monotonic()
    with _journal(plan, folder, display, done) if processes.first else nullcontext() as write:
        while done < plan.total and not stop.run(processes.any, bool(stop)):
            before, began = done, time.perf_counter()
            state, raw = stop.run(_finished, program, state)
            elapsed = time.perf_counter() - began
            seconds += elapsed
            done = number(state.env_steps)
            if write is not None:
                metrics, seeds = measured(raw, elapsed, plan)
                if validation_due(plan, before, done):
                    began = time.perf_counter()
                    held_out = stop.run(validate, state)
                    validating += time.perf_counter() - began
                    metrics |= means(held_out)
                    metrics["perf/validation_share"] = validating / (seconds + validating)
                    seeds |= listed(held_out)
                write(state, metrics, seeds)
            if stop.run(processes.any, time.monotonic() - saved_at >= plan.checkpoint_seconds):
                checkpoints.save(folder.checkpoints, done, state, processes)
                saved_at = time.monotonic()
    checkpoints.save(folder.checkpoints, done, state, processes)
    return state, seconds


@contextmanager
def _journal(plan: Plan, folder: RunFolder, display: Display, done: int) -> Iterator[Write]:
    """Writes what a call measured into the folder, and shows it."""
    keep_metrics_until(folder.metrics, done)
    keep_validated_until(folder.validated, done)
    with (
        folder.metrics.open("a") as log,
        _board(folder, done) as board,
        display.training(done, plan.total),
    ):

        def write(state: TrainState, metrics: dict[str, float], seeds: dict[str, Any]) -> None:
            done = number(state.env_steps)
            line: dict[str, Any] = {"env_steps": done}
            line |= {"gradient_steps": number(state.gradient_steps)} | metrics
            if plan.num_seeds > 1:
                line["seeds"] = seeds
            log.write(json.dumps(line) + "\n")
            log.flush()
            for name, value in metrics.items():
                board.add_scalar(name, value, done)
            display.update(done, metrics)

        yield write


def validation_due(plan: Plan, before: int, done: int) -> bool:
    """Whether a call from `before` to `done` decisions passes a validation, or ends the run."""
    if not plan.eval_every:
        return False
    return done // plan.eval_every > before // plan.eval_every or done >= plan.total


def _board(folder: RunFolder, done: int) -> SummaryWriter:
    """A TensorBoard file, which says that whatever others have after `done` no longer counts."""
    suffix = f".from-{done}"
    return SummaryWriter(str(folder.tensorboard), purge_step=done + 1, filename_suffix=suffix)


def _finished(program: Program, state: TrainState) -> tuple[TrainState, Mapping[str, np.ndarray]]:
    """Calls the program and waits for what it gives; the measurements come to the host."""
    state, raw = jax.block_until_ready(program(state))
    return state, jax.device_get(raw)


def number(count: jax.Array) -> int:
    """A counter of the state, the same for every seed."""
    return int(np.ravel(count)[0])


def measured(
    raw: Mapping[str, np.ndarray], seconds: float, plan: Plan
) -> tuple[dict[str, float], dict[str, list[float | None]]]:
    """The metrics of a call under their logged names.

    Args:
      raw: means over the call's decisions, one per seed if there are several; NaN without a
        value, as the loss before the first update.
      seconds: duration of the call.
      plan: of the run.

    Returns:
      The `means` of all metrics, and those per seed `listed`.
    """
    scale = {"decision": 1.0, "minute": 60 / plan.decision_s, "call": plan.per_call}
    values: dict[str, np.ndarray] = {}
    per_seed = {}
    for name, value in raw.items():
        metric = plan.metrics.get(name, Metric())
        logged = metric.name or name
        values[logged] = scale[metric.per] * np.atleast_1d(np.asarray(value, float))
        if metric.per_seed:
            per_seed[logged] = values[logged]
    metrics = {f"train/{name}": value for name, value in means(values).items()}
    rate = plan.num_seeds * plan.per_call / seconds
    metrics["perf/env_steps_per_second"] = rate
    metrics["perf/physics_steps_per_second"] = rate * plan.sim_steps
    return metrics, listed(per_seed)


def means(values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Means over the seeds that have a value, without those that none has."""
    known = {name: value[np.isfinite(value)] for name, value in values.items()}
    return {name: float(value.mean()) for name, value in known.items() if value.size}


def listed(values: Mapping[str, np.ndarray]) -> dict[str, list[float | None]]:
    """The values of every seed, None for one without, less those that no seed has."""
    return {
        name: [x if math.isfinite(x) else None for x in value.tolist()]
        for name, value in values.items()
        if np.isfinite(value).any()
    }
