"""The loop of a run: calls of the compiled program, what they log, when they are saved."""

import contextlib
import json
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from tensorboardX import SummaryWriter

from mjx_balance.config import Config, to_dict
from mjx_balance.display import Display
from mjx_balance.dqn.learner import Learner, TrainState
from mjx_balance.run_folder import RunFolder
from mjx_balance.training.checkpoints import Checkpoints
from mjx_balance.training.program_cache import compile_cached, digest

PER_SEED = ("tilt_deg", "falls_per_minute", "reward", "loss")
"""Metrics that are also logged for every seed, where there are several."""

Program = Callable[[TrainState], tuple[TrainState, Mapping[str, jax.Array]]]
"""A compiled call: many decisions of every env, and the means of what was measured."""


class Units(NamedTuple):
    """What turns the means of a call into the metrics that are logged."""

    decision_s: float
    """Length of a decision, s."""
    sim_steps: int
    """Physics steps per decision."""
    per_call: int
    """Decisions of one seed's envs in one call."""
    num_seeds: int


def learn(
    config: Config,
    learner: Learner,
    folder: RunFolder,
    resume: bool,
    display: Display,
    stop: list[int],
) -> tuple[TrainState, float]:
    """Trains until the last decision, or until the user stops; saves either way.

    Returns:
      The last state, and the seconds spent learning by this call.
    """
    checkpoints = Checkpoints(folder.checkpoints)
    iterations = max(1, config.log_every // learner.num_envs)
    per_call = iterations * learner.num_envs
    with display.phase("compiling (about a minute the first time, seconds from then on)"):
        state = learner.init(config.seed)
        key = digest(to_dict(config), per_call)
        program = compile_cached(learner.train_program(iterations), state, key)
    if resume:
        state = checkpoints.restore(state)
        display.say(f"resuming at {number(state.env_steps):,} decisions")
    drop_metrics_after(folder.metrics, number(state.env_steps))
    units = Units(config.task.ctrl_dt, config.task.sim_steps, per_call, config.num_seeds)
    total = -(-config.num_env_steps // per_call) * per_call
    every = config.checkpoint_every
    state, seconds = _repeat(
        program, state, total, units, every, checkpoints, folder, display, stop
    )
    checkpoints.save(number(state.env_steps), state)
    checkpoints.close()
    return state, seconds


def _repeat(
    program: Program,
    state: TrainState,
    total: int,
    units: Units,
    checkpoint_every: int,
    checkpoints: Checkpoints,
    folder: RunFolder,
    display: Display,
    stop: list[int],
) -> tuple[TrainState, float]:
    """Calls the program until `total` decisions or until `stop`; logs every call."""
    done = saved_at = number(state.env_steps)
    seconds = 0.0
    with (
        folder.metrics.open("a") as log,
        SummaryWriter(str(folder.tensorboard)) as board,
        display.training(done, total),
    ):
        while done < total and not stop:
            began = time.perf_counter()
            state, raw = program(state)
            done = number(state.env_steps)
            elapsed = time.perf_counter() - began
            seconds += elapsed
            metrics, seeds = measured(jax.device_get(raw), elapsed, units)
            line = {"env_steps": done, "gradient_steps": number(state.gradient_steps)}
            log.write(json.dumps(line | metrics | seeds) + "\n")
            log.flush()
            for name, value in metrics.items():
                board.add_scalar(name, value, done)
            display.update(done, metrics)
            if done // checkpoint_every > saved_at // checkpoint_every:
                checkpoints.save(done, state)
                saved_at = done
    return state, seconds


def number(count: jax.Array) -> int:
    """A counter of the state, the same for every seed."""
    return int(np.ravel(count)[0])


def measured(
    raw: Mapping[str, np.ndarray], seconds: float, units: Units
) -> tuple[dict[str, float], dict[str, Any]]:
    """What a call measured, under the names it is logged by.

    Args:
      raw: means over the call, one per seed if there are several.
      seconds: that it took.
      units: of the run.

    Returns:
      Means over the seeds, and `{"seeds": {name: values}}` if there are several.
    """
    raw = dict(raw)
    raw["falls_per_minute"] = raw.pop("fall") * 60 / units.decision_s
    metrics = {f"train/{name}": float(np.mean(value)) for name, value in raw.items()}
    rate = units.num_seeds * units.per_call / seconds
    metrics["perf/env_steps_per_second"] = rate
    metrics["perf/physics_steps_per_second"] = rate * units.sim_steps
    if units.num_seeds == 1:
        return metrics, {}
    return metrics, {"seeds": {name: raw[name].tolist() for name in PER_SEED}}


@contextlib.contextmanager
def stop_on_interrupt() -> Iterator[list[int]]:
    """Collects interrupt signals, so that the loop can stop between two calls.

    A second one interrupts at once.
    """
    received: list[int] = []

    def handler(number: int, frame: object) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)

    previous = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        previous[number] = signal.signal(number, handler)
    try:
        yield received
    finally:
        for number, old in previous.items():
            signal.signal(number, old)


def drop_metrics_after(path: Path, env_steps: int) -> None:
    """Removes lines that a resumed run will write again, and what a crash left half-written."""
    if not path.is_file():
        return
    kept = []
    for text in path.read_text().splitlines():
        with contextlib.suppress(ValueError, KeyError, TypeError):
            if json.loads(text)["env_steps"] <= env_steps:
                kept.append(f"{text}\n")
    path.write_text("".join(kept))
